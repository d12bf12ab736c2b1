# SPDX-License-Identifier: Apache-2.0
"""ODrive by its ASCII protocol, over USB or UART: axis 0 is the left wheel, axis 1 the right one.

`v axis turns/s torque`, `f axis` (answer: position in turns and turns/s), `r` and `w` of a property. A request ends
with `*` and the XOR of the bytes before it. Its answer then has such a checksum, too. "ASCII Protocol" of
docs.odriverobotics.com, firmware 0.5.1 and later, 2020.
"""

from math import floor, isfinite

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardInput, WheelDevice
from shared.board_framing import LineFramer, xor
from shared.config import Robot

AXES = (0, 1)
CLOSED_LOOP, VELOCITY_CONTROL, IDLE = 8, 2, 1
READINGS = (b"f 0", b"f 1", b"r axis0.current_state", b"r axis1.current_state", b"r vbus_voltage")
PATTERN = [2, 2, 1, 1, 1]  # numbers of their answers
START_PERIOD_NS = 1_000_000_000  # ns between two attempts to start an axis that stands idle
MAX_TURNS = 1e9
Values = tuple[float, ...]


class OdriveBoard(WheelDevice):
    """Asks for both axes, their states and the voltage: two answers of two numbers, then three of one.

    A group with another pattern is dropped. So a lost line never exchanges the wheels.
    """

    NAME = "odrive"
    INVERTIBLE = True

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self._framer = LineFramer()
        self._group: list[Values] = []
        self._started_at = 0  # ns

    def forget(self) -> None:
        super().forget()
        self._framer.forget()
        self._group = []

    def start_command(self) -> bytes:
        lines = [b"", b"sc"]  # an empty line ends what an earlier program left; then errors are cleared
        for axis in AXES:
            settings = (
                b"config.watchdog_timeout %.3f" % self.config.command_life,
                b"config.enable_watchdog 1",
                b"controller.config.control_mode %d" % VELOCITY_CONTROL,
                b"requested_state %d" % CLOSED_LOOP,
            )
            lines += [b"v %d 0 0" % axis, *(b"w axis%d.%b" % (axis, setting) for setting in settings)]
        return b"".join(request_line(line) for line in lines)

    def stop_command(self) -> bytes:
        lines = (line for axis in AXES for line in (b"v %d 0 0" % axis, b"w axis%d.requested_state %d" % (axis, IDLE)))
        return b"".join(request_line(line) for line in lines)

    def command(self, left: float, right: float, now: int) -> bytes:
        turns = (counts / self._counts_per_turn for counts in self.forward_counts(left, right))
        lines = [b"v %d %.4f 0" % (axis, speed) for axis, speed in zip(AXES, turns)]
        asks_start = bool(self.fault) and left == right == 0 and not 0 <= now - self._started_at < START_PERIOD_NS
        self._started_at = now if asks_start else self._started_at
        start = self.start_command() if asks_start else b""
        return start + b"".join(request_line(line) for line in (*lines, *READINGS))

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        received = BoardInput()
        for line in self._framer.lines(data):
            values = answer_values(line)
            if values is None:
                self.counts.n_bad += b"*" in line
                self.counts.n_resyncs += 1
                self.counts.n_skipped += len(line)
                self._group = [()]  # what is left of this group does not count
                continue
            self.counts.n_good += 1
            begins = len(values) == 2 and self._group and len(self._group[-1]) != 2
            self._group = [values] if begins else [*self._group[-len(PATTERN) :], values]
            if [len(answer) for answer in self._group] == PATTERN:
                self._decode(self._group, stamp, received)
        return received

    @property
    def _counts_per_turn(self) -> float:
        """Encoder counts of the robot file for a turn of the motor."""
        return self.drive.counts_per_turn / self.config.gear_ratio

    def _decode(self, group: list[Values], stamp: int, received: BoardInput) -> None:
        idle = [str(axis) for axis, state in zip(AXES, group[2:4]) if state[0] != CLOSED_LOOP]
        self.fault = f"axis {' and '.join(idle)} is not in closed loop control: is it calibrated?" if idle else ""
        left, right = (floor(values[0] * self._counts_per_turn) for values in group[:2])
        self.battery = min(max(group[4][0], 0.0), 100.0)
        received.report = self.report(stamp, left, right, stamp * 1e-9)
        received.n_reports += 1


def request_line(text: bytes) -> bytes:
    """A request with its checksum and end; an empty one without checksum."""
    return b"%b*%d\n" % (text, xor(text)) if text else b"\n"


def answer_values(line: bytes) -> Values | None:
    """The one or two numbers of an answer; None where its checksum is missing or wrong, or it has others."""
    text, star, checksum = line.rpartition(b"*")
    if not star or checksum != b"%d" % xor(text):
        return None
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        return None
    is_valid = 1 <= len(values) <= 2 and all(isfinite(value) and abs(value) <= MAX_TURNS for value in values)
    return values if is_valid else None
