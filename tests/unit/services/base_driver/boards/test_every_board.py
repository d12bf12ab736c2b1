# SPDX-License-Identifier: Apache-2.0
"""What holds for each board: it drives, is counted right, and whatever breaks on its line stops it with its reason."""

from itertools import pairwise
from math import pi

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.base_driver.boards.models import BOARDS
from services.sim.hardware.board import BOARD_MODELS
from services.sim.hardware.electronics import BodyTruth
from services.sim.hardware.faults import Fault
from shared import topics
from shared.config import UserError
from shared.messages import EmergencyStop, PortState
from tests.held_bytes import held_bytes
from tests.unit.services.base_driver.boards.wired import MODELS, MS, WRAPS, WiredBoard, robot_of

NEW = tuple(model for model in MODELS if model != "drrobot")
MAX_HELD_BYTES = 10_000
WITH_CHECKSUM = tuple(model for model in MODELS if model != "ros_arduino_bridge")
every_board = pytest.mark.parametrize("model", MODELS)
every_new_board = pytest.mark.parametrize("model", NEW)


def driving(model, v=0.3, w=0.0, **arguments):
    return WiredBoard(model, **arguments).run(0.2, 0.0).run(1.0, v, w)


def away(wired, seconds, restarts):
    """Its port is away for so long, meanwhile the board loses its power or stands."""
    wired.take(wired.service.port(PortState(wired.now, "board", False, "gone")))
    wired.is_connected = False
    wired.run(0.3)
    wired.service.now += round(seconds * 1e9) - 300 * MS
    if restarts:
        wired.board.electronics.restart()
    wired.is_connected = True
    wired.take(wired.service.port(PortState(wired.now, "board", True, "")))
    return wired.run(0.5)


def agree(wired):
    wired.run(0.24).run(0.1)  # it stands: a polled board answers with the counts of the period before
    true, counted = wired.turned()
    assert counted == pytest.approx(true, abs=2 * 2 * pi / wired.robot.drive.counts_per_turn)


def test_each_board_has_its_emulator_and_its_place_in_the_tests():
    assert set(BOARDS) == set(BOARD_MODELS) == set(MODELS)


@every_board
@pytest.mark.parametrize(("v", "w"), [(0.3, 0.0), (0.0, 1.0), (0.2, -0.6), (-0.2, 0.0), (0.05, 0.9)])
def test_a_velocity_turns_the_wheels_and_they_are_counted_right(model, v, w):
    wired = driving(model, v, w)
    half = w * wired.robot.drive.wheel_distance / 2
    assert wired.rims == pytest.approx((v - half, v + half), abs=0.012)
    assert wired.service.fault == ""
    wheels = wired.last(topics.WHEELS)
    radius = wired.robot.drive.wheel_radius
    assert (wheels.left_speed * radius, wheels.right_speed * radius) == pytest.approx(wired.rims, abs=0.04)
    agree(wired)


@every_board
def test_the_counters_overflow_without_a_jump(model):
    wrap = WRAPS[model]
    for v in (0.3, -0.3):
        wired = driving(model, v, left=float(wrap - 5), right=5.0)
        agree(wired)
        assert wired.service.encoders.n_jumps == 0


@every_board
def test_a_stop_and_the_end_of_the_commands_stop_the_wheels(model):
    wired = driving(model)
    wired.take(wired.service.estop(EmergencyStop(wired.now, True, "test")))
    assert wired.rates == (0, 0)
    wired = driving(model).run(0.24)
    assert wired.rates == (0, 0)
    wired = driving(model)
    wired.take(wired.service.on_shutdown())
    assert wired.rates == (0, 0)


@every_board
def test_the_battery_is_read_where_the_board_measures_it(model):
    wired = driving(model)
    if model == "ros_arduino_bridge":
        assert not wired.status().battery >= 0
        return
    assert wired.status().battery == pytest.approx(7.4, abs=0.06)
    wired.faults.begin(Fault.LOW_BATTERY, None)
    wired.run(1.0, 0.3)
    assert wired.status().fault == "battery_empty"
    assert wired.rates == (0, 0)


