# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from math import hypot, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.guard.config import GuardConfig
from services.guard.protective_field import FieldConfig
from services.guard.service import GuardService
from services.guard.stop_conditions import STOPS
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2, arc
from shared.messages import (
    BaseStatus,
    EmergencyStop,
    GuardState,
    LaserScan,
    Localization,
    Odometry,
    PoseEstimate,
    RangeReadings,
    Velocity,
)
from shared.polygon import signed_distances
from shared.requests import Override
from shared.service import Log

ROBOT = load_robot("x80sv").robot
JACKAL = load_robot("jackal").robot
MS = 1_000_000
T0 = 1_000_000 * MS


class GuardDrive:
    """A guard with everything alive around it: a perfect base, odometry, laser, pose; inputs can be cut one by one."""

    def __init__(self, robot=ROBOT, obstacles=(), config=None):
        self.robot = robot
        self.guard = GuardService(config or GuardConfig(), robot)
        self.guard.now = T0
        self.odom_from_base = Pose2()
        self.obstacles = np.array(obstacles, float).reshape(-1, 2)  # in odom
        self.cut: set[str] = set()
        self.nav: tuple[float, float] | None = None
        self.teleop: tuple[float, float] | None = None
        self.fault = ""
        self.localization = Localization.GOOD
        self.map_from_odom = Pose2()
        self.out = []
        self.log: list[str] = []
        self.tick = 0
        self.closest = 9.9

    @property
    def now(self):
        return self.guard.now

    def call(self, result):
        result = list(result)
        self.log += [line.text for line in result if isinstance(line, Log)]
        new = [(out.topic.key, out.message) for out in result if not isinstance(out, Log)]
        self.out += new
        return new

    def last(self, topic):
        return next((message for key, message in reversed(self.out) if key == topic.key), None)

    @property
    def velocity(self):
        message = self.last(topics.CMD_VEL)
        return message.v, message.w

    @property
    def status(self):
        return self.last(topics.GUARD)

    @property
    def decision(self):
        return self.status.state, self.status.reason

    def command(self, v, w=0.0, source="nav", age_ms=0):
        handler = self.guard.command_nav if source == "nav" else self.guard.command_teleop
        return self.call(handler(Velocity(self.now - age_ms * MS, v, w, "")))

    def stop(self, pressed):
        return self.call(self.guard.estop(EmergencyStop(self.now, pressed, "test")))

    def override(self, seconds):
        answer = self.guard.override(Override(self.now, seconds))
        while True:
            try:
                self.call([next(answer)])
            except StopIteration as end:
                return end.value

    @property
    def base_from_laser(self):
        return self.guard.lasers["scan"].visibility.base_from_laser

    def room(self):
        """What the laser sees of a round hall of 8 m about the place nearby where a coarse grid has a point."""
        laser, robot = self.robot.laser, self.odom_from_base @ self.base_from_laser
        x, y = (v - 10 * round(v / 10) for v in (robot.x, robot.y))
        angles = robot.yaw + laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
        along = x * np.cos(angles) + y * np.sin(angles)
        return (np.sqrt(along**2 + 64 - x * x - y * y) - along).astype(np.float32)

    def scan(self, **fields):
        laser = self.robot.laser
        n = laser.n_beams
        in_laser = (self.odom_from_base @ self.base_from_laser).inverse() @ self.obstacles
        ranges = self.room()
        beams = np.round((np.arctan2(in_laser[:, 1], in_laser[:, 0]) - laser.angle_min) / laser.angle_increment)
        for beam, reach in zip(beams.astype(int), np.hypot(*in_laser.T)):
            if beam % round(2 * pi / laser.angle_increment) < n:
                index = beam % round(2 * pi / laser.angle_increment)
                ranges[index] = np.nanmin([ranges[index], reach])
        values = {
            "stamp": self.now,
            "angle_min": laser.angle_min,
            "angle_increment": laser.angle_increment,
            "scan_time": 0.0,
            "range_min": laser.range_min,
            "range_max": laser.range_max,
            "ranges": ranges,
        }
        return self.call(self.guard.laser(LaserScan(**(values | fields))))

    def odometry(self):
        return self.call(self.guard.odometry(Odometry(self.now, self.odom_from_base, 0.0, 0.0, np.zeros(9))))

    def base(self):
        return self.call(self.guard.base_status(BaseStatus(self.now, 7.4, 0.0, 0.0, True, self.fault, "as it is")))

    def pose(self):
        map_from_base = self.map_from_odom @ self.odom_from_base
        estimate = PoseEstimate(self.now, map_from_base, self.map_from_odom, np.zeros(9), 1.0, self.localization)
        return self.call(self.guard.estimate(estimate))

    def run(self, seconds):
        for _ in range(round(seconds * 100)):
            k, self.tick = self.tick, self.tick + 1
            for name, period, feed in (
                ("odom", 2, self.odometry),
                ("base", 50, self.base),
                ("pose", 10, self.pose),
                ("scan", 10, self.scan),
            ):
                if k % period == 0 and name not in self.cut:
                    feed()
            if k % 5 == 1 and self.nav is not None:
                self.command(*self.nav)
            if k % 5 == 3 and self.teleop is not None:
                self.command(*self.teleop, source="teleop")
            if k % 2 == 0:
                self.call(self.guard.watch())
            if k % 5 == 0:
                self.call(self.guard.drive())
            if k % 10 == 0:
                self.call(self.guard.publish_status())
            self.guard.now += 10 * MS
            v, w = self.velocity
            self.odom_from_base = self.odom_from_base @ arc(v * 0.01, w * 0.01)
            if len(self.obstacles):
                in_base = self.odom_from_base.inverse() @ self.obstacles
                self.closest = min(self.closest, signed_distances(self.robot.corners, in_base).min())
        return self


