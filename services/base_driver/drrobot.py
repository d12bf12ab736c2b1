# SPDX-License-Identifier: Apache-2.0
"""DATA of the DrRobot board's packets: decodes reports, encodes commands. Little-endian; units as in its driver."""

from struct import Struct
from typing import Literal, NamedTuple

from shared.drrobot import ADC_FULL, BOARD, Packet, Type, framed

NO_CHANGE = -32768
"""In a command to all channels: this channel keeps its command."""

N_CHANNELS = 6
NO_INFRARED_ECHO_M = 0.81  # m: value of the X80SV's driver without an echo

_MOTOR_SENSOR = Struct("<6H6H4HB")
_CUSTOM_SENSOR = Struct("<8HB")
_STANDARD_SENSOR = Struct("<6B4H2H2HHH4x5H")


class System(NamedTuple):
    """A code between the computers: 1 acknowledge, 0 ping, 2 urgent data, 3 a packet was skipped."""

    code: int


class MotorSensor(NamedTuple):
    """Six potentiometers (A/D), six motor currents (A), two encoders: position (counts), signed speed (counts/s)."""

    potentiometers: tuple[int, ...]
    currents: tuple[float, ...]
    counts: tuple[int, int]
    speeds: tuple[int, int]


class CustomSensor(NamedTuple):
    """Eight A/D channels, of which 2 to 7 are the infrared sensors 1 to 6 (m), and the digital inputs' bits."""

    channels: tuple[int, ...]
    infrared: tuple[float, ...]
    inputs: int


class StandardSensor(NamedTuple):
    """Six ultrasonic ranges (cm), human, tilt (A/D), temperatures (degrees C), infrared 0 (m), supplies (V)."""

    ultrasonic: tuple[int, ...]
    human: tuple[int, ...]
    tilt: tuple[int, ...]
    motor_temperatures: tuple[float, float]
    temperature: float
    infrared: float
    board_supply: float
    motor_supply: float
    servo_supply: float
    reference: float
    potentiometer_supply: float


BoardMessage = System | MotorSensor | CustomSensor | StandardSensor


def decode(packet: Packet) -> BoardMessage | None:
    """Content of a packet of the board; None if its type is unknown or its data too short."""
    kind, data = packet
    if kind == Type.MOTOR_SENSOR and len(data) >= _MOTOR_SENSOR.size:
        values = _MOTOR_SENSOR.unpack_from(data)
        left, left_speed, right, right_speed, directions = values[12:]
        speeds = _signed(left_speed, directions & 1), _signed(right_speed, directions & 2)
        return MotorSensor(values[:6], tuple(value / 728 for value in values[6:12]), (left, right), speeds)
    if kind == Type.CUSTOM_SENSOR and len(data) >= _CUSTOM_SENSOR.size:
        values = _CUSTOM_SENSOR.unpack_from(data)
        return CustomSensor(values[:8], tuple(infrared_metres(value) for value in values[2:8]), values[8])
    if kind == Type.STANDARD_SENSOR and len(data) >= _STANDARD_SENSOR.size:
        values = _STANDARD_SENSOR.unpack_from(data)
        volts = [value * full / ADC_FULL for value, full in zip(values[16:], (9, 24, 9, 6, 6))]
        return StandardSensor(
            ultrasonic=values[:6],
            human=values[6:10],
            tilt=values[10:12],
            motor_temperatures=(motor_degrees(values[12]), motor_degrees(values[13])),
            temperature=ambient_degrees(values[14]),
            infrared=infrared_metres(values[15]),
            board_supply=volts[0],
            motor_supply=volts[1],
            servo_supply=volts[2],
            reference=volts[3],
            potentiometer_supply=volts[4],
        )
    if kind == Type.SYSTEM and data:
        return System(data[0])
    return None


def _signed(speed: int, forward: int) -> int:
    return speed if forward else -speed


def infrared_metres(reading: int) -> float:
    """Range (m) of an infrared sensor's A/D reading; INFRARED_NOTHING without an echo."""
    volts_above = reading * 3 / 4096 - 0.17
    if 80 * volts_above < 21.6:  # farther than 80 cm
        return NO_INFRARED_ECHO_M
    centimetres = 21.6 / volts_above
    return 0.09 if centimetres < 10 else centimetres / 100


def motor_degrees(reading: int) -> float:
    """Degrees C of a motor driver's temperature sensor: T = 100 - (reading - 980) / 11.6, PMS5005 SDK reference."""
    return 100 - (reading - 980) / 11.6


def ambient_degrees(reading: int) -> float:
    """Degrees C of the DA5280 ambient temperature sensor: T = (reading - 1256) / 34.8, PMS5005 SDK reference."""
    return (reading - 1256) / 34.8


def acknowledgement() -> bytes:
    """The packet that acknowledges a ping of the board."""
    return framed(BOARD, Type.SYSTEM, b"\x01")


def command_all(kind: Type, left: float, right: float, milliseconds: int | None = None) -> bytes:
    """A command (VELOCITY_ALL in counts/s, PWM_ALL, POSITION_ALL) to both wheels' channels, the others left alone.

    milliseconds: lifetime of the command on the board; None: until the next command.
    """
    channels = _int16(left), _int16(right), *(NO_CHANGE,) * (N_CHANNELS - 2)
    limit = () if milliseconds is None else (milliseconds,)
    return framed(BOARD, kind, Struct(f"<6h{len(limit)}H").pack(*channels, *limit))


def command_one(kind: Type, channel: int, command: float, milliseconds: int | None = None) -> bytes:
    """A command (VELOCITY_ONE in counts/s, PWM_ONE, POSITION_ONE) to one channel; `milliseconds` as above."""
    data = Struct("<Bh").pack(channel, _int16(command))
    limit = b"" if milliseconds is None else Struct("<BH").pack(0x1C, milliseconds)
    return framed(BOARD, kind, data + limit)


def set_gains(control: Literal["velocity", "position"], channel: int, kp: int, kd: int, ki: int) -> bytes:
    """A packet that sets the controller's gains of one channel."""
    code = {"velocity": 0x08, "position": 0x07}[control]
    return framed(BOARD, Type.GAINS, Struct("<BBBhBhBh").pack(code, channel, 1, kp, 2, kd, 3, ki))


def disable_motor(channel: int) -> bytes:
    """A packet that switches off the power of a motor."""
    return framed(BOARD, Type.DISABLE, bytes((0, channel)))


def _int16(command: float) -> int:
    """The command, rounded and limited to int16 without NO_CHANGE."""
    return min(max(round(command), NO_CHANGE + 1), -NO_CHANGE - 1)
