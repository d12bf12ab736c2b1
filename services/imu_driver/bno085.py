# SPDX-License-Identifier: Apache-2.0
"""CEVA BNO080, BNO085 and BNO086 in mode UART-RVC: 100 packets a second at 115200 baud, without any command.

Packet (BNO080 data sheet 1000-3927, section 1.3.5.2), 19 bytes, little-endian:

    AA AA | index u8 | yaw i16, pitch i16, roll i16: 0.01 degree | x i16, y i16, z i16: 0.001 g | 3 reserved | sum u8

The sum is of the bytes from the index on. The sensor reports an angle, so the rate is the mean since the last reading.
The readings add up to what the angle turned.
"""

import struct
from math import pi, radians

from services.imu_driver.device import GRAVITY, Reading, ReadingCounts

HEADER = b"\xaa\xaa"
LENGTH = 19
TURN = 36000  # 0.01 degree
MIN_PERIOD_NS = 15_000_000
"""Between two readings: packets that came in one piece have no times of their own."""
MAX_GAP_NS = 500_000_000
MAX_RATE = 40.0  # rad/s


def checksum(body: bytes) -> int:
    """Of the bytes between header and sum."""
    return sum(body) & 0xFF


class Bno085:
    """A BNO08x in mode UART-RVC (pins PS0 high, PS1 low)."""

    def __init__(self, baud: int) -> None:
        self.counts = ReadingCounts()
        self.fault = ""
        self._byte_time = 10e9 / baud  # ns
        self.start(0)

    def start(self, now: int) -> bytes:
        self._buffer = b""
        self._last: tuple[int, int] | None = None  # ns, and yaw in 0.01 degree, of the last reading
        return b""

    def next_command(self, now: int) -> bytes:
        return b""

    def receive(self, data: bytes, now: int) -> list[Reading]:
        self._buffer += data
        newest: tuple[bytes, int] | None = None  # packet, bytes after it
        while (at := self._buffer.find(HEADER)) >= 0 and len(self._buffer) - at >= LENGTH:
            packet = self._buffer[at : at + LENGTH]
            if checksum(packet[2:-1]) != packet[-1]:
                self.counts.n_bad += 1
                self._buffer = self._buffer[at + 1 :]
                continue
            self._buffer = self._buffer[at + LENGTH :]
            self.counts.n_good += 1
            newest = packet, len(self._buffer)
        self._buffer = self._buffer[-LENGTH:]
        if newest is None:
            return []
        return self._reading(newest[0], max(now - round((newest[1] + LENGTH) * self._byte_time), 0))

    def _reading(self, packet: bytes, stamp: int) -> list[Reading]:
        yaw, _, _, *force = struct.unpack_from("<6h", packet, 3)
        last = self._last
        if last is not None and 0 <= stamp - last[0] < MIN_PERIOD_NS:
            return []
        self._last = stamp, yaw
        if last is None or not 0 < stamp - last[0] <= MAX_GAP_NS:
            return []
        turn = (yaw - last[1] + TURN // 2) % TURN - TURN // 2
        rate = radians(turn / 100) / ((stamp - last[0]) * 1e-9)
        x, y, z = (milli_g * 1e-3 * GRAVITY for milli_g in force)
        reading = Reading(stamp, rate, x, y, z)
        if not reading.is_plausible or abs(rate) > min(MAX_RATE, pi / ((stamp - last[0]) * 1e-9)):
            self.counts.n_bad += 1
            return []
        return [reading]