def driving(**settings):
    drive = GuardDrive(**settings)
    drive.nav = (0.5, 0.0)
    return drive.run(1.0)


def wall(x, half_width=0.4):
    y = np.arange(-half_width, half_width, 0.003)
    return np.column_stack((np.full(len(y), x), y))


# --- normal driving -------------------------------------------------------------------------------------------------


def test_nav_drives_the_robot():
    drive = driving()
    assert drive.velocity == pytest.approx((0.5, 0.0))
    assert drive.decision == (GuardState.ACTIVE, "")
    assert drive.status.source == "nav"
    assert drive.status.speed_limit == 0.8
    assert drive.last(topics.CMD_VEL).reason == ""
    assert drive.last(topics.CMD_VEL).stamp > drive.now - 50 * MS


def test_commands_pass_at_once_and_at_least_twenty_times_a_second():
    drive = driving()
    assert topics.CMD_VEL.key in [key for key, _ in drive.command(0.5)]
    drive.out.clear()
    drive.run(1.0)
    assert 20 <= len([1 for key, _ in drive.out if key == topics.CMD_VEL.key]) <= 50
    assert 10 <= len([1 for key, _ in drive.out if key == topics.GUARD.key]) <= 20


def test_speed_rises_and_falls_within_the_robot_s_accelerations():
    drive = GuardDrive()
    drive.nav = (0.8, 1.0)
    drive.run(0.1)
    before = drive.velocity
    for nav in ((0.8, 1.0), (0.0, 0.0), (-0.3, -1.0), (0.8, 0.0)):
        drive.nav = nav
        for _ in range(60):
            drive.run(0.05)
            v, w = drive.velocity
            assert abs(v) - abs(before[0]) <= 0.8 * 0.06 + 1e-9
            assert abs(v - before[0]) <= 1.2 * 0.06 + 1e-9
            assert abs(w - before[1]) <= 4.0 * 0.06 + 1e-9
            before = v, w
        assert drive.velocity == pytest.approx(nav)


def test_commands_beyond_the_robot_s_limits_are_clamped_on_their_arc():
    drive = GuardDrive()
    drive.nav = (3.0, 1.5)
    drive.run(2.0)
    assert drive.velocity == pytest.approx((0.8, 0.4))


def test_nobody_commands_is_idle_with_its_reason():
    drive = GuardDrive().run(0.5)
    assert drive.decision == (GuardState.IDLE, "no_command")
    assert drive.status.source == ""
    assert drive.last(topics.CMD_VEL).reason == "no_command"


def test_a_source_that_asks_for_zero_is_idle_and_its_own_reason_is_told():
    drive = GuardDrive()
    drive.nav = (0.0, 0.0)
    drive.run(0.2)
    assert drive.decision == (GuardState.IDLE, "no_command")
    drive.call(drive.guard.command_nav(Velocity(drive.now, 0.0, 0.0, "plan_old")))
    assert drive.decision == (GuardState.IDLE, "plan_old")
    drive.run(0.01)
    assert drive.last(topics.CMD_VEL).reason == "plan_old"


def test_backward_where_the_robot_may_not_has_its_reason():
    only_forward = ROBOT.drive.model_copy(update={"max_reverse_speed": 0.0})
    drive = GuardDrive(ROBOT.model_copy(update={"drive": only_forward}))
    drive.nav = (-0.2, 0.5)
    drive.run(0.3)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "no_reverse")


@pytest.mark.parametrize("source", ["nav", "teleop"])
def test_a_robot_that_drives_arcs_like_a_car_s_is_held_to_them_whoever_commands(source):
    arcs = ROBOT.drive.model_copy(update={"min_turning_radius": 0.5, "turns_in_place": False})
    drive = GuardDrive(ROBOT.model_copy(update={"drive": arcs}))
    setattr(drive, source, (0.0, 1.0))
    drive.run(0.5)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "no_turn_in_place")
    for command in ((0.4, 2.0), (0.8, -1.0), (0.1, 1.0), (-0.3, 1.0), (0.5, 0.1)):
        setattr(drive, source, command)
        for _ in range(20):
            drive.run(0.05)
            v, w = drive.velocity
            assert abs(w) <= abs(v) / 0.5 + 1e-9
        assert v == pytest.approx(command[0])
    setattr(drive, source, (0.3, 1.0))
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.3, 0.6))


