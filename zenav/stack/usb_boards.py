# SPDX-License-Identifier: Apache-2.0
"""Which board or laser is a serial adapter likely to be? By its USB ids and its maker's serial number."""

from typing import Any

BOARDS_BY_USB_ID: dict[tuple[int, int | None], str] = {
    (0x2341, None): "Arduino: base_driver.board.model velocity or ros_arduino_bridge",
    (0x2A03, None): "Arduino: base_driver.board.model velocity or ros_arduino_bridge",
    (0x2E8A, None): "Raspberry Pi Pico: base_driver.board.model velocity",
    (0x03EB, 0x2404): "RoboClaw: base_driver.board.model roboclaw",
    (0x10C4, 0xEA60): "CP210x: often a laser's (RPLIDAR, YDLIDAR, LD06)",
    (0x1209, 0x0D32): "ODrive: base_driver.board.model odrive",
}
"""(vendor, product) by the list of USB ids, linux-usb.org/usb.ids, and pid.codes; product None: any."""
KOBUKI_SERIAL = "kobuki"  # how the serial numbers of Kobuki's adapters begin


def adapter_text(port: Any) -> str:
    """The device of a port of pyserial's list, with what it is likely to be where its ids show it."""
    serial_number = getattr(port, "serial_number", None) or ""
    vendor, product = getattr(port, "vid", None), getattr(port, "pid", None)
    if serial_number.lower().startswith(KOBUKI_SERIAL):
        likely = "Kobuki: base_driver.board.model kobuki"
    elif vendor is None:
        return str(port.device)
    else:
        likely = BOARDS_BY_USB_ID.get((vendor, product)) or BOARDS_BY_USB_ID.get((vendor, None), "")
    words = ", ".join(word for word in (likely, f"serial number {serial_number}" if serial_number else "") if word)
    return f"{port.device} ({words})" if words else str(port.device)
