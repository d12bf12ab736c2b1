# SPDX-License-Identifier: Apache-2.0
"""Interface of all lasers: beams in the order of measurement, with times on the device's own clock."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared.types import Float32s, Float64s, Int64s


@dataclass(frozen=True, slots=True)
class Returns:
    """n beams in the order of measurement, from p packets.

    angles: (n,) rad from the device's front, counter-clockwise seen from its top, modulo a turn.
    ranges: (n,) m, NaN without a measurement.
    intensities: (n,) in the device's scale, or None.
    times: (n,) s on the device's clock.
    sent: (p,) s on the device's clock when each packet was complete.
    ages: (p,) s from the arrival of each packet's last byte to that of the newest byte.
    restarted: the device's clock went back.
    """

    angles: Float64s
    ranges: Float32s
    intensities: Float32s | None
    times: Float64s
    sent: Float64s
    ages: Float64s
    restarted: bool = False


@dataclass(slots=True)
class PacketCounts:
    """Counters of a decoder since its construction."""

    n_good: int = 0  # packets with a correct checksum
    n_bad: int = 0  # packets with a wrong checksum
    n_resyncs: int = 0  # times that bytes were skipped before a packet


MAX_WAIT_NS = 3_000_000_000  # the longest time for which a device waits for an answer is 2 s


def is_before(deadline: int, now: int) -> bool:
    """Whether a device still waits at `now` (ns). A deadline that is too far ahead is of a clock that was set back."""
    return 0 < deadline - now <= MAX_WAIT_NS


class LaserDevice(Protocol):
    """A laser's protocol as a state machine: received bytes to beams, and to the bytes to send.

    - clockwise: direction of rotation, seen from the top.
    - speed: turns/s, reported or set; 0 stopped, None unknown.
    - fault: fault that the device reports, for people; empty without one.
    - scanning: whether the start sequence is complete.
    - clock_reading: the device's clock (s), and the stack's times (ns) before and after the reading; None without one.
    """

    clockwise: bool
    counts: PacketCounts
    fault: str

    @property
    def speed(self) -> float | None: ...

    @property
    def clock_reading(self) -> tuple[float, int, int] | None: ...

    @property
    def scanning(self) -> bool: ...

    def start(self, now: int) -> bytes:
        """Begins the start sequence again at `now` (ns). Returns the first bytes to send."""

    def receive(self, data: bytes, now: int) -> list[Returns]:
        """Decodes bytes that the port read at `now` (ns)."""

    def next_command(self, now: int) -> bytes:
        """The bytes to send at `now` (ns), or none; called after each reading and each tick."""

    def stop_command(self) -> bytes:
        """The bytes that stop the laser."""


N = TypeVar("N", np.int64, np.float64)


def differences(values: NDArray[N], before: float) -> NDArray[N]:
    """(n,) -> (n,): each value minus the one before it. Ten times faster than np.diff with `prepend`."""
    steps = values.copy()
    steps[1:] -= values[:-1]
    steps[0] -= before
    return steps


def unwrapped_ticks(ticks: Int64s, last: int | None, wrap: int, most_back: int) -> tuple[Int64s, bool]:
    """Ticks (p,) of a counter that wraps at `wrap`, unwrapped and relative to `last`, and whether the device restarted.

    last: None: relative to the first tick.  most_back: ticks; a larger step back is a restart of the device.
    """
    steps = (differences(ticks, int(ticks[0]) if last is None else last) + wrap // 2) % wrap - wrap // 2
    back = steps < -most_back
    restarted = bool(back.any())
    if restarted:
        steps[back] = 0
    return steps.cumsum(), restarted
