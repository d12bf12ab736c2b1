# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from math import nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.base_driver.config import BaseDriverConfig
from services.base_driver.kinematics import board_counts, body_velocity, wheel_angles, wheel_speeds
from services.base_driver.service import BaseDriverService
from shared import topics
from shared.config import load_robot
from shared.messages import BaseStatus, BoardReport, EmergencyStop, Velocity

ROBOT = load_robot("x80sv").robot
JACKAL = load_robot("jackal").robot
MS = 1_000_000
T0 = 1_000_000 * MS


class DriverBench:
    """A base driver and a board that turns its wheels as commanded, 50 reports and ticks a second."""

    def __init__(self, robot=ROBOT, left=100.0, right=200.0):
        self.robot = robot
        self.service = BaseDriverService(BaseDriverConfig(), robot)
        self.service.now = T0
        self.left, self.right = left, right  # counts, not wrapped
        self.turns = {"left": True, "right": True}
        self.out = []

    def call(self, result):
        new = [(publication.topic.key, publication.message) for publication in result]
        self.out += new
        return new

    @property
    def now(self):
        return self.service.now

    def report(self, **fields):
        wrap = self.robot.drive.encoder_wrap
        values = {
            "stamp": self.now,
            "left_counts": round(self.left) % wrap,
            "right_counts": round(self.right) % wrap,
            "left_speed": 0.0,
            "right_speed": 0.0,
            "ultrasonic": np.array([0.5, 0.6, 0.7], np.float32),
            "infrared": np.full(7, 0.3, np.float32),
            "battery": 7.4,
            "currents": np.array([0.5, 0.25], np.float32),
        }
        return self.call(self.service.board(BoardReport(**(values | fields))))

    def command(self, v, w=0.0, stamp=None):
        return self.call(self.service.command(Velocity(self.now if stamp is None else stamp, v, w, "")))

    def stop(self, pressed, stamp=None):
        return self.call(self.service.estop(EmergencyStop(self.now if stamp is None else stamp, pressed, "test")))

    def run(self, seconds, v=None, w=0.0, reports=True):
        for _ in range(round(seconds * 50)):
            if v is not None:
                self.command(v, w)
            self.call(self.service.drive())
            self.service.now += 20 * MS
            left, right = self.motors()
            self.left += left * 0.02 * self.turns["left"]
            self.right += right * 0.02 * self.turns["right"]
            if reports:
                self.report()
        return self

    def last(self, topic):
        return next((message for key, message in reversed(self.out) if key == topic.key), None)

    def motors(self):
        message = self.last(topics.MOTORS)
        return message.left, message.right

    @property
    def body(self):
        return body_velocity(*wheel_angles(*self.motors(), self.robot.drive), self.robot.drive)


@pytest.mark.parametrize("speed", [0.1, 0.3, 0.6])
def test_a_clock_that_is_set_ahead_while_the_robot_drives_is_no_stuck_wheel(speed):
    bench = DriverBench()
    bench.run(2.0, speed)
    bench.service.now += 5010 * MS
    left, right = bench.motors()
    bench.left += 0.01 * left
    bench.right += 0.01 * right
    bench.report()
    assert bench.service.fault not in ("wheel_stuck", "wheel_astray")
    bench.run(0.5, speed)
    assert bench.service.fault == ""


def test_a_command_reaches_the_board_by_the_document_s_equations():
    bench = DriverBench().run(0.1, 0.4, 0.5)
    assert bench.motors() == pytest.approx(board_counts(*wheel_speeds(0.4, 0.5, ROBOT.drive), ROBOT.drive))


def test_the_motors_stand_until_the_first_command():
    bench = DriverBench().run(0.3)
    assert all(m.left == m.right == 0 for key, m in bench.out if key == topics.MOTORS.key)
    assert len([key for key, _ in bench.out if key == topics.MOTORS.key]) == 15


def test_limits_scale_the_command_on_its_arc():
    bench = DriverBench().run(0.1, 8.0, 1.0)
    assert bench.body == pytest.approx((0.8, 0.1))
    bench.run(0.1, -3.0, 0.0)
    assert bench.body == pytest.approx((-0.3, 0.0))


