# SPDX-License-Identifier: Apache-2.0
"""Neato XV-11, firmware 2.x: streams while its motor turns, counter-clockwise, four beams a packet.

Packet, 22 bytes, little-endian:

    FA | index A0..F9, four degrees each | speed u16, rpm * 64
    4 x (distance 14 bits mm, bit 14 weak, bit 15 invalid; strength u16) | checksum u16

The device has no clock; times follow from its rotation.
"""

from typing import cast

import numpy as np

from services.lidar_driver.device import Returns, differences
from services.lidar_driver.packet_device import PacketDevice
from shared.types import Bools, UInt8s

LENGTH = 22
N_PACKETS = 90  # packets a turn
N_BEAMS = 4
MIN_RPM = 180.0  # the firmware measures nothing at a lower speed
PACKET = np.dtype(
    [
        ("start", "u1"), ("index", "u1"), ("speed", "<u2"), ("beams", [("mm", "<u2"), ("strength", "<u2")], N_BEAMS),
        ("sum", "<u2"),
    ]
)  # fmt: skip
FROM_FIRST, TO_LAST = np.arange(N_BEAMS), np.arange(1 - N_BEAMS, 1) / N_BEAMS  # beams; packets
INVALID = 0x8000
SHIFTS = np.arange(9, -1, -1)


def is_header(first: UInt8s, second: UInt8s) -> Bools:
    """(k,), (k,) -> (k,): whether two bytes are the start byte and a valid index."""
    return cast(Bools, (first == 0xFA) & (second >= 0xA0) & (second < 0xA0 + N_PACKETS))


def is_checksum_valid(packets: UInt8s) -> Bools:
    """(p, 22) -> (p,): whether the checksum of the ten words before it is correct."""
    words = packets.view("<u2").astype(np.int64)
    total = (words[:, :10] << SHIFTS).sum(axis=1)
    return cast(Bools, ((total & 0x7FFF) + (total >> 15)) & 0x7FFF == words[:, 10])


class Xv11(PacketDevice):
    """An XV-11 on a serial line."""

    clockwise = False

    def __init__(self, baud: int) -> None:
        super().__init__(baud, LENGTH, is_header, is_checksum_valid)

    def receive(self, data: bytes, now: int) -> list[Returns]:
        packets, after = self.framing.extract(data)
        if not len(packets):
            return []
        fields = packets.view(PACKET)[:, 0]
        index = fields["index"].astype(np.int64) - 0xA0
        rpm = fields["speed"] / 64
        self.speed = float(rpm[-1]) / 60
        slow = rpm[-1] < MIN_RPM
        self.fault = f"the laser turns too slowly: {rpm[-1]:.0f} rpm, it needs {MIN_RPM:.0f}" if slow else ""
        durations = 60 / N_PACKETS / np.maximum(rpm, MIN_RPM / 6)
        since_last = differences(index, int(index[0]) - 1 if self.last is None else self.last)
        ends = self.time + np.cumsum(((since_last - 1) % N_PACKETS + 1) * durations)
        self.last, self.time = int(index[-1]), float(ends[-1])
        beams = fields["beams"].ravel()
        words = beams["mm"]
        mm = words & 0x3FFF
        invalid = words & INVALID > 0
        returns = Returns(
            angles=np.radians((index[:, None] * N_BEAMS + FROM_FIRST).ravel()),
            ranges=np.where(invalid | (mm == 0), np.nan, mm * 1e-3).astype(np.float32),
            intensities=np.where(invalid, 0, beams["strength"]).astype(np.float32),
            times=(ends[:, None] + durations[:, None] * TO_LAST).ravel(),
            sent=ends,
            ages=np.asarray((after + LENGTH) * self.byte_time, np.float64),
        )
        return [returns]
