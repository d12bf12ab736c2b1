# SPDX-License-Identifier: Apache-2.0
"""A gamepad's events to velocities. Source: Linux, Documentation/input/event-codes.rst and gamepad.rst.

The left stick drives forward and back, the right one turns. Nothing moves unless a shoulder button is held, as dead-man
button. East (B, circle) is STOP.
"""

import struct
from dataclasses import dataclass

EVENT = struct.Struct("@llHHi")  # struct input_event: time s, us; type, code, value
EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
SYN_DROPPED = 3  # the kernel dropped events: what is held is not known
FORWARD_AXIS, TURN_AXIS = 0x01, 0x03  # ABS_Y of the left stick, ABS_RX of the right one; up and left are negative
DEAD_MAN_BUTTONS = frozenset((0x136, 0x137))  # BTN_TL, BTN_TR
STOP_BUTTON = 0x131  # BTN_EAST
DEAD_ZONE = 0.12  # share of a stick's way around its middle
STEADY_S = 5.0
"""Without an event for so long nothing is held: a radio link may be lost while its receiver stays."""


@dataclass(frozen=True, slots=True)
class AxisRange:
    """The values of an axis, as its device reports them."""

    least: int
    greatest: int

    def share(self, value: int) -> float:
        """-1 to 1; 0 within the dead zone, without a step at its edge."""
        middle, half = (self.least + self.greatest) / 2, (self.greatest - self.least) / 2
        share = min(max((value - middle) / half, -1.0), 1.0) if half > 0 else 0.0
        beyond = abs(share) - DEAD_ZONE
        return 0.0 if beyond <= 0 else beyond / (1 - DEAD_ZONE) * (1 if share > 0 else -1)


class Gamepad:
    """What is held. ranges: of the axes by code; an axis without one is not used."""

    def __init__(self, ranges: dict[int, AxisRange]) -> None:
        self._ranges = ranges
        self._kept = b""
        self._event_at = float("-inf")  # s
        self.presses_stop = False
        self.forget()

    def forget(self) -> None:
        """Nothing is held: the device is gone, or events were lost. A button counts when it is pressed again."""
        self._shares = {FORWARD_AXIS: 0.0, TURN_AXIS: 0.0}
        self._held: set[int] = set()

    def take(self, data: bytes, now: float) -> None:
        """Takes bytes of the device at `now` s, in pieces of any size. `presses_stop` stays set until `take_stop`."""
        if data:
            self._event_at = now
        data = self._kept + data
        whole = len(data) - len(data) % EVENT.size
        self._kept = data[whole:]
        for _, _, kind, code, value in EVENT.iter_unpack(data[:whole]):
            if kind == EV_SYN and code == SYN_DROPPED:
                self.forget()
            elif kind == EV_KEY and value == 1:
                self._held.add(code)
                self.presses_stop |= code == STOP_BUTTON
            elif kind == EV_KEY and value == 0:
                self._held.discard(code)
            elif kind == EV_ABS and code in self._shares and code in self._ranges:
                self._shares[code] = self._ranges[code].share(value)

    def take_stop(self) -> bool:
        """Whether STOP was pressed since the last call."""
        pressed, self.presses_stop = self.presses_stop, False
        return pressed

    def drives(self, now: float) -> bool:
        """Whether the dead-man button is held at `now` s."""
        if now - self._event_at > STEADY_S:
            self.forget()
        return bool(self._held & DEAD_MAN_BUTTONS)

    def direction(self, now: float) -> tuple[float, float]:
        """Forward and counter-clockwise at `now` s, each -1 to 1; 0 without the dead-man button."""
        if not self.drives(now):
            return 0.0, 0.0
        return 0.0 - self._shares[FORWARD_AXIS], 0.0 - self._shares[TURN_AXIS]
