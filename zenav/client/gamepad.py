# SPDX-License-Identifier: Apache-2.0
"""Events of a gamepad to forward and turn, while its dead-man button is held.

Linux's joystick interface (Documentation/input/joydev/joystick-api.rst) gives 8 bytes an event: time u32 ms, value i16,
type u8, number u8. Axes and buttons are numbered as by xpad and hid-playstation: left stick 0 and 1, right stick 3 and
4; LB or L1 is button 4, B or the circle button 1.
"""

import struct

EVENT = struct.Struct("<IhBB")
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80  # types; INITIAL is added for the state at opening
DRIVE_AXIS, TURN_AXIS = 1, 3  # left stick up and down, right stick left and right: both positive down and right
DEAD_MAN, STOP = 4, 1
FULL = 32767
DEAD_ZONE = 0.08  # share of the way of a stick in which it rests
STEADY_S = 5.0
"""Without an event the robot stands after this time: a radio link may be lost and its receiver stay."""
RELEASE_S = 0.5
"""For which a release sends zero. Then navigation may drive again."""


class Gamepad:
    """State of a gamepad. Times are s on one monotonic clock."""

    def __init__(self) -> None:
        self.stop_pressed = False
        """Whether the STOP button was pressed; its reader clears it."""
        self._buffer = b""
        self._axes: dict[int, int] = {}
        self._held = False
        self._event_at = float("-inf")
        self._drove_at = float("-inf")

    def feed(self, data: bytes, now: float) -> None:
        """Takes bytes of the device. A button that is held when the device opens counts from its next press."""
        self._buffer += data
        whole = len(self._buffer) // EVENT.size * EVENT.size
        for _, value, kind, number in EVENT.iter_unpack(self._buffer[:whole]):
            if kind & ~INITIAL == AXIS:
                self._axes[number] = value
            elif kind == BUTTON and number == DEAD_MAN:
                self._held = bool(value)
            elif kind == BUTTON and number == STOP and value:
                self.stop_pressed = True
            self._event_at = now
        self._buffer = self._buffer[whole:]

    def unplug(self) -> None:
        """Lets go of everything: the device is gone."""
        self._buffer, self._axes, self._held = b"", {}, False

    def direction(self, now: float) -> tuple[float, float] | None:
        """Forward and turn, each -1 to 1, forward and left positive; None while the gamepad has nothing to send."""
        if self._held and now - self._event_at <= STEADY_S:
            self._drove_at = now
            return -self._deflection(DRIVE_AXIS), -self._deflection(TURN_AXIS)
        return (0.0, 0.0) if now - self._drove_at <= RELEASE_S else None

    def words(self, now: float) -> str:
        """Why it does not drive; empty while it does."""
        if not self._held:
            return "hold LB or L1 to drive"
        return "" if now - self._event_at <= STEADY_S else "nothing heard for 5 s: move a stick"

    def _deflection(self, axis: int) -> float:
        share = max(-1.0, min(self._axes.get(axis, 0) / FULL, 1.0))
        beyond = max(abs(share) - DEAD_ZONE, 0.0) / (1 - DEAD_ZONE)
        return beyond if share > 0 else -beyond