def test_backward_where_no_sensor_looks_it_is_slow_and_says_so():
    backward = JACKAL.drive.model_copy(update={"max_reverse_speed": 0.4})
    drive = GuardDrive(JACKAL.model_copy(update={"drive": backward}))  # its laser sees 270 degrees
    drive.nav = (-0.4, 0.0)
    drive.run(1.5)
    assert drive.velocity[0] == pytest.approx(-drive.guard.config.field.blind_speed)
    assert drive.decision == (GuardState.ACTIVE, "no_sensor")
    drive.nav = (0.4, 0.0)
    drive.run(1.5)
    assert drive.decision == (GuardState.ACTIVE, "")


class MaskedDrive(GuardDrive):
    """The driver of its laser masks 60 degrees behind, where a mast stands."""

    def scan(self, **fields):
        laser = self.robot.laser
        bearings = laser.mount.yaw + laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
        take = self.guard.laser

        def masked(scan):
            is_masked = np.cos(bearings) < -np.cos(pi / 6)
            return take(replace(scan, ranges=np.where(is_masked, np.float32(nan), scan.ranges)))

        self.guard.laser = masked
        try:
            return super().scan(**fields)
        finally:
            self.guard.laser = take


def test_what_comes_to_stand_in_a_masked_sector_is_remembered():
    box = np.column_stack((np.full(60, -0.75), np.linspace(-0.15, 0.15, 60)))
    drive = MaskedDrive(obstacles=box)
    drive.odom_from_base = Pose2(0, 0, pi)
    drive.run(1.0)
    for k in range(20):
        drive.odom_from_base = Pose2(0, 0, pi - pi * (k + 1) / 20)
        drive.run(0.1)
    drive.teleop = (-0.3, 0.0)
    drive.run(6.0)
    assert drive.closest > 0.02


def test_why_navigation_is_slow_is_passed_on_to_people():
    drive = driving()
    for _ in range(5):
        drive.run(0.02)
        drive.call(drive.guard.command_nav(Velocity(drive.now, 0.3, 0.0, "speed_zone")))
    assert drive.decision == (GuardState.ACTIVE, "speed_zone")


# --- priorities -----------------------------------------------------------------------------------------------------


def test_teleop_goes_before_nav_and_gives_back_when_it_falls_silent():
    drive = driving()
    drive.teleop = (-0.1, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((-0.1, 0.0))
    assert drive.status.source == "teleop"
    drive.teleop = None
    drive.run(0.4)
    assert drive.velocity == (0, 0), "within half a second nav does not take over"
    assert drive.decision == (GuardState.HOLD, "command_old")
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def drives_after_zero(drive):
    drive.nav = (0.0, 0.0)
    drive.run(0.2)
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_stop_outlives_the_guard_until_a_later_release():
    before = driving()
    before.stop(True)
    drive = GuardDrive()
    drive.guard.now += 100_000 * MS
    released = EmergencyStop(drive.now - MS, False, "before our last word")
    drive.call(drive.guard.status_before_restart(replace(before.status, stamp=drive.now)))
    assert drive.decision == (GuardState.STOPPED, "estop")
    drive.nav = (0.5, 0.0)
    drive.call(drive.guard.estop(released))
    drive.run(1.0)
    assert drive.decision == (GuardState.STOPPED, "estop")
    drive.stop(False)
    drive.run(1.0)
    assert drive.velocity == (0, 0), "releasing never moves the robot"
    assert drive.decision == (GuardState.HOLD, "estop_released")
    drives_after_zero(drive)


def test_a_release_before_the_guard_s_restart_still_asks_for_zero_first():
    before = driving()
    before.stop(True)
    before.run(0.2)
    before.stop(False)
    before.run(0.2)
    assert before.decision == (GuardState.HOLD, "estop_released")
    drive = GuardDrive()
    drive.call(drive.guard.status_before_restart(replace(before.status, stamp=drive.now)))
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.decision == (GuardState.HOLD, "estop_released")
    drives_after_zero(drive)


def test_a_stick_whose_commands_come_late_for_a_while_is_no_new_source():
    drive = driving()
    drive.stop(True)
    drive.run(0.5)
    drive.stop(False)
    drive.nav = None
    for _ in range(50):
        drive.run(0.02)
        drive.command(0.5, age_ms=250)
    drive.nav = (0.5, 0.0)
    drive.run(0.5)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "estop_released")


def test_a_guard_that_was_not_stopped_begins_from_the_start():
    drive = GuardDrive()
    drive.call(drive.guard.status_before_restart(driving().status))
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_stop_goes_before_everything():
    drive = driving()
    drive.teleop = (0.3, 0.0)
    drive.run(0.5)
    out = drive.stop(True)
    assert drive.velocity == (0, 0)
    assert topics.CMD_VEL.key in [key for key, _ in out]
    assert drive.decision == (GuardState.STOPPED, "estop")
    drive.fault = "wheel_stuck"
    drive.cut = {"scan"}
    drive.run(2.5)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.STOPPED, "estop")