@every_board
@pytest.mark.parametrize("fault", [Fault.GARBAGE, Fault.HALF_PACKETS, Fault.BAD_CRC, Fault.STALLED])
def test_a_broken_line_stops_the_robot_and_it_drives_again_after_zero(model, fault):
    wired = driving(model)
    wired.faults.begin(fault, None)
    wired.run(0.8, 0.3)
    status = wired.status()
    assert (status.fault, status.link) == ("board_silent", False)
    if fault is Fault.STALLED:
        assert status.detail.startswith("no byte arrives")
    else:
        assert status.detail.startswith(("bytes arrive, none make sense", "packets arrive, but", "no byte"))
    assert wired.last(topics.MOTORS).left == 0
    wired.faults.clear(None)
    wired.run(1.0, 0.3)
    assert wired.status().fault == ""
    assert wired.rates == (0, 0), "the commander has not asked for zero yet"
    wired.run(0.1, 0.0).run(0.5, 0.3)
    assert min(wired.rims) == pytest.approx(0.3, abs=0.01)


@every_board
def test_a_stuck_encoder_and_a_swapped_motor_are_latched_faults(model):
    for fault, code in ((Fault.STUCK_ENCODER, "wheel_stuck"), (Fault.SWAPPED_MOTOR, "wheel_astray")):
        wired = driving(model)
        wired.faults.begin(fault, None)
        wired.run(2.0, 0.3)
        assert wired.status().fault == code, fault
        assert wired.rates == (0, 0)


@every_new_board
def test_a_board_that_was_restarted_stands_then_drives_and_has_moved_nowhere(model):
    wired = driving(model)
    before = wired.turned()[0]
    wired.board.electronics.restart()
    assert wired.rates == (0, 0)
    wired.run(1.5, 0.0).run(0.5, 0.3)
    assert min(wired.rims) == pytest.approx(0.3, abs=0.01)
    assert wired.status().fault == ""
    assert wired.service.encoders.n_jumps <= 1
    wheels, odometer = wired.last(topics.WHEELS), wired.turned()[0]
    is_new_epoch = wheels.epoch > wired.out[0][1].stamp + 500 * MS
    expected = odometer[0] - before[0] if is_new_epoch else odometer[0]
    assert wheels.left == pytest.approx(expected, abs=0.35)


@every_new_board
def test_a_board_that_lost_its_power_while_its_port_was_away_has_moved_nowhere(model):
    wired = away(driving(model, left=0.0, right=0.0), 1.0, restarts=True)
    wheels = [message for key, message in wired.out if key == topics.WHEELS.key]
    assert len(wheels) > 60
    for before, after in pairwise(wheels):
        assert after.epoch > before.epoch or after.left >= before.left
    wired.run(0.2, 0.0).run(0.5, 0.3)
    assert (wired.status().fault, min(wired.rims)) == ("", pytest.approx(0.3, abs=0.01))


@pytest.mark.parametrize("model", ["velocity", "kobuki"])
@pytest.mark.parametrize("seconds", [1.0, 50.0, 70.0, 200.0])
def test_a_port_that_was_away_begins_an_epoch_only_if_the_board_was_restarted(model, seconds):
    for restarts in (False, True):
        wired = driving(model, left=0.0, right=0.0).run(0.3, 0.0)
        first = wired.last(topics.WHEELS).epoch
        away(wired, seconds, restarts)
        assert (wired.last(topics.WHEELS).epoch > first) is restarts
        assert wired.service.encoders.n_jumps == 0


def test_a_pose_board_that_lost_its_power_while_its_port_was_away_begins_an_epoch():
    wired = driving("velocity", kind="velocity")
    first = wired.last(topics.BASE_ODOMETRY).epoch
    assert away(wired, 1.0, restarts=True).last(topics.BASE_ODOMETRY).epoch > first


@every_board
def test_an_adapter_that_was_pulled_out_comes_back(model):
    wired = driving(model)
    wired.is_connected = False
    wired.run(0.7, 0.3)
    assert wired.status().detail == "no byte arrives"
    wired.is_connected = True
    wired.run(1.2, 0.0).run(0.5, 0.3)
    assert min(wired.rims) == pytest.approx(0.3, abs=0.01)


def test_the_gyro_of_a_board_has_the_stamp_of_its_wheels_also_with_a_latency():
    wired = WiredBoard("velocity", latency=0.08).run(0.5, 0.0)
    wired.body = BodyTruth(0.25, (), ())
    wired.run(0.1, 0.0)
    assert wired.last(topics.IMU).stamp == wired.last(topics.REPORT).stamp


@pytest.mark.parametrize("model", ["velocity", "kobuki", "create2"])
def test_an_emulated_board_reports_the_bumpers_and_cliff_sensors_that_it_has(model):
    wired = WiredBoard(model).run(0.2, 0.0)
    wired.body = BodyTruth(0.0, ("back", "left"), ("below", "right"))
    wired.run(0.2, 0.0)
    contacts = wired.last(topics.CONTACTS)
    assert (contacts.bumpers, contacts.cliffs) == (("left",), ("right",))


