# SPDX-License-Identifier: Apache-2.0
"""Kobuki, the base of TurtleBot 2: streams its sensors 50 times a second, takes a speed and a radius.

Bytes: AA 55, length, sub-payloads (identifier, length, data), XOR of all bytes after AA 55. Little-endian. The layouts
are those of kobuki_driver's documentation, appendix "Protocol Specification" (docs.ros.org/en/api/kobuki_driver), 2012.
"""

from math import nan, radians
from struct import Struct

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardContacts, BoardInput, WheelDevice, bit_names
from shared.board_framing import PacketReader, xor
from shared.config import Robot

HEADER = b"\xaa\x55"
BASE_CONTROL, BASIC_SENSORS, INERTIAL_SENSOR = 1, 1, 4  # identifiers of sub-payloads
BIAS_MM = 230.0  # distance of the wheels with which the board converts speed and radius
MAX_INT16 = 32767
RATE_UNIT = radians(0.01)  # rad/s of a step of the gyro's rate
WRAP_MS = 65536
MAX_CLOCK_STEP_MS = 1000  # ms by which the board's clock may step beyond the time that passed; more is a restart
BUMPERS = CLIFFS = {"right": 1, "front": 2, "left": 4}
WHEEL_DROPS = {"right_wheel_drop": 1, "left_wheel_drop": 2}
OVERCURRENTS = {"left": 1, "right": 2}

_BASIC = Struct("<HBBBHHbbBBBB")
_INERTIAL = Struct("<hh")
_CONTROL = Struct("<BBhh")


class KobukiBoard(WheelDevice):
    """Encodes base control, decodes basic and inertial sensor data."""

    NAME = "kobuki"
    WRAP = 65536
    starts_again = False  # it reports by itself

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self._reader = PacketReader(HEADER, range(3, 256), lambda packet: xor(packet[2:]) == 0, self.counts)
        self._last: tuple[int, int] | None = None  # board's ms, and ns when they came; the port may have closed since
        self._clock_ms = 0  # the board's clock, unwrapped

    def forget(self) -> None:
        super().forget()
        self._reader.forget()

    def start_command(self) -> bytes:
        return control_packet(0.0, 0.0)

    def stop_command(self) -> bytes:
        return control_packet(0.0, 0.0)

    def command(self, left: float, right: float, now: int) -> bytes:
        return control_packet(*self.body_velocity(left, right))

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        received = BoardInput()
        for payload in self._reader.packets(data):
            for identifier, content in sub_payloads(payload):
                if identifier == BASIC_SENSORS and len(content) >= _BASIC.size:
                    self._decode_basic(content, stamp, now, received)
                elif identifier == INERTIAL_SENSOR and len(content) >= _INERTIAL.size:
                    received.yaw_rate = _INERTIAL.unpack_from(content)[1] * RATE_UNIT
        return received

    def _decode_basic(self, content: bytes, stamp: int, now: int, received: BoardInput) -> None:
        (ms, bumper, wheel_drop, cliff, left, right, _, _, _, _, battery, overcurrent) = _BASIC.unpack_from(content)
        step = 0
        if self._last is not None:
            step = (ms - self._last[0]) % WRAP_MS
            if is_restart(step, (now - self._last[1]) * 1e-6):
                received.restarted = True
                super().forget()
        self._clock_ms += step
        self._last = ms, now
        self.battery = battery * 0.1 if battery else nan
        currents = " and ".join(bit_names(overcurrent, OVERCURRENTS))
        self.fault = f"the board reports too much current of the {currents} wheel" if currents else ""
        cliffs = bit_names(cliff, CLIFFS) + bit_names(wheel_drop, WHEEL_DROPS)
        received.contacts = BoardContacts(bit_names(bumper, BUMPERS), cliffs)
        received.report = self.report(stamp, left, right, self._clock_ms * 1e-3)
        received.n_reports += 1


def is_restart(step: int, elapsed: float) -> bool:
    """Whether the board's clock stepped (ms, modulo WRAP_MS) as none does that ran on for `elapsed` ms.

    Bytes may come late, so a small step is no restart. After half of WRAP_MS only a step that fits is none.
    """
    ahead = step - elapsed
    if elapsed > WRAP_MS / 2:
        ahead = abs((ahead + WRAP_MS / 2) % WRAP_MS - WRAP_MS / 2)
    return ahead > MAX_CLOCK_STEP_MS


def control_packet(v: float, w: float) -> bytes:
    """The packet that commands v (m/s) and w (rad/s), as speed (mm/s) of the outer wheel and radius (mm).

    Radius 0: straight.  Radius 1: on the spot, with the speed of the right wheel.
    """
    speed, radius = v * 1e3, 0.0
    if w != 0.0 and abs(v * 1e3 / w) <= MAX_INT16:
        radius = v * 1e3 / w
        if abs(radius) <= 1.0:
            speed, radius = w * BIAS_MM / 2, 1.0
        else:
            speed = (radius + (BIAS_MM if radius > 0 else -BIAS_MM) / 2) * w
    speed_mm = min(max(round(speed), -MAX_INT16), MAX_INT16)
    payload = _CONTROL.pack(BASE_CONTROL, 4, speed_mm, round(radius))
    body = bytes((len(payload),)) + payload
    return HEADER + body + bytes((xor(body),))


def sub_payloads(payload: bytes) -> list[tuple[int, bytes]]:
    """Identifier and data of each sub-payload; an incomplete one is left out."""
    found, at = [], 0
    while at + 2 <= len(payload) and at + 2 + payload[at + 1] <= len(payload):
        found.append((payload[at], payload[at + 2 : at + 2 + payload[at + 1]]))
        at += 2 + payload[at + 1]
    return found