def test_releasing_stop_never_moves_the_robot():
    drive = driving()
    drive.stop(True)
    drive.run(1.0)
    drive.stop(False)
    drive.run(3.0)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "estop_released")
    drive.nav = (0.0, 0.0)
    drive.run(0.2)
    assert drive.decision == (GuardState.IDLE, "no_command")
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_after_a_release_a_stream_that_begins_again_drives():
    drive = driving()
    drive.stop(True)
    drive.nav = None
    drive.run(0.2)
    drive.stop(False)
    drive.run(0.6)
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_one_source_s_zero_does_not_arm_the_other():
    drive = driving()
    drive.stop(True)
    drive.stop(False)
    drive.teleop = (0.0, 0.0)
    drive.run(0.3)
    drive.teleop = None
    drive.run(1.0)
    assert drive.decision == (GuardState.HOLD, "estop_released")


def test_an_older_release_does_not_undo_a_press():
    drive = driving()
    drive.stop(True)
    drive.call(drive.guard.estop(EmergencyStop(drive.now - 1, False, "late")))
    assert drive.decision == (GuardState.STOPPED, "estop")


def test_a_late_press_of_another_client_does_not_make_a_release_count_that_is_older_than_the_newest_press():
    drive = GuardDrive()
    at = drive.now
    drive.guard.now = at + 1000 * MS
    drive.stop(True)
    drive.call(drive.guard.estop(EmergencyStop(at + 500 * MS, True, "late")))
    drive.call(drive.guard.estop(EmergencyStop(at + 700 * MS, False, "late")))
    assert drive.decision == (GuardState.STOPPED, "estop")
    drive.stop(False)
    assert drive.decision[0] is not GuardState.STOPPED


def test_a_release_without_a_press_stops_nothing():
    drive = driving()
    drive.stop(False)
    drive.run(0.2)
    assert drive.velocity == pytest.approx((0.5, 0.0))


# --- staleness ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cut", "reason", "within"),
    [("odom", "odom_old", 0.25), ("scan", "scan_old", 0.42), ("base", "base_silent", 2.55), ("pose", "pose_old", 1.15)],
)
def test_an_input_that_falls_silent_stops_the_robot_and_its_return_lets_it_go_on(cut, reason, within):
    drive = driving()
    drive.cut = {cut}
    drive.run(within)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, reason)
    assert drive.last(topics.CMD_VEL).reason == reason
    drive.cut = set()
    drive.run(1.5)
    assert drive.velocity == pytest.approx((0.5, 0.0))


@pytest.mark.parametrize("cut", ["odom", "scan", "base", "pose"])
def test_without_an_input_the_robot_never_starts(cut):
    drive = GuardDrive()
    drive.cut = {cut}
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == (0, 0)
    assert drive.status.state is GuardState.HOLD


def test_a_silent_nav_stops_the_robot_within_250_ms():
    drive = driving()
    drive.nav = None
    last = max(m.stamp for key, m in drive.out if key == topics.CMD_VEL.key)
    while drive.velocity != (0, 0):
        drive.run(0.01)
    assert drive.now - last <= 250 * MS
    assert drive.decision == (GuardState.HOLD, "command_old")


def test_commands_that_arrive_old_stop_the_robot():
    drive = driving()
    drive.nav = None
    for _ in range(40):
        drive.run(0.05)
        drive.command(0.5, age_ms=230)
    assert drive.velocity == (0, 0)


@pytest.mark.parametrize(("age_ms", "moves"), [(100, True), (460, True), (470, True), (471, False)])
def test_a_scan_s_age_counts_from_its_last_beam(age_ms, moves):
    """A scan that took 0.2 s is old 0.27 s after its end, so that a robot is stopped within 0.3 s."""
    drive = driving()
    drive.cut = {"scan"}
    drive.guard.lasers["scan"].clear()
    drive.scan(stamp=drive.now - age_ms * MS, scan_time=0.2)
    drive.call(drive.guard.watch())
    assert (drive.velocity[0] > 0) is moves


def test_a_slow_laser_of_five_sweeps_a_second_does_not_hold_the_robot():
    drive = GuardDrive()
    drive.cut = {"scan"}
    drive.nav = (0.3, 0.0)
    for k in range(15):
        drive.scan(stamp=drive.now - 210 * MS, scan_time=0.2)  # its end, 10 ms ago
        drive.run(0.2)
        if k > 3:
            assert drive.velocity[0] == pytest.approx(0.3)


@pytest.mark.parametrize("reach", [0.0, 0.3])
def test_a_covered_laser_and_one_that_means_something_else_measure_nothing(reach):
    drive = driving()
    drive.cut = {"scan"}
    for _ in range(10):
        drive.scan(ranges=np.full(ROBOT.laser.n_beams, reach, np.float32), range_max=0.25)
        drive.run(0.1)
    assert drive.decision == (GuardState.HOLD, "scan_blind")


