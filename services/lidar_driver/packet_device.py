# SPDX-License-Identifier: Apache-2.0
"""Base of lasers that stream packets of fixed length without any command."""

from collections.abc import Callable

from services.lidar_driver.device import PacketCounts
from services.lidar_driver.packet_framing import PacketFramer
from shared.types import Bools, UInt8s


class PacketDevice:
    """State between readings. length, is_header, is_checksum_valid: arguments of PacketFramer.

    speed: turns/s.  last: index or ticks of the last packet.
    time: s on the device's clock, unwrapped, when the last packet was complete.
    """

    scanning = True
    clock_reading = None

    def __init__(
        self,
        baud: int,
        length: int,
        is_header: Callable[[UInt8s, UInt8s], Bools],
        is_checksum_valid: Callable[[UInt8s], Bools],
    ) -> None:
        self.counts = PacketCounts()
        self.byte_time = 10.0 / baud  # s
        self.fault = ""
        self._packets = length, is_header, is_checksum_valid
        self.start(0)

    def start(self, now: int) -> bytes:
        self.framing = PacketFramer(*self._packets, self.counts)
        self.speed: float | None = None
        self.last: int | None = None
        self.time = 0.0
        return b""

    def next_command(self, now: int) -> bytes:
        return b""

    def stop_command(self) -> bytes:
        return b""
