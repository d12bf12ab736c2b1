# SPDX-License-Identifier: Apache-2.0
"""What every laser gives, whatever it speaks: returns in the order of measuring, on the device's own clock."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int64s = NDArray[np.int64]
Uint8s = NDArray[np.uint8]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Returns:
    """n beams in the order of measuring, and p moments at which the device let go of them.

    angles: (n,) rad, counter-clockwise from the device's front seen from its top, in any turn.  ranges: (n,) m, NaN
    without a measurement.  intensities: (n,) or none.  times: (n,) s on the device's clock.
    sent: (p,) s on the device's clock when a packet was complete.  ages: (p,) s by which its last byte must have come
    before the newest byte did.  restarted: the device's clock went back.
    """

    angles: Float64s
    ranges: Float32s
    intensities: Float32s | None
    times: Float64s
    sent: Float64s
    ages: Float64s
    restarted: bool = False


@dataclass(slots=True)
class Counts:
    """Of a decoder since it was made."""

    n_good: int = 0  # packets with a good sum
    n_bad: int = 0  # packets with a bad sum
    n_resyncs: int = 0  # times that bytes were skipped to find the next packet


class Device(Protocol):
    """A laser as its protocol has it: a state machine from bytes to returns and to the bytes that it wants said.

    clockwise: how it turns, seen from its top.  speed: turns/s as it tells or as it is set; 0 stopped, None unknown.
    trouble: what it says is wrong with it, for people; empty when nothing is.  scanning: its start sequence is through.
    met: where it tells its clock on request: s on that, and between which two times of the stack's (ns) it was so.
    """

    clockwise: bool
    counts: Counts
    trouble: str

    @property
    def speed(self) -> float | None: ...

    @property
    def met(self) -> tuple[float, int, int] | None: ...

    @property
    def scanning(self) -> bool: ...

    def opened(self, now: int) -> bytes:
        """Begins the start sequence anew, whatever came before; the bytes to say first."""

    def received(self, data: bytes, now: int) -> list[Returns]:
        """Takes the bytes that the port read."""

    def due(self, now: int) -> bytes:
        """What to say now; called after each reading and each tick."""

    def farewell(self) -> bytes:
        """What stops it."""


N = TypeVar("N", np.int64, np.float64)


def steps_of(values: NDArray[N], before: float) -> NDArray[N]:
    """(n,) -> (n,): how far each lies after the one before it; np.diff with `prepend` takes ten times as long."""
    steps = values.copy()
    steps[1:] -= values[:-1]
    steps[0] -= before
    return steps


def since(ticks: Int64s, last: int | None, wrap: int, most_back: int) -> tuple[Int64s, bool]:
    """How far each tick of a wrapping counter lies after `last` (or the first tick), and whether the counter went back.

    ticks: (p,).  A step back by over `most_back`: the device started anew.
    """
    steps = (steps_of(ticks, int(ticks[0]) if last is None else last) + wrap // 2) % wrap - wrap // 2
    back = steps < -most_back
    restarted = bool(back.any())
    if restarted:
        steps[back] = 0
    return steps.cumsum(), restarted