def test_a_cover_that_measures_the_same_always_is_named_and_forgotten_with_it():
    drive = driving()
    drive.cut = {"scan"}
    laser = ROBOT.laser
    cover = np.linspace(laser.range_min, laser.range_min + 0.015, laser.n_beams).astype(np.float32)
    seen = set()
    for _ in range(10):
        drive.scan(ranges=cover)
        drive.run(0.1)
        seen.add(drive.decision[1])
    assert seen == {"", "scan_empty", "scan_blind"}
    assert drive.decision == (GuardState.HOLD, "scan_blind")
    assert f"{laser.n_beams} from the robot itself" in drive.status.detail
    drive.cut = set()
    drive.run(1.0)
    assert drive.decision == (GuardState.ACTIVE, "")


def test_a_hand_creeps_from_the_moment_on_at_which_the_view_counts_as_lost():
    drive = GuardDrive()
    drive.teleop = (0.8, 0.0)
    drive.run(2.0)
    assert drive.velocity == pytest.approx((0.8, 0.0))
    drive.cut = {"scan"}
    for _ in range(5):
        drive.scan(ranges=np.full(ROBOT.laser.n_beams, nan, np.float32))
        drive.run(0.1)
    assert drive.decision == (GuardState.ACTIVE, "scan_blind")
    assert drive.velocity[0] == pytest.approx(0.15)


def test_scans_of_other_beams_hold_the_robot_with_the_second_one_and_are_counted():
    drive = driving()
    drive.cut = {"scan"}
    words = f"{ROBOT.laser.n_beams // 2} beams came, robot.laser.n_beams is {ROBOT.laser.n_beams}"
    half = np.full(ROBOT.laser.n_beams // 2, 3.0, np.float32)
    drive.scan(ranges=half)
    drive.run(0.1)
    assert drive.decision == (GuardState.ACTIVE, ""), "one alone holds nothing"
    drive.scan(ranges=half)
    drive.run(0.05)
    assert drive.decision == (GuardState.HOLD, "scan_unlike")
    assert drive.status.detail == words
    assert drive.guard.rejections.counts == {("scan", "content"): 2}
    assert drive.guard.rejections.words == {("scan", "content"): words}
    drive.cut = set()
    drive.run(0.2)
    assert drive.decision == (GuardState.ACTIVE, "")


@pytest.mark.parametrize(("cut", "ends"), [("odom", 200), ("scan", 270)])
def test_an_input_from_a_clock_that_is_ahead_ends_no_later(cut, ends):
    drive = driving()
    drive.cut = {cut}
    if cut == "scan":
        drive.scan(stamp=drive.now + 90 * MS)
    else:
        drive.call(drive.guard.odometry(Odometry(drive.now + 90 * MS, drive.odom_from_base, 0.3, 0.0, np.zeros(9))))
    drive.run((ends - 20) * 1e-3)
    assert drive.velocity[0] > 0
    drive.run(0.05)
    assert drive.velocity == (0, 0)


def test_stop_of_which_only_the_base_knows_is_stop_until_it_says_otherwise_or_is_gone():
    drive = driving()
    drive.fault = "estop"
    drive.run(0.6)
    assert drive.decision == (GuardState.STOPPED, "estop")
    assert drive.velocity == (0, 0)
    assert not drive.override(5.0).accepted
    drive.cut = {"base"}
    drive.run(2.5)
    assert drive.decision == (GuardState.HOLD, "base_silent")
    drive.cut, drive.fault = set(), ""
    drive.run(1.0)
    assert drive.velocity == (0, 0), "it was released, and no source has sent zero since"
    drive.nav = (0.0, 0.0)
    drive.run(0.2)
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity[0] > 0


@pytest.mark.parametrize(
    ("name", "detail"), [("scan", "scan: stamps are 0.2 s ahead"), ("odom", "odom: stamps are 0.2 s ahead")]
)
def test_stamps_from_the_future_are_no_sign_of_life_and_named(name, detail):
    drive = driving()
    drive.cut = {name}
    for _ in range(10):
        ahead = drive.now + 150 * MS
        if name == "scan":
            drive.scan(stamp=ahead)
        else:
            drive.call(drive.guard.odometry(Odometry(ahead, drive.odom_from_base, 0.5, 0.0, np.zeros(9))))
        drive.run(0.1)
    assert drive.decision == (GuardState.HOLD, "bad_stamps")
    assert drive.status.detail == detail
    assert drive.guard.rejections.counts == {(name, "ahead"): 10}


@pytest.mark.parametrize("name", ["scan", "odom"])
def test_an_input_that_falls_silent_has_no_bad_stamps(name):
    drive = driving()
    drive.cut = {name}
    seen = set()
    for _ in range(50):
        drive.run(0.02)
        seen.add(drive.decision[1])
    assert seen == {"", f"{name}_old"}
    assert drive.status.detail == ""
    assert drive.guard.rejections.counts == {}


def test_scans_that_are_late_when_they_come_are_named():
    drive = driving()
    drive.cut = {"scan"}
    drive.run(0.25)
    seen = set()
    for _ in range(10):
        drive.scan(stamp=drive.now - 240 * MS)
        drive.run(0.1)
        seen.add((drive.decision[1], drive.status.detail))
    assert seen == {("bad_stamps", "scan: stamps are 0.2 s old")}


@pytest.mark.parametrize(
    ("shift", "detail"), [(1.0, "teleop: stamps are 1.0 s ahead"), (-1.0, "teleop: stamps are 1.0 s old")]
)
def test_commands_of_another_clock_are_named(shift, detail):
    drive = GuardDrive()
    for _ in range(20):
        drive.call(drive.guard.command_teleop(Velocity(drive.now + round(shift * 1e9), 0.3, 0.0, "")))
        drive.run(0.05)
    assert drive.velocity == (0, 0)
    assert drive.decision[1] == "no_command"
    assert drive.status.detail == detail


def test_an_older_release_does_not_end_a_press_from_a_clock_that_is_ahead():
    drive = driving()
    drive.call(drive.guard.estop(EmergencyStop(drive.now + 10_000 * MS, True, "a laptop")))
    drive.call(drive.guard.estop(EmergencyStop(drive.now - 1, False, "kept from before")))
    drive.run(0.2)
    assert drive.decision == (GuardState.STOPPED, "estop")
    drive.stop(False)
    drive.run(0.2)
    assert drive.status.state is not GuardState.STOPPED


def test_after_the_clock_was_set_back_everything_goes_on():
    drive = driving()
    drive.stop(True)
    drive.stop(False)
    drive.guard.now = 5_000 * MS
    drive.nav = (0.5, 0.0)
    drive.run(1.5)
    assert drive.velocity == (0, 0), "no source has sent zero since STOP was released"
    drive.nav = None
    drive.run(0.6)
    drive.nav = (0.5, 0.0)
    drive.run(1.5)
    assert drive.velocity == pytest.approx((0.5, 0.0))


# --- faults ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fault", "reason"), [("wheel_stuck",) * 2, ("board_silent",) * 2, ("burnt", "base_fault")])
def test_a_fault_of_the_base_stops_at_once_with_its_own_words(fault, reason):
    drive = driving()
    drive.fault = fault
    drive.base()
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.FAULT, reason)
    assert drive.status.detail == "as it is"


