# SPDX-License-Identifier: Apache-2.0
"""What the board's packets say and what is said to it: the published examples and the conversions' laws."""

from struct import pack

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.base_driver import drrobot
from services.base_driver.drrobot import CustomSensor, MotorSensor, StandardSensor, System, decode
from services.sim.hardware import drrobot as other_end
from shared.drrobot import BOARD, PC, Deframer, Packet, Type
from tests.unit.shared.test_drrobot import EXAMPLES

u16 = st.integers(0, 65535)
readings = st.integers(0, 4095)


def bytes_of(name):
    return bytes.fromhex(EXAMPLES[name])


def test_the_published_commands_to_the_byte():
    assert drrobot.acknowledgement() == bytes_of("acknowledge")
    assert drrobot.command_all(Type.VELOCITY_ALL, -200.0, 200.0) == bytes_of("forward")
    assert drrobot.command_all(Type.VELOCITY_ALL, 0.0, 0.0) == bytes_of("stop")
    assert drrobot.set_gains("velocity", 0, kp=15, kd=0, ki=0) == bytes_of("gains")
    assert drrobot.disable_motor(1) == bytes_of("disable")


def test_the_published_motor_sensor_packet():
    (packet,) = Deframer(PC).packets(bytes_of("motors"))
    motors = decode(packet)
    assert motors == MotorSensor((0,) * 6, (1.0, 0.5, 0, 0, 0, 0), (1000, 32000), (-50, 60))


def test_each_gain_has_its_place():
    data = drrobot.set_gains("position", 1, kp=500, kd=5, ki=10000)[6:-3]
    assert data == bytes.fromhex("07 01 01 f4 01 02 05 00 03 10 27")
    assert drrobot.set_gains("velocity", 1, 1, 2, 3)[6] == 0x08


def test_a_time_limit_makes_a_command_to_all_14_bytes_long():
    data = drrobot.command_all(Type.VELOCITY_ALL, -200.0, 200.0, 200)
    assert data[4:8] == bytes.fromhex("1b 0e 38 ff")
    assert data[6:-3] == bytes_of("forward")[6:-3] + bytes.fromhex("c8 00")


def test_commands_to_one_channel():
    assert drrobot.command_one(Type.VELOCITY_ONE, 1, -200.0)[4:-3] == bytes.fromhex("1a 03 01 38 ff")
    assert drrobot.command_one(Type.PWM_ONE, 0, 300.0, 513)[4:-3] == bytes.fromhex("05 06 00 2c 01 1c 01 02")
    assert drrobot.command_all(Type.PWM_ALL, 0.0, 0.0)[4] == 0x06


@given(st.floats(-1e6, 1e6))
def test_a_command_is_rounded_bounded_and_never_leave_alone(speed):
    data = drrobot.command_all(Type.VELOCITY_ALL, speed, -speed)[6:-3]
    left, right = (int.from_bytes(data[i : i + 2], "little", signed=True) for i in (0, 2))
    assert left == max(-32767, min(32767, round(speed)))
    assert right == -left


def test_every_byte_of_a_motor_sensor_packet_has_its_meaning():
    values = [*range(1, 7), *(728 * k for k in range(1, 7)), 1001, 51, 2002, 62]
    motors = decode(Packet(0x7B, pack("<16HB", *values, 0b01)))
    assert motors == MotorSensor((1, 2, 3, 4, 5, 6), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), (1001, 2002), (51, -62))
    assert decode(Packet(0x7B, pack("<16HB", *values, 0b10))).speeds == (-51, 62)
    assert decode(Packet(0x7B, pack("<16HB", *values, 0b11111100))).speeds == (-51, -62)


def test_every_byte_of_a_custom_sensor_packet_has_its_meaning():
    channels = (10, 20, 300, 500, 700, 900, 1100, 1300)
    custom = decode(Packet(0x7C, pack("<8HB", *channels, 0xA5)))
    assert custom.channels == channels
    assert custom.inputs == 0xA5
    assert custom.infrared == tuple(drrobot.infrared_metres(c) for c in channels[2:])


def test_every_byte_of_a_standard_sensor_packet_has_its_meaning():
    data = bytearray(40)
    data[0:6] = bytes((50, 60, 70, 80, 90, 255))
    for i, value in enumerate((101, 102, 103, 104, 201, 202, 980, 864, 1256, 1100), start=0):
        data[6 + 2 * i : 8 + 2 * i] = value.to_bytes(2, "little")
    for i, value in zip((30, 32, 34, 36, 38), (4095, 1365, 2730, 4095, 1365)):
        data[i : i + 2] = value.to_bytes(2, "little")
    standard = decode(Packet(0x7D, bytes(data)))
    assert standard.ultrasonic == (50, 60, 70, 80, 90, 255)
    assert standard.human == (101, 102, 103, 104)
    assert standard.tilt == (201, 202)
    assert standard.motor_temperatures == (100.0, 110.0)
    assert standard.temperature == 0.0
    assert standard.infrared == drrobot.infrared_metres(1100)
    assert (standard.board_supply, standard.motor_supply, standard.servo_supply) == pytest.approx((9.0, 8.0, 6.0))
    assert (standard.reference, standard.potentiometer_supply) == pytest.approx((6.0, 2.0))


def test_words_are_unsigned():
    motors, custom, standard = (decode(Packet(kind, b"\xff" * 40)) for kind in (0x7B, 0x7C, 0x7D))
    assert motors == MotorSensor((65535,) * 6, (65535 / 728,) * 6, (65535, 65535), (65535, 65535))
    assert (custom.channels, custom.inputs) == ((65535,) * 8, 255)
    assert (standard.ultrasonic, standard.human, standard.tilt) == ((255,) * 6, (65535,) * 4, (65535,) * 2)
    assert standard.motor_temperatures[0] == standard.motor_temperatures[1] == 100 - (65535 - 980) / 11.6
    assert standard.temperature == (65535 - 1256) / 34.8
    assert standard.motor_supply == pytest.approx(24 * 65535 / 4095)