def test_a_command_reaches_the_motors_at_once_and_not_at_the_tick():
    bench = DriverBench().run(0.1, 0.4)
    assert [key for key, _ in bench.command(0.3)] == [topics.MOTORS.key]
    assert bench.body[0] == pytest.approx(0.3)
    bench.service.now += 1
    assert [key for key, _ in bench.command(0.0)] == [topics.MOTORS.key]
    assert bench.motors() == (0, 0)


@pytest.mark.parametrize(("age_ms", "drives"), [(0, True), (199, True), (200, True), (201, False), (-100, True)])
def test_a_command_older_than_200_ms_moves_nothing(age_ms, drives):
    bench = DriverBench().run(0.1)
    bench.command(0.4, stamp=bench.now - age_ms * MS)
    bench.call(bench.service.drive())
    assert (bench.body[0] > 0) is drives


def test_a_command_from_the_future_is_refused_and_people_are_told():
    bench = DriverBench().run(0.1)
    bench.command(0.4, stamp=bench.now + 101 * MS)
    bench.call(bench.service.drive())
    assert bench.motors() == (0, 0)
    bench.call(bench.service.publish_status())
    assert "0.1 s ahead of this clock" in bench.last(topics.BASE_STATUS).detail
    bench.service.now += 1
    bench.command(0.4)
    bench.call(bench.service.publish_status())
    assert bench.last(topics.BASE_STATUS).detail == ""


def test_a_skewed_commander_gains_no_time():
    """A stamp 100 ms ahead ages from its arrival."""
    bench = DriverBench().run(0.1)
    bench.command(0.4, stamp=bench.now + 100 * MS)
    bench.run(0.2)
    assert bench.body[0] > 0
    bench.run(0.04)
    assert bench.motors() == (0, 0)


def test_an_old_burst_after_a_partition_moves_nothing():
    bench = DriverBench().run(0.2, 0.4)
    left_off = bench.now
    bench.run(3.0)
    for k in range(60):
        bench.command(0.4, stamp=left_off + k * 45 * MS)
        bench.call(bench.service.drive())
        assert bench.motors() == (0, 0)


def test_commands_count_in_the_order_of_their_stamps():
    bench = DriverBench().run(0.1)
    bench.command(0.2)
    bench.command(0.5, stamp=bench.now - 10 * MS)
    bench.command(0.6, stamp=bench.now)
    bench.call(bench.service.drive())
    assert bench.body[0] == pytest.approx(0.2)


def test_commands_count_after_the_clock_was_set_back():
    bench = DriverBench().run(0.2, 0.4)
    bench.service.now = 5 * MS
    bench.report()
    bench.run(0.1, 0.3)
    assert bench.body[0] == pytest.approx(0.3)
    assert bench.last(topics.WHEELS).stamp < T0


arrivals = st.lists(
    st.tuples(
        st.integers(0, 400),  # ms until it comes
        st.integers(-150, 600),  # ms old when it comes
        st.sampled_from([0.0, 0.3, -0.2]),
        st.sampled_from([0.0, 0.5]),
    ),
    max_size=25,
)


@settings(max_examples=60, deadline=None)
@given(arrivals)
def test_the_motors_stand_250_ms_after_the_last_young_stamp(events):
    bench = DriverBench().run(0.1)
    pending = []
    at = bench.now
    for wait, age, v, w in events:
        at += wait * MS
        pending.append((at, max(at - age * MS, 0), v, w))
    young = 0  # the newest moment up to which some command may be obeyed
    end = at + 600 * MS
    while bench.now < end:
        while pending and pending[0][0] <= bench.now:
            _, stamp, v, w = pending.pop(0)
            if (v or w) and bench.now - stamp <= 200 * MS:
                young = max(young, min(stamp, bench.now))
            bench.command(v, w, stamp=stamp)
        bench.call(bench.service.drive())
        if bench.motors() != (0, 0):
            assert bench.now - young <= 250 * MS
        bench.service.now += 20 * MS
        bench.left += bench.motors()[0] * 0.02
        bench.right += bench.motors()[1] * 0.02
        bench.report()


def releasing_ends_the_fault_and_moves_nothing(bench):
    """The stream of commands goes on; only after a zero in it does the robot drive."""
    bench.stop(False)
    assert bench.last(topics.BASE_STATUS).fault == ""
    bench.run(0.5, 0.2)
    assert bench.motors() == (0, 0), "releasing moves nothing"
    bench.run(0.1, 0.0)
    bench.run(0.1, 0.2)
    assert bench.body[0] == pytest.approx(0.2)


