# SPDX-License-Identifier: Apache-2.0
"""The emulated board: what its driver meets, sound and broken."""

from math import nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.base_driver import drrobot as driver
from services.base_driver.drrobot import CustomSensor, MotorSensor, StandardSensor, System, decode
from services.sim.hardware import drrobot
from services.sim.hardware.board import BoardEmulator
from services.sim.hardware.drrobot import GainsCommand
from services.sim.hardware.drrobot_board import DrRobotElectronics
from services.sim.hardware.faults import FAULT_DESCRIPTIONS, ActiveFaults, Fault
from shared.drrobot import PC, Deframer, Type
from shared.messages import BoardReport
from tests.unit.shared.test_drrobot import EXAMPLES

MS = 1_000_000
T0 = 10**12


def report(now=T0, left=1000, right=32000, **changes):
    values = {
        "left_speed": -50.0,
        "right_speed": 60.0,
        "ultrasonic": np.array([0.5, nan, 0.004], np.float32),
        "infrared": np.array([0.3, 0.2, nan, 0.2, 0.2, 0.2, 0.2], np.float32),
        "battery": 12.5,
        "currents": np.array([1.0, 0.5], np.float32),
    }
    return BoardReport(now, left, right, **(values | changes))


def make_emulator(*faults):
    held = ActiveFaults()
    for fault in faults:
        held.begin(fault, None)
    return BoardEmulator(held, seed=1, electronics=DrRobotElectronics(held))


def words(data):
    return [decode(packet) for packet in Deframer(PC).packets(data)]


def test_the_published_motor_sensor_packet_to_the_byte():
    data = drrobot.motor_sensor((1000, 32000), (-50, 60), (1.0, 0.5))
    assert data == bytes.fromhex(EXAMPLES["motors"])


def test_a_standing_wheel_and_readings_beyond_the_packet():
    assert drrobot.motor_sensor((0, 0), (0, 0), (0, 0))[-4] == 0
    (motors,) = words(drrobot.motor_sensor((0, 65535), (1e6, -1e6), (-1.0, 1e6)))
    assert motors.speeds == (65535, -65535)
    assert motors.currents[:2] == (0, 65535 / 728)


def test_a_supply_over_nine_volts_is_the_motors_alone():
    (standard,) = words(drrobot.standard_sensor((0,) * 6, nan, 30.0, 20.0))
    assert (standard.motor_supply, standard.board_supply) == pytest.approx((24.0, 7.2), abs=0.002)
    assert standard.infrared == 0.81


@pytest.mark.parametrize(("metres", "read"), [(0.8, 0), (nan, 0), (0.0, 0), (-1.0, 0)])
def test_an_infrared_sensor_that_sees_nothing_reads_nothing(metres, read):
    assert drrobot.infrared_reading(metres) == read
    assert drrobot.infrared_reading(0.01) == drrobot.infrared_reading(0.08) > drrobot.infrared_reading(0.081)


def test_motor_packets_come_with_each_report_the_others_at_their_rates():
    board = make_emulator()
    sent = [word for k in range(100) for word in words(board.report_bytes(report(), T0 + k * 20 * MS))]
    counts = {
        kind: sum(isinstance(word, kind) for word in sent) for kind in (MotorSensor, StandardSensor, CustomSensor)
    }
    assert counts == {MotorSensor: 100, StandardSensor: 20, CustomSensor: 20}
    assert [word.code for word in sent if isinstance(word, System)] == [0, 0]


def test_a_clock_that_was_set_back_does_not_silence_the_sensors():
    board = make_emulator()
    board.report_bytes(report(), T0)
    assert any(isinstance(word, StandardSensor) for word in words(board.report_bytes(report(), T0 - 10**10)))


def test_a_report_becomes_what_the_sensors_would_say():
    motors, standard, custom, _ = words(make_emulator().report_bytes(report(), T0))
    assert (motors.counts, motors.speeds, motors.currents[:2]) == ((1000, 32000), (-50, 60), (1.0, 0.5))
    assert standard.ultrasonic == (50, 255, 2, 255, 255, 255)
    assert standard.motor_supply == pytest.approx(12.5, abs=0.003)
    assert standard.infrared == pytest.approx(0.3, rel=0.01)
    assert custom.infrared == pytest.approx((0.2, 0.81, 0.2, 0.2, 0.2, 0.2), rel=0.01)


def test_a_velocity_ends_with_its_time_limit():
    board = make_emulator()
    board.receive(driver.command_all(Type.VELOCITY_ALL, -200.0, 210.0, 200), T0)
    assert board.motors(T0) == (-200, 210, 200 * MS)
    assert board.motors(T0 + 199 * MS) == (-200, 210, MS)
    assert board.motors(T0 + 200 * MS) == (0, 0, None)


def test_a_velocity_without_a_limit_stands_until_the_next():
    board = make_emulator()
    board.receive(driver.command_all(Type.VELOCITY_ALL, -200.0, 210.0, 200), T0)
    board.receive(driver.command_all(Type.VELOCITY_ALL, -20.0, 21.0), T0)
    assert board.motors(T0 + 10**12) == (-20, 21, None)
    board.receive(driver.command_one(Type.VELOCITY_ONE, 1, 5.0, 100), T0)
    assert board.motors(T0) == (-20, 5, 100 * MS)
    assert board.motors(T0 + 100 * MS) == (-20, 0, None)
    board.receive(driver.command_one(Type.VELOCITY_ONE, 4, 5.0), T0)
    assert board.motors(T0) == (-20, 0, None)


