# SPDX-License-Identifier: Apache-2.0
"""The DrRobot board's side of its protocol: what it measures as packets, and what the commands to it mean."""

from dataclasses import dataclass
from struct import Struct

from shared.drrobot import ADC_FULL, PC, Packet, Type, framed

PING, ACKNOWLEDGE = 0, 1
NO_CHANGE = -32768  # a command that changes nothing
NO_ECHO = 255  # cm

_MOTORS = Struct("<6H6H4HB")
_CUSTOM = Struct("<8HB")
_STANDARD = Struct("<6B4H2H2HHH4x5H")


def system(code: int) -> bytes:
    """A word to the computer: PING or ACKNOWLEDGE."""
    return framed(PC, Type.SYSTEM, bytes((code,)))


def motor_sensor(counts: tuple[int, int], speeds: tuple[float, float], currents: tuple[float, float]) -> bytes:
    """Encoder counts (0..65535), counts/s and amperes of the left and the right wheel."""
    amperes = [_reading(ampere * 728, 65535) for ampere in currents]
    left, right = (_reading(abs(speed), 65535) for speed in speeds)
    directions = (speeds[0] > 0) | (speeds[1] > 0) << 1
    data = _MOTORS.pack(*(0,) * 6, *amperes, *(0,) * 4, counts[0], left, counts[1], right, directions)
    return framed(PC, Type.MOTOR_SENSOR, data)


def custom_sensor(infrared: tuple[float, ...]) -> bytes:
    """The infrared sensors 1 to 6, m, NaN where they see nothing."""
    return framed(PC, Type.CUSTOM_SENSOR, _CUSTOM.pack(0, 0, *(infrared_reading(metres) for metres in infrared), 0))


def standard_sensor(ultrasonic: tuple[int, ...], infrared: float, battery: float, degrees: float) -> bytes:
    """Six sonars, cm; infrared sensor 0, m or NaN; the battery at the motors, V; degrees C everywhere.

    Of the supplies only the motors' can be over 9 V: the others are regulated.
    """
    motor = _reading(980 + 11.6 * (100 - degrees), ADC_FULL)
    volts = (min(battery, 7.2), battery, 5.0, 5.0, 5.0)
    supplies = (_reading(volt * ADC_FULL / full, ADC_FULL) for volt, full in zip(volts, (9, 24, 9, 6, 6)))
    data = _STANDARD.pack(
        *ultrasonic, *(0,) * 4, 2048, 2048, motor, motor, _reading(1256 + 34.8 * degrees, ADC_FULL),
        infrared_reading(infrared), *supplies,
    )  # fmt: skip
    return framed(PC, Type.STANDARD_SENSOR, data)


def infrared_reading(metres: float) -> int:
    """What the A/D converter reads of an infrared sensor: nothing in sight is a low voltage."""
    if not 0.0 < metres < 0.8:
        return 0
    return _reading((21.6 / (100 * max(metres, 0.08)) + 0.17) * 4096 / 3, ADC_FULL)


def _reading(value: float, full: int) -> int:
    return min(max(round(value), 0), full)


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Counts/s by channel (KEEP: as it was), and how many seconds it holds; None: until the next."""

    channels: dict[int, int]
    life: float | None


@dataclass(frozen=True, slots=True)
class GainsCommand:
    """Kp, Kd, Ki of a channel's velocity controller."""

    channel: int
    kp: int
    kd: int
    ki: int


@dataclass(frozen=True, slots=True)
class DisableCommand:
    """A motor without power."""

    channel: int


def decode_command(packet: Packet) -> VelocityCommand | GainsCommand | DisableCommand | None:
    """What a packet to the board asks of its motors; None where it asks nothing that this board does."""
    kind, data = packet
    if kind == Type.VELOCITY_ALL and len(data) in (12, 14):
        life = Struct("<H").unpack_from(data, 12)[0] / 1e3 if len(data) == 14 else None
        return VelocityCommand(dict(enumerate(Struct("<6h").unpack_from(data))), life)
    if kind == Type.VELOCITY_ONE and len(data) in (3, 6):
        channel, command = Struct("<Bh").unpack_from(data)
        return VelocityCommand(
            {channel: command}, Struct("<H").unpack_from(data, 4)[0] / 1e3 if len(data) == 6 else None
        )
    if kind == Type.GAINS and len(data) == 11:
        control, channel, _, kp, _, kd, _, ki = Struct("<BBBhBhBh").unpack(data)
        return GainsCommand(channel, kp, kd, ki) if control == 0x08 else None
    if kind == Type.DISABLE and len(data) == 2:
        return DisableCommand(data[1])
    return None