def test_after_a_fault_was_released_nav_must_ask_for_zero():
    drive = driving()
    drive.fault = "wheel_stuck"
    drive.run(0.6)
    drive.stop(False)
    drive.fault = ""
    drive.run(1.0)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "estop_released")


def test_a_base_that_waits_for_zero_gets_it_although_nav_goes_on_and_then_starts_from_standing():
    """A fault may come and go between two of our ticks: then our stream never held a zero."""
    drive = driving()
    before, _ = drive.velocity
    assert before > 0
    waiting = BaseStatus(drive.now, 7.4, 0.0, 0.0, True, "", "", waits=True)
    drive.call(drive.guard.base_status(waiting))
    assert drive.velocity == (0, 0)
    drive.run(0.1)
    assert 0 < drive.velocity[0] <= 0.2 * drive.robot.drive.max_acceleration
    drive.run(2.0)
    assert drive.velocity[0] == pytest.approx(before)


# --- pose -----------------------------------------------------------------------------------------------------------


def test_a_pose_lost_for_two_seconds_stops_nav_and_not_teleop():
    drive = driving()
    drive.localization = Localization.LOST
    drive.run(1.9)
    assert drive.velocity[0] > 0
    drive.run(0.25)
    assert drive.decision == (GuardState.HOLD, "pose_lost")
    assert drive.velocity == (0, 0)
    drive.teleop = (0.2, 0.0)
    drive.run(0.5)
    assert drive.velocity == pytest.approx((0.2, 0.0))
    drive.teleop = None
    drive.localization = Localization.POOR
    drive.run(2.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


@pytest.mark.parametrize(("jump", "stops"), [(0.49, False), (0.51, True)])
def test_a_jump_of_the_pose_stops_nav_until_it_planned_again(jump, stops):
    drive = driving()
    drive.map_from_odom = Pose2(0.0, jump, 0.0)
    drive.run(0.1)
    drive.call(drive.guard.drive())
    assert (drive.velocity == (0, 0)) is stops
    assert (drive.decision == (GuardState.HOLD, "pose_jumped")) is stops
    drive.run(0.3)
    assert (drive.velocity == (0, 0)) is stops
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_a_far_origin_that_turns_is_no_jump_where_the_robot_is():
    drive = driving()
    drive.odom_from_base = Pose2(50.0, 0.0, 0.0)
    drive.run(0.5)
    place = drive.map_from_odom @ drive.odom_from_base
    # a turn of 0.05 rad about the robot moves odom's origin by 2.5 m, and the robot not at all
    drive.map_from_odom = Pose2(place.x, place.y, 0.05) @ drive.odom_from_base.inverse()
    drive.run(0.2)
    assert drive.status.reason != "pose_jumped"


# --- obstacles ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", [ROBOT, JACKAL], ids=lambda robot: robot.name)
def test_before_a_wall_the_robot_slows_and_stands_without_touching(robot):
    drive = GuardDrive(robot, wall(2.0, 0.6))
    drive.nav = (robot.drive.max_speed, 0.0)
    reasons_told = []
    for _ in range(60):
        drive.run(0.1)
        reasons_told.append(drive.last(topics.CMD_VEL).reason)
    assert drive.decision == (GuardState.HOLD, "obstacle")
    assert drive.velocity == (0, 0)
    assert 0.05 < drive.closest < 0.12
    assert "obstacle_slow" in reasons_told
    assert "contact after" in drive.status.detail
    drive.nav = (-0.1, 0.0)
    drive.run(0.5)
    assert drive.velocity == pytest.approx((-0.1, 0.0)), "backing away is free"


def test_something_that_steps_in_front_stops_the_robot_with_the_scan():
    drive = driving()
    drive.obstacles = drive.odom_from_base @ wall(0.24, 0.1)
    drive.scan()
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "obstacle")
    drive.obstacles = np.empty((0, 2))
    drive.run(1.0)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_teleop_is_guarded_too():
    drive = GuardDrive(obstacles=wall(0.8))
    drive.teleop = (0.8, 0.0)
    drive.run(5.0)
    assert drive.velocity == (0, 0)
    assert drive.closest > 0.04