def test_temperatures():
    assert drrobot.motor_degrees(980) == 100
    assert drrobot.motor_degrees(980 + 116) == 90
    assert drrobot.ambient_degrees(1256) == 0
    assert drrobot.ambient_degrees(1256 + 348) == pytest.approx(10)


@pytest.mark.parametrize(
    ("reading", "metres"),
    [
        (0, 0.81),  # negative: nothing
        (232, 0.81),  # 0.17 V: infinitely far
        (600, 0.81),  # 80.2 cm
        (601, 21.6 / (601 * 3 / 4096 - 0.17) / 100),
        (1000, 21.6 / (1000 * 3 / 4096 - 0.17) / 100),
        (4095, 0.09),
        (3181, 0.1000),  # 10.0 cm
        (3182, 0.09),
    ],
)
def test_infrared_readings(reading, metres):
    assert drrobot.infrared_metres(reading) == pytest.approx(metres, abs=1e-5)


@given(readings, readings)
def test_more_volts_are_never_farther(a, b):
    near, far = drrobot.infrared_metres(max(a, b)), drrobot.infrared_metres(min(a, b))
    assert 0.09 <= near <= far <= 0.81


@given(st.floats(0.11, 0.79))
def test_infrared_survives_the_way_through_the_converter(metres):
    assert drrobot.infrared_metres(other_end.infrared_reading(metres)) == pytest.approx(metres, rel=0.01)


@given(st.integers(0, 255), st.binary(max_size=255))
@settings(max_examples=300)
def test_any_packet_is_survived_and_more_bytes_than_expected_change_nothing(kind, data):
    word = decode(Packet(kind, data))
    if word is not None:
        assert decode(Packet(kind, data + b"\x01")) == word


@pytest.mark.parametrize(
    ("kind", "least", "what"),
    [(0x7B, 33, MotorSensor), (0x7C, 17, CustomSensor), (0x7D, 40, StandardSensor), (0xFF, 1, System)],
)
def test_a_packet_that_is_too_short_says_nothing(kind, least, what):
    assert isinstance(decode(Packet(kind, bytes(least))), what)
    assert decode(Packet(kind, bytes(least + 1))) == decode(Packet(kind, bytes(least)))
    assert decode(Packet(kind, bytes(least - 1))) is None


def test_four_types_say_something_however_long_and_no_other():
    told = {kind: type(word) for kind in range(256) if (word := decode(Packet(kind, bytes(200)))) is not None}
    assert told == {0x7B: MotorSensor, 0x7C: CustomSensor, 0x7D: StandardSensor, 0xFF: System}


@given(st.tuples(u16, u16), st.tuples(st.integers(-65535, 65535), st.integers(-65535, 65535)), st.tuples(u16, u16))
def test_both_ends_agree_on_the_motors(counts, speeds, currents):
    amperes = currents[0] / 728, currents[1] / 728
    (packet,) = Deframer(PC).packets(other_end.motor_sensor(counts, speeds, amperes))
    motors = decode(packet)
    assert (motors.counts, motors.speeds) == (counts, speeds)
    assert motors.currents[:2] == pytest.approx(amperes)


@given(st.tuples(*[st.integers(0, 255)] * 6), st.floats(0, 24), st.floats(-30, 80))
def test_both_ends_agree_on_the_standard_sensors(ultrasonic, battery, degrees):
    (packet,) = Deframer(PC).packets(other_end.standard_sensor(ultrasonic, 0.4, battery, degrees))
    standard = decode(packet)
    assert standard.ultrasonic == ultrasonic
    assert standard.motor_supply == pytest.approx(battery, abs=24 / 4095)
    assert standard.motor_temperatures == pytest.approx((degrees, degrees), abs=0.1)
    assert standard.temperature == pytest.approx(degrees, abs=0.1)
    assert standard.infrared == pytest.approx(0.4, rel=0.01)


@given(st.integers(-32767, 32767), st.integers(-32767, 32767), st.none() | st.integers(0, 65535))
def test_both_ends_agree_on_velocities(left, right, milliseconds):
    (packet,) = Deframer(BOARD).packets(drrobot.command_all(Type.VELOCITY_ALL, left, right, milliseconds))
    order = other_end.decode_command(packet)
    assert order.channels == {0: left, 1: right, **dict.fromkeys(range(2, 6), other_end.NO_CHANGE)}
    assert order.life == (None if milliseconds is None else pytest.approx(milliseconds / 1e3))
    (packet,) = Deframer(BOARD).packets(drrobot.command_one(Type.VELOCITY_ONE, 1, right, milliseconds))
    assert other_end.decode_command(packet).channels == {1: right}


def test_both_ends_agree_on_gains_and_on_disabling():
    (packet,) = Deframer(BOARD).packets(drrobot.set_gains("velocity", 1, kp=15, kd=2, ki=3))
    assert other_end.decode_command(packet) == other_end.GainsCommand(1, kp=15, kd=2, ki=3)
    (packet,) = Deframer(BOARD).packets(drrobot.disable_motor(1))
    assert other_end.decode_command(packet) == other_end.DisableCommand(1)
    (packet,) = Deframer(BOARD).packets(drrobot.acknowledgement())
    assert other_end.decode_command(packet) is None


@given(st.integers(0, 255), st.binary(max_size=30))
def test_the_board_survives_any_packet(kind, data):
    other_end.decode_command(Packet(kind, data))
