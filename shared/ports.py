# SPDX-License-Identifier: Apache-2.0
"""Configuration of a service's ports: serial devices and sockets.

Their bytes are messages (topics RX, TX, PORT), so they are recorded and replayed. Only shared/runners/port.py opens
devices, and the shell of a service that brings its own kind of device (shared/runners/devices.py).
"""

from pydantic import Field

from shared.config import Section


class PortConfig(Section):
    """One port: its device and line settings."""

    device: str = Field(
        "",
        description="/dev/ttyUSB0, socket://HOST:PORT, udp://HOST:PORT; of an emulator: pty:LINK, listen://HOST:PORT; "
        "empty: none",
    )
    baud: int = Field(115200, ge=300, le=4_000_000, description="baud, 8N1")
    dtr: bool = Field(True, description="level of the line DTR; an RPLIDAR A1 wants false for its motor")
    serial_number: str = Field(
        "", description="of the USB adapter: it is found by this under whatever name it comes back"
    )

    @property
    def given(self) -> bool:
        """Whether a device is configured."""
        return bool(self.device or self.serial_number)

    @property
    def kind(self) -> str:
        """Kind of a device that is no file: `udp` of udp://HOST:PORT; empty for a path."""
        kind, separator, _ = self.device.partition("://")
        return kind if separator else ""

    @property
    def by_number(self) -> bool:
        """Whether the device is identified by the serial number of its USB adapter."""
        return bool(self.serial_number) and (not self.device or self.device.startswith("/"))

    @property
    def name(self) -> str:
        """Name of the device in messages to the user."""
        return f"the adapter {self.serial_number}" if self.by_number else self.device