def test_gains_are_taken_and_disabling_stops_each_with_an_acknowledgement():
    board = make_emulator()
    assert words(board.receive(driver.set_gains("velocity", 1, 15, 0, 0), T0)) == [System(1)]
    assert board.electronics.gains == {1: GainsCommand(1, 15, 0, 0)}
    board.receive(driver.command_all(Type.VELOCITY_ALL, -200.0, 210.0), T0)
    assert words(board.receive(driver.disable_motor(0), T0)) == [System(1)]
    assert board.motors(T0) == (0, 210, None)


def test_acknowledgements_are_counted_and_not_answered():
    board = make_emulator()
    assert board.receive(driver.acknowledgement() * 3, T0) == b""
    assert board.electronics.n_acknowledged == 3


def test_orders_arrive_in_pieces():
    board = make_emulator()
    data = driver.command_all(Type.VELOCITY_ALL, -200.0, 210.0)
    for i in range(len(data)):
        assert board.motors(T0)[:2] == (0, 0)
        board.receive(data[i : i + 1], T0)
    assert board.motors(T0)[:2] == (-200, 210)


# --- faults ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", [Fault.GARBAGE, Fault.HALF_PACKETS, Fault.BAD_CRC, Fault.STALLED])
def test_of_a_broken_line_nothing_can_be_read(fault):
    board = make_emulator(fault)
    deframer = Deframer(PC)
    data = [board.report_bytes(report(), T0 + k * 20 * MS) for k in range(50)]
    data += [board.receive(driver.disable_motor(0), T0)]
    assert not any(deframer.packets(piece) for piece in data)
    assert any(data) is (fault is not Fault.STALLED)
    assert (deframer.n_bad_crc > 0) is (fault is Fault.BAD_CRC)
    board.faults.clear(fault)
    assert len(deframer.packets(board.report_bytes(report(), T0 + 10**10))) == 4


def test_a_stalled_line_carries_nothing_to_the_board_either():
    board = make_emulator(Fault.STALLED)
    board.receive(driver.command_all(Type.VELOCITY_ALL, -200.0, 210.0), T0)
    assert board.motors(T0)[:2] == (0, 0)


def test_a_stuck_encoder_stands_and_goes_on_with_the_true_count():
    board = make_emulator()

    def counts(left):
        return words(board.report_bytes(report(left=left), T0))[0]

    assert counts(10).counts[0] == 10
    board.faults.begin(Fault.STUCK_ENCODER, None)
    assert (counts(20).counts[0], counts(30).counts[0], counts(30).speeds[0]) == (20, 20, 0)
    board.faults.clear(None)
    assert (counts(40).counts[0], counts(40).speeds[0]) == (40, -50)
    board.faults.begin(Fault.STUCK_ENCODER, None)
    assert counts(50).counts[0] == 50


def test_a_dead_sonar_a_collapsed_battery_and_a_swapped_motor():
    board = make_emulator(Fault.DEAD_SONAR, Fault.LOW_BATTERY, Fault.SWAPPED_MOTOR)
    standard = words(board.report_bytes(report(), T0))[1]
    assert standard.ultrasonic == (50, 0, 2, 255, 255, 255)
    assert standard.motor_supply == pytest.approx(5.5, abs=0.003)
    board.receive(driver.command_all(Type.VELOCITY_ALL, -200.0, 210.0), T0)
    assert board.motors(T0) == (200, 210, None)


def test_faults_end_at_their_time_or_when_they_are_mended():
    faults = ActiveFaults()
    faults.begin(Fault.GARBAGE, 100)
    faults.begin(Fault.STALLED, None)
    faults.expire(99)
    assert Fault.GARBAGE in faults
    assert str(faults) == "garbage, stalled"
    faults.expire(100)
    assert Fault.GARBAGE not in faults
    assert Fault.STALLED in faults
    faults.begin(Fault.BAD_CRC, None)
    faults.clear(Fault.STALLED)
    faults.clear(Fault.STALLED)
    assert str(faults) == "bad_crc"
    faults.clear(None)
    assert str(faults) == ""


def test_every_fault_has_its_words():
    assert set(FAULT_DESCRIPTIONS) == set(Fault)


@settings(max_examples=100, deadline=None)
@given(st.sets(st.sampled_from(Fault)), st.lists(st.binary(max_size=80), max_size=10), st.integers(0, 10**10))
def test_any_bytes_are_survived_whatever_is_broken(broken, pieces, wait):
    board = make_emulator(*broken)
    for k, data in enumerate(pieces):
        Deframer(PC).packets(board.receive(data, T0 + k * wait))
        left, right, life = board.motors(T0 + k * wait)
        assert max(abs(left), abs(right)) <= 32768
        assert life is None or life > 0
        board.report_bytes(report(), T0 + k * wait)