# --- STOP -----------------------------------------------------------------------------------------------------------


def test_stop_stands_at_once_and_whatever_is_commanded():
    bench = DriverBench().run(0.2, 0.4)
    assert [key for key, _ in bench.stop(True)] == [topics.MOTORS.key, topics.BASE_STATUS.key]
    assert bench.motors() == (0, 0)
    bench.run(0.5, 0.4)
    assert bench.motors() == (0, 0)


def test_stop_is_told_as_the_fault_and_outlives_this_process_until_a_later_release():
    before = DriverBench().run(0.2, 0.4)
    before.stop(True)
    told = before.last(topics.BASE_STATUS)
    assert told.fault == "estop"
    bench = DriverBench()
    bench.call(bench.service.restore_faults(replace(told, stamp=bench.now)))
    bench.stop(False, stamp=bench.now - MS)
    bench.run(0.1, 0.0)
    bench.run(0.5, 0.4)
    assert bench.motors() == (0, 0)
    releasing_ends_the_fault_and_moves_nothing(bench)


def test_a_press_and_a_wheel_s_fault_from_a_clock_that_is_ahead_can_be_released():
    bench = DriverBench().run(0.5, 0.2)
    bench.turns["left"] = False
    bench.run(1.2, 0.2)
    bench.stop(True, stamp=bench.now + 10_000 * MS)
    bench.service.diagnosis.wheel_faults.at += 10_000 * MS
    bench.stop(False, stamp=bench.now - 1)
    assert bench.service.fault == "estop"
    bench.stop(False)
    assert bench.service.fault == ""