def test_a_wall_within_a_wide_stop_margin_stops_a_small_robot():
    burger, wide = load_robot("turtlebot3_burger").robot, FieldConfig(stop_margin=1.0)
    drive = GuardDrive(burger, wall(0.9), GuardConfig(field=wide))
    drive.nav = (burger.drive.max_speed, 0.0)
    drive.run(0.5)
    assert drive.velocity[0] == 0
    assert drive.decision == (GuardState.HOLD, "obstacle")


def before_a_wall():
    """Driven by hand, and stopped by the field."""
    drive = GuardDrive(obstacles=wall(0.8))
    drive.teleop = (0.8, 0.4)
    drive.run(4.0)
    assert drive.decision == (GuardState.HOLD, "obstacle")
    return drive


def test_an_override_lets_a_hand_creep_on_tells_it_and_ends_by_itself():
    drive = before_a_wall()
    assert drive.override(0.5).accepted
    drive.run(0.4)
    assert drive.velocity == pytest.approx((0.15, 0.075))
    assert drive.decision == (GuardState.ACTIVE, "override")
    assert drive.last(topics.CMD_VEL).reason == "override"
    assert drive.status.speed_limit == 0.15
    drive.run(0.3)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "obstacle")


def test_an_override_moves_nothing_by_itself_and_not_for_the_navigator():
    drive = GuardDrive(obstacles=wall(0.3))
    drive.override(2.0)
    drive.run(0.5)
    assert drive.velocity == (0, 0)
    assert drive.status.reason == "no_command"
    drive.override(2.0)
    drive.nav = (0.5, 0.0)
    drive.run(1.9)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, "obstacle")
    assert drive.closest > 0.04


@pytest.mark.parametrize(("cut", "reason"), [("odom", "odom_old"), ("base", "base_silent")])
def test_an_override_is_of_the_field_and_the_scan_alone(cut, reason):
    drive = before_a_wall()
    drive.cut = {"scan"}
    for _ in range(2):
        drive.override(1.0)
        drive.run(0.5)
    assert drive.decision == (GuardState.ACTIVE, "override"), "a blind robot is driven out by hand"
    drive.cut = {"scan", cut}
    for _ in range(5):
        drive.override(1.0)
        drive.run(0.5)
    assert drive.velocity == (0, 0)
    assert drive.decision == (GuardState.HOLD, reason)


def test_stop_ends_an_override_and_lets_none_begin():
    drive = before_a_wall()
    drive.override(2.0)
    drive.run(0.2)
    drive.stop(True)
    assert drive.velocity == (0, 0)
    assert drive.override(2.0).reason == "estop"
    drive.teleop = None
    drive.stop(False)
    drive.run(1.0)
    drive.teleop = (0.8, 0.0)
    drive.run(0.5)
    assert drive.decision == (GuardState.HOLD, "obstacle"), "the override from before is over"


def test_an_override_ends_when_it_is_taken_back():
    drive = before_a_wall()
    drive.override(2.0)
    drive.run(0.2)
    assert drive.velocity != (0, 0)
    drive.override(0.0)
    drive.run(0.2)
    assert drive.decision == (GuardState.HOLD, "obstacle")


def test_one_noisy_beam_does_not_stop_the_robot():
    drive = driving()
    ranges = drive.room()
    ranges[90] = 0.15
    drive.cut = {"scan"}
    drive.scan(ranges=ranges)
    assert drive.velocity == pytest.approx((0.5, 0.0))


def test_a_range_sensor_alone_stops_the_robot():
    drive = driving()
    columns = np.array([[s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view] for s in ROBOT.ranges], np.float32)
    ranges = np.full(len(columns), nan, np.float32)
    ranges[4] = 0.1
    drive.call(drive.guard.range_readings(RangeReadings(drive.now, *columns.T.copy(), ranges)))
    drive.call(drive.guard.drive())
    assert drive.velocity[0] < 0.1
    drive.run(0.3)
    assert drive.decision == (GuardState.HOLD, "obstacle")


