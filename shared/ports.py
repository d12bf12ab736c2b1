# SPDX-License-Identifier: Apache-2.0
"""A service's ports: where bytes come from and go to. They are messages (topics RX, TX, PORT), so that they are
recorded and replayed as all else; only shared/runners/port.py opens the devices.
"""

from pydantic import Field

from shared.config import Section


class PortConfig(Section):
    """One port."""

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
        """Whether there is a device at all."""
        return bool(self.device or self.serial_number)

    @property
    def by_number(self) -> bool:
        """Whether the device is found by its adapter's number. Behind an address or a wire there is no adapter."""
        return bool(self.serial_number) and (not self.device or self.device.startswith("/"))

    @property
    def name(self) -> str:
        """For people."""
        return f"the adapter {self.serial_number}" if self.by_number else self.device
