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