@pytest.mark.parametrize("model", ["velocity", "kobuki", "create2"])
def test_bumpers_and_cliffs_are_published_by_name_and_often(model):
    wired = WiredBoard(model).run(1.0, 0.0)
    assert 20 <= sum(key == topics.CONTACTS.key for key, _ in wired.out) <= 30
    wired.body = BodyTruth(0.25, ("left",), ("right",))
    wired.run(0.02, 0.0)
    contacts = wired.last(topics.CONTACTS)
    assert (contacts.bumpers, contacts.cliffs, contacts.estop) == (("left",), ("right",), False)
    if model != "create2":
        assert wired.last(topics.IMU).yaw_rate == pytest.approx(0.25, abs=1e-3)
    wired.body = BodyTruth()
    wired.run(0.02, 0.0)
    assert wired.last(topics.CONTACTS).bumpers == ()


def test_the_velocity_board_s_emergency_stop_is_published():
    wired = WiredBoard("velocity").run(0.1, 0.0)
    wired.body = BodyTruth(estop=True)
    wired.run(0.02, 0.0)
    assert wired.last(topics.CONTACTS).estop


def test_a_create2_that_saw_a_cliff_is_passive_and_drives_again_after_zero_only():
    wired = driving("create2")
    wired.body = BodyTruth(cliffs=("front_left",))
    wired.run(0.1, 0.3)
    assert (wired.status().fault, wired.rates) == ("base_fault", (0, 0))
    assert wired.status().detail.startswith("the robot has left safe mode")
    wired.body = BodyTruth()
    wired.run(0.5, 0.3)
    assert wired.rates == (0, 0)
    wired.run(0.2, 0.0).run(0.3, 0.3)
    assert min(wired.rims) == pytest.approx(0.3, abs=0.01)


def test_an_odrive_in_no_closed_loop_is_a_fault_and_gets_its_start_sequence():
    wired = driving("odrive")
    wired.board.electronics.restart()
    wired.run(0.5, 0.3)
    statuses = [message for key, message in wired.out if key == topics.BASE_STATUS.key and message.fault]
    assert {status.fault for status in statuses} == {"base_fault"}
    assert statuses[0].detail.startswith("axis 0 and 1 is not in closed loop control")
    assert wired.rates == (0, 0), "the commander has not asked for zero yet"
    wired.run(0.2, 0.0).run(0.3, 0.3)
    assert min(wired.rims) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("model", WITH_CHECKSUM)
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 200), st.integers(0, 7))
def test_a_damaged_byte_gives_no_wrong_count(model, place, bit):
    wired = driving(model)

    def flip(data):
        i = place % len(data)
        return data[:i] + bytes((data[i] ^ 1 << bit,)) + data[i + 1 :]

    wired.damage = flip
    wired.run(0.1, 0.3)
    assert wired.damage is None
    assert wired.service.encoders.n_jumps == 0
    agree(wired)


@every_board
@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(st.integers(0, 700), st.binary(max_size=100) | st.none()), max_size=12))
def test_any_bytes_at_any_time_are_survived(model, sequence):
    wired = WiredBoard(model)
    for wait, data in sequence:
        wired.service.now += wait * MS
        if data is None:
            wired.run(0.02, 0.2)
            wired.status()
        else:
            wired.say(data)
            wired.board.receive(data, wired.now)
    wired.faults.clear(None)
    wired.run(1.5)
    wired.out.clear()
    wired.run(0.2, 0.0)
    assert wired.last(topics.REPORT) is not None


@every_board
def test_a_megabyte_of_noise_leaves_no_megabyte_behind(model):
    wired, random = driving(model), np.random.default_rng(0)
    before = held_bytes(wired.service.serial.device)
    for _ in range(250):
        wired.service.now += MS
        wired.say(random.bytes(4096))
        wired.out.clear()
    assert held_bytes(wired.service.serial.device) < before + MAX_HELD_BYTES


@every_new_board
def test_counters_that_do_not_fit_the_robot_file_are_an_error_with_a_hint(model):
    robot = robot_of(model)
    drive = robot.drive.model_copy(update={"encoder_wrap": 1000})
    wired = WiredBoard(model)
    with pytest.raises(UserError, match=r"robot.drive.encoder_wrap: 1000 does not fit") as error:
        BOARDS[model](wired.service.config.board, robot.model_copy(update={"drive": drive}))
    assert "set robot.drive.encoder_wrap" in error.value.hint