def test_releasing_stop_moves_nothing_until_zero_was_commanded():
    bench = DriverBench().run(0.2, 0.4)
    bench.stop(True)
    bench.run(0.3, 0.4)
    bench.stop(False)
    bench.run(1.0, 0.4)
    assert bench.motors() == (0, 0)
    bench.run(0.1, 0.0)
    assert bench.motors() == (0, 0)
    bench.run(0.1, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


def test_after_a_release_a_stream_that_begins_again_counts():
    bench = DriverBench().run(0.2, 0.4)
    bench.stop(True)
    bench.stop(False, stamp=bench.now + 1)
    bench.run(0.46)
    bench.run(0.02, 0.4)
    assert bench.motors() == (0, 0)
    bench.run(0.5)
    bench.run(0.04, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


def test_an_older_release_does_not_undo_a_press():
    bench = DriverBench().run(0.2, 0.4)
    bench.stop(True)
    bench.stop(False, stamp=bench.now - 1)
    bench.run(0.1, 0.0)
    bench.run(0.3, 0.4)
    assert bench.motors() == (0, 0)


def test_a_late_press_of_another_client_does_not_make_a_release_count_that_is_older_than_the_newest_press():
    bench = DriverBench().run(1.0, 0.4)
    bench.stop(True)
    bench.stop(True, stamp=bench.now - 500 * MS)
    bench.stop(False, stamp=bench.now - 300 * MS)
    assert bench.service.fault == "estop"
    bench.stop(False)
    assert bench.service.fault == ""


def test_a_release_without_a_press_stops_nothing():
    bench = DriverBench().run(0.2, 0.4)
    bench.stop(False)
    bench.run(0.1, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


# --- faults ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wheel", ["left", "right"])
def test_a_wheel_that_stops_turning_is_a_latched_fault_within_200_ms(wheel):
    bench = DriverBench().run(0.5, 0.2)
    bench.turns[wheel] = False
    bench.run(0.04, 0.2)
    assert bench.service.fault == ""
    bench.run(0.16, 0.2)
    status = bench.last(topics.BASE_STATUS)
    assert status.fault == "wheel_stuck"
    assert status.detail == f"the {wheel} wheel is commanded but does not turn"
    assert status.link
    assert bench.motors() == (0, 0)
    bench.turns[wheel] = True
    bench.run(2.0, 0.2)
    assert bench.motors() == (0, 0)
    releasing_ends_the_fault_and_moves_nothing(bench)


def test_a_stuck_wheel_outlives_this_process_until_a_later_release():
    before = DriverBench().run(0.5, 0.2)
    before.turns["left"] = False
    before.run(1.2, 0.2)
    told = replace(
        before.last(topics.BASE_STATUS), detail="the left wheel is commanded but does not turn; battery low: 6.0 V"
    )
    bench = DriverBench()
    bench.call(bench.service.restore_faults(replace(told, stamp=bench.now)))
    bench.stop(False, stamp=bench.now - MS)
    bench.run(1.0, 0.2)
    assert bench.motors() == (0, 0)
    status = bench.last(topics.BASE_STATUS)
    assert status.fault == "wheel_stuck"
    assert status.detail == "the left wheel is commanded but does not turn"
    bench.stop(False)
    assert bench.last(topics.BASE_STATUS).fault == ""


def test_a_fault_that_clears_by_itself_is_not_kept_over_a_restart():
    bench = DriverBench()
    silent = BaseStatus(bench.now, 7.4, 0.0, 0.0, False, "board_silent", "")
    bench.call(bench.service.restore_faults(silent))
    bench.run(0.2, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


def test_a_release_from_before_the_fault_does_not_clear_it():
    bench = DriverBench().run(0.5, 0.2)
    before = bench.now
    bench.turns["left"] = False
    bench.run(1.2, 0.2)
    bench.stop(False, stamp=before)
    assert bench.service.fault == "wheel_stuck"


def test_both_wheels_stuck_names_both():
    bench = DriverBench().run(0.1)
    bench.turns = {"left": False, "right": False}
    bench.run(1.2, -0.2)
    assert bench.last(topics.BASE_STATUS).detail.startswith("the left and right wheel")


def test_slow_commands_and_slow_wheels_are_not_stuck():
    bench = DriverBench().run(0.1)
    bench.turns = {"left": False, "right": False}
    bench.run(3.0, 0.049)
    assert bench.service.fault == ""
    bench = DriverBench().run(0.1)
    bench.turns = {"left": 0.75, "right": 0.75}
    bench.run(3.0, 0.2)
    assert bench.service.fault == ""


@pytest.mark.parametrize("share", [0.2, -1.0])
def test_a_wheel_that_falls_behind_or_turns_the_other_way_is_a_latched_fault(share):
    bench = DriverBench().run(0.5, 0.2)
    bench.turns["right"] = share
    bench.run(0.3, 0.2)
    status = bench.last(topics.BASE_STATUS)
    assert status.fault == "wheel_astray"
    assert status.detail.startswith("the right wheel turns at ")
    assert status.detail.split()[-5:] == ["m/s", "where", "0.20", "is", "told"]
    assert bench.motors() == (0, 0)
    bench.turns["right"] = True
    bench.run(1.0, 0.2)
    assert bench.motors() == (0, 0)
    bench.stop(False)
    bench.run(0.1, 0.0)
    bench.run(0.3, 0.2)
    assert bench.body[0] == pytest.approx(0.2)


def test_a_silent_board_is_a_fault_and_its_return_moves_nothing():
    bench = DriverBench().run(0.2, 0.4)
    bench.run(0.48, 0.4, reports=False)
    assert bench.body[0] == pytest.approx(0.4)
    bench.run(0.08, 0.4, reports=False)
    status = bench.last(topics.BASE_STATUS)
    assert (status.fault, status.link) == ("board_silent", False)
    assert bench.motors() == (0, 0)
    bench.report()
    status = bench.last(topics.BASE_STATUS)
    assert (status.fault, status.link) == ("", True)
    bench.run(0.5, 0.4)
    assert bench.motors() == (0, 0)
    bench.run(0.1, 0.0)
    bench.run(0.1, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


@pytest.mark.parametrize("first", ["drive", "publish_status", "command", "report"])
def test_a_driver_that_was_frozen_blames_no_board_and_moves_by_nothing_from_before(first):
    """The fault: after a pause the board seemed silent, and the navigator gave its task up."""
    bench = DriverBench().run(0.3, 0.4)
    before = bench.now
    bench.service.now += 4000 * MS
    bench.out = []
    if first == "command":
        bench.command(0.4, stamp=before)
    elif first == "report":
        bench.report(stamp=before + 100 * MS)
    else:
        bench.call(getattr(bench.service, first)())
    bench.call(bench.service.publish_status())
    bench.run(0.1, reports=False)
    bench.run(0.1)
    assert {message.fault for key, message in bench.out if key == topics.BASE_STATUS.key} == {""}
    assert bench.motors() == (0, 0)
    bench.run(0.1, 0.0)
    bench.run(0.1, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


def test_a_board_that_is_silent_after_a_pause_is_a_fault_in_the_same_time():
    bench = DriverBench().run(0.3, 0.4)
    bench.service.now += 4000 * MS
    bench.run(0.48, 0.4, reports=False)
    assert bench.last(topics.BASE_STATUS).fault == ""
    bench.run(0.08, 0.4, reports=False)
    assert bench.last(topics.BASE_STATUS).fault == "board_silent"
    assert bench.motors() == (0, 0)


def test_without_any_board_the_link_is_missing_from_the_start():
    bench = DriverBench().run(0.3, 0.4, reports=False)
    bench.call(bench.service.publish_status())
    assert (bench.last(topics.BASE_STATUS).fault, bench.last(topics.BASE_STATUS).link) == ("", False)
    assert bench.motors() == (0, 0)
    bench.run(0.5, reports=False)
    assert bench.last(topics.BASE_STATUS).fault == "board_silent"


def test_reports_that_arrive_late_are_no_link():
    bench = DriverBench().run(0.2, 0.4)
    for _ in range(40):
        bench.command(0.4)
        bench.call(bench.service.drive())
        bench.service.now += 20 * MS
        bench.report(stamp=bench.now - 600 * MS)
    status = bench.last(topics.BASE_STATUS)
    assert (status.fault, status.link, status.detail) == ("bad_stamps", False, "board: stamps are 0.6 s old")


BAD = {
    "seconds": (lambda now: now // 10**9, "board: stamps are 50 years old; are they ns?"),
    "never set": (lambda now: 0, "board: stamps are 50 years old; are they ns?"),
    "0.3 s old": (lambda now: now - 300 * MS, "board: stamps are 0.3 s old"),
    "10 s old": (lambda now: now - 10_000 * MS, "board: stamps are 10.0 s old"),
    "1 s ahead": (lambda now: now + 1000 * MS, "board: stamps are 1.0 s ahead"),
    "1 h ahead": (lambda now: now + 3_600_000 * MS, "board: stamps are 1 h ahead"),
    "standing": (lambda now: T50 + 1000 * MS, "board: stamps stand still"),
}
T50 = 50 * 31_557_600 * 10**9


@pytest.mark.parametrize("case", BAD)
def test_reports_with_bad_stamps_stop_the_wheels_in_250_ms_are_named_and_latch_nothing(case):
    stamp, detail = BAD[case]
    bench = DriverBench()
    bench.service.now = T50
    bench.run(1.0, 0.4)
    begun = bench.now
    while any(bench.motors()):
        bench.run(0.02, 0.4, reports=False)
        bench.report(stamp=stamp(bench.now))
        assert bench.now - begun < 250 * MS
    n_wheels = sum(key == topics.WHEELS.key for key, _ in bench.out)
    faults = set()
    for _ in range(200):
        bench.run(0.02, 0.4, reports=False)
        bench.report(stamp=stamp(bench.now))
        faults.add(bench.service.fault)
        assert bench.motors() == (0, 0)
    if case != "standing":  # its stamps are also old in the end
        assert bench.last(topics.BASE_STATUS).detail == detail
    assert faults == {"bad_stamps"}
    assert sum(key == topics.WHEELS.key for key, _ in bench.out) == n_wheels, "no follower sees such a stamp"
    assert sum(bench.service.rejections.counts.values()) >= 200
    bench.run(0.1, 0.0)
    assert bench.service.fault == ""
    bench.run(1.0, 0.4)
    assert bench.body[0] == pytest.approx(0.4)
    assert bench.service.fault == ""


@pytest.mark.parametrize("step_ms", [90, -90])
def test_a_small_step_of_the_board_s_clock_is_no_broken_wheel(step_ms):
    bench = DriverBench().run(2.0, 0.4)
    for _ in range(3):
        for shift in (step_ms, 0):
            for _ in range(50):
                bench.run(0.02, 0.4, reports=False)
                bench.report(stamp=bench.now + shift * MS)
                assert bench.service.fault == ""


def test_a_burst_of_late_reports_after_a_moment_s_load_is_no_fault():
    bench = DriverBench().run(1.0, 0.4)
    begun = bench.now
    bench.service.now += 300 * MS
    for i in range(1, 16):
        bench.report(stamp=begun + i * 20 * MS)
    assert "bad_stamps" not in {message.fault for key, message in bench.out if key == topics.BASE_STATUS.key}


def wild(bench, rng):
    """A report whose counts are of no wheel."""
    bench.report(left_counts=int(rng.integers(32768)), right_counts=int(rng.integers(32768)))


def test_random_counts_stop_the_wheels_within_four_reports_and_end_a_second_after_them():
    bench = DriverBench().run(1.0, 0.8)
    rng = np.random.default_rng(1)
    for _ in range(4):
        bench.run(0.02, 0.8, reports=False)
        wild(bench, rng)
    assert bench.motors() == (0, 0)
    for _ in range(500):
        bench.run(0.02, 0.8, reports=False)
        wild(bench, rng)
        assert bench.motors() == (0, 0)
        assert bench.service.fault == "encoders_jump"
    bench.call(bench.service.publish_status())
    status = bench.last(topics.BASE_STATUS)
    assert status.fault == "encoders_jump"
    assert 480 <= int(status.detail.split()[3]) <= 504  # by chance a few look like motion
    assert status.detail.endswith(" times in the last minute")
    bench.run(0.9, 0.0)
    assert bench.service.fault == "encoders_jump"
    bench.run(0.2, 0.0)
    assert bench.service.fault == ""
    bench.run(0.5, 0.4)
    assert bench.body[0] == pytest.approx(0.4)


def test_counts_that_jump_again_and_again_are_a_fault_until_a_person_releases_it():
    bench = DriverBench().run(1.0, 0.4)
    rng = np.random.default_rng(2)
    for fault in ("encoders_jump", "encoders_jump", "encoders_broken"):
        for _ in range(10):
            bench.run(0.02, 0.4, reports=False)
            wild(bench, rng)
        assert bench.service.fault == fault
        bench.run(2.0, 0.0)
    assert bench.service.fault == "encoders_broken"
    assert "jump again and again" in bench.last(topics.BASE_STATUS).detail
    bench.stop(False)
    assert bench.service.fault == ""


def test_a_board_that_restarts_is_no_fault_and_its_jump_is_forgotten_after_a_minute():
    bench = DriverBench().run(1.0, 0.4)
    bench.left, bench.right = 20000.0, 3.0
    bench.run(1.0, 0.4)
    assert bench.service.fault == ""
    assert bench.last(topics.BASE_STATUS).detail == ""  # published twice a second
    bench.call(bench.service.publish_status())
    assert bench.last(topics.BASE_STATUS).detail == "the encoders jumped 1 time in the last minute"
    bench.run(60.0, 0.4)
    bench.call(bench.service.publish_status())
    assert bench.last(topics.BASE_STATUS).detail == ""


def jumping():
    """A robot that was driving, and stands because its encoders jump."""
    bench, rng = DriverBench().run(1.0, 0.4), np.random.default_rng(1)
    for _ in range(6):
        bench.run(0.02, 0.4, reports=False)
        wild(bench, rng)
    bench.run(0.02, 0.4)
    assert (bench.service.fault, bench.motors()) == ("encoders_jump", (0, 0))
    return bench


def test_a_release_while_the_encoders_jump_moves_nothing():
    bench = jumping()
    bench.command(0.3)
    n = len(bench.out)
    releasing_ends_the_fault_and_moves_nothing(bench)
    first_zero = next(i for i, (_, m) in enumerate(bench.out[n:], n) if isinstance(m, BaseStatus) and not m.waits)
    assert all(m.left == m.right == 0 for key, m in bench.out[n:first_zero] if key == topics.MOTORS.key)


@pytest.mark.parametrize("publishes_status", [False, True])
def test_a_command_between_the_end_of_a_fault_and_the_tick_waits_for_zero(publishes_status):
    bench = jumping()
    bench.run(0.96, 0.3)
    assert bench.service.fault == "encoders_jump"
    while bench.service.fault:
        bench.service.now += 5 * MS
    if publishes_status:
        bench.call(bench.service.publish_status())
    bench.command(0.3)
    assert bench.motors() == (0, 0)
    status = bench.last(topics.BASE_STATUS)
    assert (status.fault, status.waits) == ("", True)
    bench.run(0.5, 0.3)
    assert bench.motors() == (0, 0)
    bench.run(0.1, 0.0).run(0.1, 0.3)
    assert bench.body[0] == pytest.approx(0.3)


@pytest.mark.parametrize("dead", [(0,), (1, 2)])
def test_a_sonar_that_reads_0_is_dead_until_it_measures_again(dead):
    bench = DriverBench().run(0.5, 0.4)
    ranges = np.array([0.5, 0.6, 0.7], np.float32)
    zeros = ranges.copy()
    zeros[list(dead)] = 0
    for _ in range(14):
        bench.run(0.02, 0.4, reports=False)
        bench.report(ultrasonic=zeros)
    status = bench.last(topics.BASE_STATUS)
    assert (status.fault, bench.motors()) == ("sensor_dead", (0, 0))
    assert status.detail == f"ultrasonic {' and '.join(map(str, dead))} does not answer"
    bench.run(0.1, 0.0)
    assert bench.service.fault == ""


def test_a_single_reading_of_0_is_no_dead_sonar():
    bench = DriverBench().run(0.5, 0.4)
    for _ in range(20):
        bench.run(0.02, 0.4, reports=False)
        bench.report(ultrasonic=np.zeros(3, np.float32))
        bench.run(0.02, 0.4)
        assert bench.service.fault == ""


def test_a_low_battery_is_told():
    bench = DriverBench().run(0.1)
    bench.report(battery=6.5, stamp=bench.now + 1)
    bench.call(bench.service.publish_status())
    assert bench.last(topics.BASE_STATUS).detail == "battery low: 6.5 V"
    assert bench.last(topics.BASE_STATUS).battery == 6.5
    assert (bench.last(topics.BASE_STATUS).left_current, bench.last(topics.BASE_STATUS).right_current) == (0.5, 0.25)


# --- wheels ---------------------------------------------------------------------------------------------------------


def test_wheel_angles_run_on_across_the_wrap():
    bench = DriverBench(left=10.0, right=32760.0)
    bench.report()
    epoch = bench.last(topics.WHEELS).epoch
    bench.service.now += 20 * MS
    bench.left, bench.right = -20.0, 32790.0
    bench.report(left_speed=-50.0, right_speed=60.0)
    wheels = bench.last(topics.WHEELS)
    assert (wheels.left, wheels.right) == pytest.approx((30 * 2 * pi / 756, 30 * 2 * pi / 756))
    assert (wheels.left_speed, wheels.right_speed) == pytest.approx((50 * 2 * pi / 756, 60 * 2 * pi / 756))
    assert wheels.epoch == epoch == T0
    assert wheels.stamp == bench.now


def test_each_report_gives_its_wheel_state_and_a_repeated_one_none():
    bench = DriverBench()
    assert topics.WHEELS.key in [key for key, _ in bench.report()]
    assert bench.report() == []
    assert bench.report(stamp=bench.now - 1) == []


def test_a_restarted_board_turns_no_wheel():
    bench = DriverBench(left=9000.0, right=12000.0).run(0.2, 0.4)
    before = bench.last(topics.WHEELS)
    bench.service.now += 20 * MS
    bench.left = bench.right = 0.0
    bench.report()
    after = bench.last(topics.WHEELS)
    assert (after.left, after.right, after.epoch) == (before.left, before.right, before.epoch)
    bench.call(bench.service.publish_status())
    assert "the encoders jumped 1 time in the last minute" in bench.last(topics.BASE_STATUS).detail
    bench.run(0.1, 0.4)
    assert bench.last(topics.WHEELS).left == pytest.approx(before.left + 0.1 * 0.4 / 0.085, abs=0.02)


def test_a_board_that_restarts_during_a_long_silence_turns_no_wheel():
    bench = DriverBench(left=9000.0, right=12000.0).run(0.2)
    before = bench.last(topics.WHEELS)
    bench.service.now += 30_000 * MS
    bench.left = bench.right = 0.0
    bench.report()
    assert (bench.last(topics.WHEELS).left, bench.last(topics.WHEELS).right) == (before.left, before.right)


def test_motion_within_a_lost_second_of_reports_is_kept():
    bench = DriverBench().run(0.2)
    before = bench.last(topics.WHEELS)
    bench.service.now += 1000 * MS
    bench.left, bench.right = bench.left - 1100, bench.right + 1100  # 0.78 m/s
    bench.report()
    assert bench.last(topics.WHEELS).left == pytest.approx(before.left + 1100 * 2 * pi / 756)


def test_before_the_angle_s_bound_a_new_epoch_begins_and_loses_nothing():
    bench = DriverBench().run(0.1)
    encoders = bench.service.encoders
    encoders.left = encoders.right = 899_999.999
    epoch = encoders.epoch
    bench.service.now += 20 * MS
    bench.left, bench.right = bench.left - 2, bench.right + 2
    first, second = (m for key, m in bench.report() if key == topics.WHEELS.key)
    assert first.left == pytest.approx(899_999.999 + 2 * 2 * pi / 756)
    assert (second.left, second.right, first.epoch) == (0, 0, epoch)
    assert second.epoch > epoch
    bench.run(0.02)
    assert bench.last(topics.WHEELS).epoch == second.epoch


# --- ranges ---------------------------------------------------------------------------------------------------------


def test_ranges_carry_the_sensors_places_and_only_what_they_can_measure():
    bench = DriverBench()
    ultrasonic = np.array([0.05, 0.81, 0.9], np.float32)
    infrared = np.array([0.1, 0.5, 0.51, 0.09, nan, 0.3, 0.4], np.float32)
    bench.report(ultrasonic=ultrasonic, infrared=infrared)
    ((key, readings),) = bench.call(bench.service.publish_ranges())
    assert key == topics.RANGES.key
    expected = np.array([nan, 0.81, nan, 0.1, 0.5, nan, nan, nan, 0.3, 0.4], np.float32)
    np.testing.assert_array_equal(readings.ranges, expected)
    assert readings.stamp == bench.now
    mounts = [sensor.mount for sensor in ROBOT.ranges]
    np.testing.assert_allclose(readings.x, [m.x for m in mounts], rtol=1e-6)
    np.testing.assert_allclose(readings.y, [m.y for m in mounts], rtol=1e-6)
    np.testing.assert_allclose(readings.yaw, [m.yaw for m in mounts], rtol=1e-6)
    np.testing.assert_allclose(readings.field_of_view, [s.field_of_view for s in ROBOT.ranges], rtol=1e-6)
    assert bench.call(bench.service.publish_ranges()) == [], "nothing new, nothing published"


@pytest.mark.parametrize(
    ("n_ultrasonic", "n_infrared", "detail"),
    [
        (1, 7, "the board sends 1 ultrasonic ranges, robot.ranges has 3"),
        (6, 7, "the board sends 6 ultrasonic ranges, robot.ranges has 3"),
        (3, 0, "the board sends 0 infrared ranges, robot.ranges has 7"),
        (
            0,
            20,
            "the board sends 0 ultrasonic ranges, robot.ranges has 3, "
            "the board sends 20 infrared ranges, robot.ranges has 7",
        ),
    ],
)
def test_another_number_of_ranges_than_robot_ranges_has_is_rejected_with_both_numbers(n_ultrasonic, n_infrared, detail):
    bench = DriverBench().run(0.5, 0.4)
    bench.call(bench.service.publish_ranges())
    bench.service.now += 20 * MS
    bench.report(ultrasonic=np.full(n_ultrasonic, 0.5, np.float32), infrared=np.full(n_infrared, 0.3, np.float32))
    status = bench.last(topics.BASE_STATUS)
    assert (status.fault, status.detail, bench.motors()) == ("wrong_ranges", detail, (0, 0))
    assert bench.call(bench.service.publish_ranges()) == []
    assert bench.service.rejections.words == {(topics.BOARD.key, "content"): detail}
    bench.run(0.1, 0.0)
    assert bench.service.fault == ""


def test_a_robot_without_range_sensors_reports_none():
    bench = DriverBench(JACKAL)
    bench.report()
    ((_, readings),) = bench.call(bench.service.publish_ranges())
    assert len(readings.ranges) == len(readings.x) == 0
