# SPDX-License-Identifier: Apache-2.0
"""The emulated ros_arduino_bridge: answers `m` and `e`; its wheels stop 2 s after the last `m`."""

from services.sim.hardware.electronics import BodyTruth, WheelElectronics
from shared.board_framing import LineFramer
from shared.config import Robot
from shared.messages import BoardReport

FRAMES = 30  # a second: speeds are ticks a frame


class RosArduinoBridgeElectronics(WheelElectronics):
    """State of the firmware. Counters are those of the last period."""

    LIFE_NS = 2_000_000_000

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._framer = LineFramer()

    def receive(self, data: bytes, now: int) -> bytes:
        lines = self._framer.lines(data) if self.is_awake else []
        return b"".join(self._answer(line, now) for line in lines)

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        self.read_counters(truth)
        return []

    def _answer(self, line: bytes, now: int) -> bytes:
        letter, *arguments = line.split()[:3] or [b""]
        if letter == b"e":
            return b"%d %d\r\n" % self.last_counts
        if letter != b"m" or len(arguments) != 2:
            return b"Invalid Command\r\n"
        try:
            left, right = (int(argument) for argument in arguments)
        except ValueError:
            return b"Invalid Command\r\n"
        self.turn_wheels(left * FRAMES, right * FRAMES, now)
        return b"OK\r\n"
