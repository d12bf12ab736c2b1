# SPDX-License-Identifier: Apache-2.0
"""LDROBOT LD06, LD19, LD14 and STL-27L: streams without commands, clockwise, 12 beams a packet, with its own clock.

Packet (development manuals of LD19, section 3.2, of LD14 and of STL-27L), 47 bytes, little-endian:

    54 2C | speed u16 deg/s | first angle u16 0.01 deg | 12 x (distance u16 mm, intensity u8)
    last angle u16 0.01 deg | time u16 ms, 0 to 29999 | CRC-8, polynomial 0x4D
"""

from typing import cast

import numpy as np

from services.lidar_driver.device import Returns, unwrapped_ticks
from services.lidar_driver.packet_device import PacketDevice
from shared.types import Bools, Float64s, UInt8s

LENGTH = 47
N_BEAMS = 12
TIME_WRAP = 30000  # ticks
TICK = 1e-3  # s; times are rounded down, so on average half a tick is missing
PACKET = np.dtype(
    [
        ("header", "<u2"), ("speed", "<u2"), ("first", "<u2"), ("beams", [("mm", "<u2"), ("intensity", "u1")], N_BEAMS),
        ("last", "<u2"), ("time", "<u2"), ("sum", "u1"),
    ]
)  # fmt: skip
SAMPLES = {"ld06": 4500, "ld14": 2300, "stl27l": 21600}  # a second
MAX_STEP_SHARE = 3.0  # of the step that speed and samples give (the LD19 manual's example has 2); more is no packet


def _tables() -> UInt8s:
    """(46, 256): contribution of each byte at each position to the CRC; a CRC is linear, so contributions are xored."""
    last_byte = np.zeros(256, np.uint8)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = (crc << 1 ^ (0x4D if crc & 0x80 else 0)) & 0xFF
        last_byte[value] = crc
    rows = [last_byte]
    for _ in range(LENGTH - 2):
        rows.append(last_byte[rows[-1]])
    return np.array(rows[::-1])


TABLES = _tables()
PLACES = np.arange(LENGTH - 1)
FROM_FIRST, TO_LAST = np.arange(N_BEAMS), np.arange(1 - N_BEAMS, 1)  # beams


def is_checksum_valid(packets: UInt8s) -> Bools:
    """(p, 47) -> (p,): whether the CRC is correct."""
    return cast(Bools, np.bitwise_xor.reduce(TABLES[PLACES, packets[:, :-1]], axis=1) == packets[:, -1])


def is_header(first: UInt8s, second: UInt8s) -> Bools:
    """(k,), (k,) -> (k,): whether two bytes are the header and the version with 12 beams."""
    return cast(Bools, (first == 0x54) & (second == 0x2C))


class Ld06(PacketDevice):
    """An LD06, LD19, LD14 or STL-27L on a serial line. They differ in baud and in beams a second."""

    clockwise = True

    def __init__(self, baud: int, samples: int) -> None:
        """samples: a second."""
        super().__init__(baud, LENGTH, is_header, is_checksum_valid)
        self.max_step = 100 * MAX_STEP_SHARE / samples  # 0.01 degree, at 1 degree/s

    def receive(self, data: bytes, now: int) -> list[Returns]:
        packets, after = self.framing.extract(data)
        if not len(packets):
            return []
        fields = packets.view(PACKET)[:, 0]
        speed, first, last, ticks = (fields[key].astype(np.int64) for key in ("speed", "first", "last", "time"))
        steps = (last - first) % 36000 / (N_BEAMS - 1)
        # half a packet with the begin of the next one has a valid CRC once in 256 times
        plausible = (speed == 0) | (steps < self.max_step * speed)
        if not plausible.all():
            after, fields, steps = after[plausible], fields[plausible], steps[plausible]
            speed, first, last, ticks = speed[plausible], first[plausible], last[plausible], ticks[plausible]
        if not len(fields):
            return []
        self.speed = float(speed[-1]) / 360.0
        turning = (speed > 0) & (steps > 0)
        elapsed, restarted = unwrapped_ticks(ticks, self.last, TIME_WRAP, most_back=0)
        times: Float64s = np.asarray(self.time + elapsed * TICK, np.float64)
        self.last, self.time = int(ticks[-1]), float(times[-1])
        if not turning.all():
            after, times, fields = after[turning], times[turning], fields[turning]
            speed, first, steps = speed[turning], first[turning], steps[turning]
        if not len(fields):
            return []
        degrees = (first[:, None] + steps[:, None] * FROM_FIRST) * 0.01
        to_last = TO_LAST * (steps / 100 / speed)[:, None]  # s; the packet's time is its last beam's
        beams = fields["beams"].ravel()
        mm = beams["mm"]
        returns = Returns(
            angles=-np.radians(degrees).ravel(),
            ranges=np.where(mm > 0, mm * 1e-3, np.nan).astype(np.float32),
            intensities=beams["intensity"].astype(np.float32),
            times=(times[:, None] + TICK / 2 + to_last).ravel(),
            sent=times,
            ages=np.asarray((after + LENGTH) * self.byte_time, np.float64),
            restarted=restarted,
        )
        return [returns]
