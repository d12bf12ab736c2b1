# SPDX-License-Identifier: Apache-2.0
"""ros_arduino_bridge: an Arduino that answers letters. `m L R` drives, in ticks a frame; `e` reads the encoders.

A command ends with CR, an answer with CR LF. There is no checksum: a damaged count shows as a jump of the encoders. The
commands are those of github.com/hbrobotics/ros_arduino_bridge, "Firmware", 2012. Frames are 30 a second, its PID_RATE.
"""

import re

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardInput, WheelDevice
from shared.board_framing import LineFramer
from shared.config import Robot

COUNTS = re.compile(rb"(-?\d{1,10}) (-?\d{1,10})")


class RosArduinoBridgeBoard(WheelDevice):
    """Sends a command and asks for the counters at once. The firmware stops 2 s after the last command."""

    NAME = "ros_arduino_bridge"
    INVERTIBLE = True

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self._framer = LineFramer()

    def forget(self) -> None:
        super().forget()
        self._framer.forget()

    def start_command(self) -> bytes:
        return b"\rm 0 0\r"  # the first CR ends what an earlier program left

    def stop_command(self) -> bytes:
        return b"m 0 0\r"

    def command(self, left: float, right: float, now: int) -> bytes:
        left, right = self.forward_counts(left, right)
        return b"m %d %d\re\r" % (round(left / self.config.frame_rate), round(right / self.config.frame_rate))

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        received = BoardInput()
        for line in self._framer.lines(data):
            match = COUNTS.fullmatch(line)
            if match:
                received.report = self.report(stamp, int(match[1]), int(match[2]), stamp * 1e-9)
                received.n_reports += 1
            if match or line == b"OK":
                self.counts.n_good += 1
            else:
                self.counts.n_resyncs += 1
                self.counts.n_skipped += len(line)
        return received
