# SPDX-License-Identifier: Apache-2.0
"""A Hokuyo that speaks SCIP 2.0: answers its commands, and gives a sweep's distances at the end of the sweep."""

from math import pi

import numpy as np

from services.sim.hardware.beam_lookup import first_angle, ranges_mm
from shared.config import Laser
from shared.messages import LaserScan

MS = 1_000_000
BLOCK = 64
NOTHING = 1  # mm: under 20 is a code of an error
MOTOR_FAULT = b"70"  # of 50 to 97, trouble of the hardware


def sum_of(characters: bytes) -> bytes:
    """The character that follows them."""
    return bytes([(sum(characters) & 0x3F) + 0x30])


def encoded(value: int, width: int) -> bytes:
    """6 bits a character, the most significant first."""
    return bytes((value >> 6 * i & 0x3F) + 0x30 for i in range(width - 1, -1, -1))


def answer(echo: bytes, status: bytes, lines: list[bytes]) -> bytes:
    """A whole answer; each line but the echo gets its sum."""
    return b"\n".join([echo, *(line + sum_of(line) for line in [status, *lines]), b"", b""])


class ScipEmulator:
    """Steps are the robot's beams, counter-clockwise, the front where the grid's angle is 0."""

    def __init__(self, laser: Laser) -> None:
        self.laser = laser
        self.turning = True
        self.step = abs(laser.angle_increment)
        self.per_turn = round(2 * pi / self.step)
        whole = laser.n_beams >= self.per_turn
        low = -pi if whole else min(laser.angle_min, laser.angle_min + (laser.n_beams - 1) * laser.angle_increment)
        self.front = round(-low / self.step)
        self.last = laser.n_beams - 1
        self.scanning = b""
        self.received_bytes = b""

    def receive(self, data: bytes, now: int) -> bytes:
        *commands, self.received_bytes = (self.received_bytes + data).replace(b"\r", b"\n").split(b"\n")
        self.received_bytes = self.received_bytes[-32:]
        return b"".join(self._answer(command, now) for command in commands if command)

    def _answer(self, command: bytes, now: int) -> bytes:
        kind = command[:2]
        if command == b"SCIP2.0":
            return answer(command, b"0E", [])  # it speaks that already
        if kind == b"PP":
            laser = self.laser
            lines = (
                b"MODL:Emulated;",
                b"DMIN:%d;" % round(laser.range_min * 1000),
                b"DMAX:%d;" % round(laser.range_max * 1000),
                b"ARES:%d;" % self.per_turn,
                b"AMIN:0;",
                b"AMAX:%d;" % self.last,
                b"AFRT:%d;" % self.front,
                b"SCAN:%d;" % round(60 * laser.rate),
            )
            parameters = b"".join(
                line + sum_of(line[:-1]) + b"\n" for line in lines
            )  # the sum leaves the semicolon out
            return answer(command, b"00", [])[:-1] + parameters + b"\n"
        if kind in (b"QT", b"RS"):
            self.scanning = b""
            return answer(command, b"00", [])
        if kind == b"TM":
            return answer(command, b"00", [encoded(now // MS % (1 << 24), 4)] if command == b"TM1" else [])
        if kind == b"BM":
            return answer(command, b"00" if self.turning else MOTOR_FAULT, [])
        if kind == b"MD" and len(command) == 15 and command[2:].isdigit():
            first, last, cluster = int(command[2:6]), int(command[6:10]), int(command[10:12])
            if not first <= last <= self.last or cluster > 99:
                return answer(command, b"04", [])
            if not self.turning:
                return answer(command, MOTOR_FAULT, [])
            self.scanning = command
            return answer(command, b"00", [])
        return answer(command, b"0E", [])

    def sweep_chunks(self, scan: LaserScan, now: int) -> list[tuple[int, bytes]]:
        if not self.scanning or not self.turning:
            return []
        first, last, cluster = int(self.scanning[2:6]), int(self.scanning[6:10]), max(1, int(self.scanning[10:12]))
        angles = np.arange(first - self.front, last + 1 - self.front, dtype=np.float64) * self.step
        mm = np.rint(ranges_mm(scan, angles)).astype(int)
        mm[mm == 0] = 1 << 18
        mm = np.array([mm[i : i + cluster].min() for i in range(0, len(mm), cluster)])  # the nearest of a cluster
        mm[mm >= 1 << 18] = NOTHING
        text = b"".join(encoded(d, 3) for d in mm.tolist())
        blocks = [text[i : i + BLOCK] for i in range(0, len(text), BLOCK)]
        period = 1e9 / self.laser.rate
        behind = scan.stamp - round((first_angle(scan, 1) + pi) / (2 * pi) * period)
        clock = encoded(behind // MS % (1 << 24), 4)
        end = scan.stamp + round(scan.scan_time * 1e9)
        return [(end, answer(self.scanning, b"99", [clock, *blocks]))]