def test_where_no_sensor_looks_the_robot_is_slow():
    drive = GuardDrive(JACKAL)
    drive.nav = (-0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((-0.15, 0.0)), "nothing looks back on a Jackal"
    drive = GuardDrive(ROBOT)
    drive.nav = (-0.3, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((-0.3, 0.0)), "the X80SV's laser looks all around"


def test_a_range_sensor_that_looks_back_allows_full_speed_while_it_lives():
    rear = ROBOT.ranges[8]
    robot = JACKAL.model_copy(update={"ranges": (rear,)})
    drive = GuardDrive(robot)
    drive.nav = (-0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity == pytest.approx((-0.15, 0.0))
    for _ in range(20):
        columns = [np.array([value], np.float32) for value in (-0.186, 0.0, pi, 0.05, nan)]
        drive.call(drive.guard.range_readings(RangeReadings(drive.now, *columns)))
        drive.run(0.1)
    assert drive.velocity == pytest.approx((-0.5, 0.0))


def test_restarted_odometry_forgets_what_was_seen_in_the_old_frame():
    drive = GuardDrive(obstacles=wall(0.6))
    drive.run(0.5)
    assert len(drive.guard.obstacles.points(Pose2(), drive.now))
    drive.odom_from_base = Pose2(5.0, 5.0, 1.0)
    drive.odometry()
    assert not len(drive.guard.obstacles.points(Pose2(), drive.now))
    assert drive.guard.lasers["scan"].scan is None


courses = st.lists(st.tuples(st.floats(-0.3, 0.8), st.floats(-2, 2), st.floats(0.1, 0.8)), min_size=1, max_size=6)
posts = st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)), min_size=1, max_size=5)


@settings(max_examples=25, deadline=None)
@given(courses, posts)
def test_whatever_is_commanded_nothing_standing_is_touched(course, places):
    centres = np.array([place for place in places if hypot(*place) > 0.4]).reshape(-1, 2)
    around = np.linspace(0, 2 * pi, 24)
    rim = 0.03 * np.column_stack((np.cos(around), np.sin(around)))
    drive = GuardDrive(obstacles=(centres[:, None, :] + rim).reshape(-1, 2))
    drive.scan = lambda: _scan_of_posts(drive, centres, 0.03)
    for v, w, seconds in course:
        drive.nav = (v, w)
        drive.run(seconds)
    assert drive.closest > 0


def _scan_of_posts(drive, centres, radius):
    """What the laser sees of round posts in the hall."""
    laser = drive.robot.laser
    in_laser = (drive.odom_from_base @ drive.base_from_laser).inverse() @ centres
    angles = laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
    along = np.outer(in_laser[:, 0], np.cos(angles)) + np.outer(in_laser[:, 1], np.sin(angles))
    across = np.outer(in_laser[:, 1], np.cos(angles)) - np.outer(in_laser[:, 0], np.sin(angles))
    hit = (np.abs(across) < radius) & (along > 0)
    reach = np.where(hit, along - np.sqrt(np.maximum(radius**2 - across**2, 0)), np.inf).min(axis=0, initial=np.inf)
    ranges = np.where(np.isinf(reach), drive.room(), reach).astype(np.float32)
    fields = laser.angle_min, laser.angle_increment, 0.0, 0.02, laser.range_max
    return drive.call(drive.guard.laser(LaserScan(drive.now, *fields, ranges)))


# --- the table ------------------------------------------------------------------------------------------------------


def test_the_table_is_ranked_by_who_must_act():
    order = [reason.code for reason, _, _ in STOPS]
    assert order[:2] == ["estop_input", "estop"]
    assert order.index("base_fault") < order.index("base_silent") < order.index("scan_old") < order.index("no_command")
    assert len(set(order)) == len(order)


cuts = st.sets(st.sampled_from(["odom", "scan", "base"]), min_size=1)


@settings(max_examples=40, deadline=None)
@given(cuts | st.just(set()), st.booleans(), st.sampled_from(["", *(reason.code for reason, _, _ in STOPS)]))
def test_the_reason_of_a_stop_is_the_first_row_of_the_whole_table_that_holds(cut, pressed, fault):
    drive = driving()
    drive.cut = cut
    if pressed:
        drive.stop(True)
    drive.run(1.0)
    inputs = drive.guard.inputs
    inputs.base = replace(inputs.base, fault=fault)
    first = next(((reason, state) for reason, state, holds in STOPS if holds(inputs, drive.now)), None)
    assert inputs.stop_reason(drive.now) == first


@settings(max_examples=20, deadline=None)
@given(cuts, st.booleans(), st.sampled_from([None, (0.3, 0.0), (-0.2, 1.0)]))
def test_any_missing_input_or_stop_is_zero_whatever_else_holds(cut, pressed, teleop):
    drive = driving()
    drive.teleop = teleop
    drive.cut = cut
    if pressed:
        drive.stop(True)
    drive.run(2.6)
    for _ in range(10):
        drive.run(0.05)
        assert drive.velocity == (0, 0)
        assert drive.last(topics.CMD_VEL).reason
