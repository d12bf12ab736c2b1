# SPDX-License-Identifier: Apache-2.0
"""The emulated ODrive: answers its ASCII protocol; an axis turns in closed loop only, and stops by its watchdog."""

from services.sim.hardware.electronics import BodyTruth, WheelElectronics
from shared.board_framing import LineFramer, xor
from shared.config import Robot
from shared.messages import BoardReport

CLOSED_LOOP = b"8"


class OdriveElectronics(WheelElectronics):
    """State of both axes. Positions are those of the last period."""

    WRAP = 1 << 31

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._framer = LineFramer()
        self._states = [b"1", b"1"]
        self._turns = [0.0, 0.0]  # a second
        self._volts = 0.0

    def restart(self) -> None:
        super().restart()
        self._states, self._turns = [b"1", b"1"], [0.0, 0.0]

    def receive(self, data: bytes, now: int) -> bytes:
        lines = self._framer.lines(data) if self.is_awake else []
        return b"".join(self._answer(line, now) for line in lines)

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        self.read_counters(truth)
        self._volts = truth.battery if truth.battery >= 0 else 0.0
        return []

    def _answer(self, line: bytes, now: int) -> bytes:
        text, star, checksum = line.rpartition(b"*")
        if star and checksum != b"%d" % xor(text):
            return b""
        words = (text if star else line).split()
        reply = self._reply(words, now)
        if not reply:
            return b""
        return (b"%b*%d\r\n" % (reply, xor(reply))) if star else reply + b"\r\n"

    def _reply(self, words: list[bytes], now: int) -> bytes:
        try:
            if words[0] == b"v":
                self._turns[int(words[1])] = float(words[2])
                self._command(now)
            elif words[0] == b"f":
                axis = int(words[1])
                return b"%f %f" % (self.last_counts[axis] / self.drive.counts_per_turn, self._turns[axis])
            elif words == [b"r", b"vbus_voltage"]:
                return b"%f" % self._volts
            elif words[0] == b"r" and words[1].endswith(b"current_state"):
                return self._states[int(words[1][4:5])]
            elif words[0] == b"w":
                self._write(words[1], words[2], now)
        except (IndexError, ValueError):
            return b"unknown command"
        return b""

    def _write(self, name: bytes, value: bytes, now: int) -> None:
        if name.endswith(b"requested_state"):
            self._states[int(name[4:5])] = value
            self._command(now)
        elif name.endswith(b"watchdog_timeout"):
            self.life_ns = round(float(value) * 1e9)

    def _command(self, now: int) -> None:
        left, right = (
            turns * self.drive.counts_per_turn if state == CLOSED_LOOP else 0.0
            for turns, state in zip(self._turns, self._states)
        )
        self.turn_wheels(left, right, now)
