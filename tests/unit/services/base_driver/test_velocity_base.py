# SPDX-License-Identifier: Apache-2.0
"""A base that controls its own speed: it gets velocities, its odometry is checked and gets an epoch."""

import numpy as np
import pytest

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from shared import topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.config import Robot, UserError, configured, load_robot
from shared.geometry import Pose2
from shared.messages import BaseOdometry, EmergencyStop, Velocity
from tests.unit.services.base_driver.boards.wired import MODELS, WiredBoard

ROBOT = load_robot("turtlebot3_burger").robot
MS = 1_000_000
T0 = 1_000_000 * MS


class BaseBench:
    """A base driver, and a base that moves as commanded, 50 messages a second."""

    def __init__(self, gives_pose=True):
        self.service = BaseDriverService(BaseDriverConfig.model_validate({"battery": {"empty": 10.5}}), ROBOT)
        self.service.now = T0
        self.pose, self.epoch, self.gives_pose, self.moves, self.battery = Pose2(), 7, gives_pose, True, 12.0
        self.out = []

    @property
    def now(self):
        return self.service.now

    def take(self, outputs):
        self.out += [(publication.topic.key, publication.message) for publication in outputs]

    def last(self, topic):
        return next((message for key, message in reversed(self.out) if key == topic.key), None)

    def report(self, **changes):
        command = self.last(topics.VELOCITY)
        v, w = (command.v, command.w) if command is not None and self.moves else (0.0, 0.0)
        values = {
            "stamp": self.now, "epoch": self.epoch, "has_pose": self.gives_pose,
            "odom_from_base": self.pose if self.gives_pose else Pose2(), "has_twist": True, "v": v, "vy": 0.0, "w": w,
            "covariance": np.zeros(9), "twist_covariance": np.zeros(9), "battery": self.battery,
        }  # fmt: skip
        self.take(self.service.base_motion(BaseOdometry(**(values | changes))))

    def run(self, seconds, v=None, w=0.0, reports=True):
        for _ in range(round(seconds * 50)):
            if v is not None:
                self.take(self.service.command(Velocity(self.now, v, w, "")))
            self.take(self.service.drive())
            command = self.last(topics.VELOCITY)
            self.service.now += 20 * MS
            if self.moves:
                self.pose = self.pose @ Pose2(command.v * 0.02, 0.0, command.w * 0.02)
            if reports:
                self.report()
        return self

    @property
    def command(self):
        message = self.last(topics.VELOCITY)
        return message.v, message.w

    def fault(self):
        self.take(self.service.publish_status())
        return self.last(topics.BASE_STATUS).fault


def test_it_gets_velocities_and_no_wheel_speeds():
    bench = BaseBench().run(0.2, 0.0).run(0.5, 0.2, 0.5)
    assert bench.command == (0.2, 0.5)
    assert bench.last(topics.MOTORS) is None
    assert bench.last(topics.WHEELS) is None
    bench.run(0.1, 3.0)
    assert bench.command[0] == ROBOT.drive.max_speed


@pytest.mark.parametrize("gives_pose", [True, False])
def test_its_odometry_gets_the_driver_s_epoch_and_is_judged_as_wheels_are(gives_pose):
    bench = BaseBench(gives_pose).run(0.2, 0.0).run(2.0, 0.2, 0.3)
    odometry = bench.last(topics.BASE_ODOMETRY)
    assert odometry.epoch == T0 + 20 * MS
    assert odometry.odom_from_base == (bench.pose if gives_pose else Pose2())
    assert bench.fault() == ""
    bench.moves = False
    bench.run(2.0, 0.2)
    faults = {message.fault for key, message in bench.out if key == topics.BASE_STATUS.key}
    assert faults == {"", "not_obeyed"}
    assert bench.command == (0.0, 0.0)


def test_silence_age_stop_and_battery_stop_it():
    bench = BaseBench().run(0.2, 0.0).run(0.5, 0.2)
    assert bench.last(topics.BASE_STATUS).battery == 12.0
    bench.run(0.24)
    assert bench.command == (0.0, 0.0), "commands are 200 ms old"
    bench.run(0.1, 0.0).run(0.2, 0.2).run(0.7, 0.2, reports=False)
    assert (bench.fault(), bench.command) == ("board_silent", (0.0, 0.0))
    bench.run(0.5, 0.2)
    assert (bench.fault(), bench.command) == ("", (0.0, 0.0)), "the commander has not asked for zero yet"
    bench.run(0.1, 0.0).run(0.2, 0.2)
    bench.take(bench.service.estop(EmergencyStop(bench.now, True, "test")))
    assert bench.command == (0.0, 0.0)
    bench.take(bench.service.estop(EmergencyStop(bench.now, False, "test")))
    bench.run(0.1, 0.0).run(0.2, 0.2)
    assert bench.command[0] == 0.2
    bench.battery = 10.0
    bench.run(0.5, 0.2)
    assert (bench.fault(), bench.command) == ("battery_empty", (0.0, 0.0))


def test_a_base_drives_on_beyond_900_000_rad_of_its_wheels():
    bench = BaseBench().run(0.2, 0.0)
    bench.service.velocity_base.left = bench.service.velocity_base.right = 899_999.0
    for _ in range(10):
        bench.run(0.08, 0.2, reports=False).run(0.02, 0.2)
    assert (bench.fault(), bench.command[0]) == ("", 0.2)


def test_a_base_that_was_restarted_begins_an_epoch():
    bench = BaseBench().run(0.2, 0.0).run(1.0, 0.2)
    first = bench.last(topics.BASE_ODOMETRY).epoch
    bench.pose, bench.epoch = Pose2(), 8
    bench.run(0.1, 0.2)
    second = bench.last(topics.BASE_ODOMETRY).epoch
    assert second > first
    assert bench.service.velocity_base.n_jumps == 0
    bench.pose = Pose2(5.0, 0.0, 0.0)  # without a new epoch of its own
    bench.run(0.1, 0.2)
    assert bench.last(topics.BASE_ODOMETRY).epoch > second
    assert bench.service.velocity_base.n_jumps == 1
    assert bench.fault() == ""


def test_old_odometry_is_bad_stamps():
    bench = BaseBench().run(0.2, 0.0).run(0.3, 0.2)
    for _ in range(40):
        bench.run(0.02, 0.2, reports=False)
        bench.report(stamp=bench.now - 1000 * MS)
    assert bench.fault() == "bad_stamps"
    assert bench.last(topics.BASE_STATUS).detail.startswith("odometry: stamps are 1.0 s old")


def test_the_last_words_are_zero():
    bench = BaseBench().run(0.2, 0.0).run(0.3, 0.2)
    bench.take(bench.service.on_shutdown())
    assert bench.command == (0.0, 0.0)


@pytest.mark.parametrize("kind", ["mecanum", "omni", "holonomic"])
def test_a_robot_file_of_a_holonomic_base_is_refused_in_one_line(kind):
    with pytest.raises(UserError, match="a holonomic base cannot be driven") as error:
        configured("x80sv", [f"robot.drive.kind={kind}"]).section("robot", Robot)
    assert "\n" not in error.value.what
    assert error.value.hint


def test_odometry_with_a_sideways_speed_is_refused():
    message = BaseOdometry(T0, 1, True, Pose2(), True, 0.1, 0.3, 0.0, np.zeros(9), np.zeros(9), 12.0)
    payload = encode(message, Envelope("sim", "s", 1, T0))
    with pytest.raises(CodecError, match=r"vy is 0.3 m/s: a holonomic base cannot be driven"):
        decode(BaseOdometry, payload)


def test_ranges_of_a_velocity_base_are_refused():
    with pytest.raises(UserError, match="sends no ranges"):
        configured("x80sv", ["robot.drive.kind=velocity"]).section("robot", Robot)


def test_a_velocity_board_that_does_its_own_odometry():
    wired = WiredBoard("velocity", kind="velocity").run(0.2, 0.0).run(1.0, 0.3, 0.4)
    odometry = wired.last(topics.BASE_ODOMETRY)
    assert (odometry.v, odometry.w) == pytest.approx((0.3, 0.4), abs=0.03)
    assert odometry.odom_from_base.yaw == pytest.approx(0.4, abs=0.05)
    assert wired.status().battery == pytest.approx(7.4)
    before = wired.last(topics.BASE_ODOMETRY).epoch
    wired.board.electronics.restart()
    wired.run(0.5, 0.0)
    assert wired.last(topics.BASE_ODOMETRY).epoch > before
    assert wired.status().fault == ""


def test_a_board_that_sends_the_other_kind_says_which_setting_is_wrong():
    wired = WiredBoard("velocity")
    wired.board.electronics.drive = wired.board.electronics.drive.model_copy(update={"kind": "velocity"})
    wired.run(1.0, 0.0)
    status = wired.status()
    assert status.fault == "base_fault"
    assert status.detail.startswith("the board sends poses: set robot.drive.kind: velocity")


@pytest.mark.parametrize("model", [model for model in MODELS if model != "velocity"])
def test_a_board_that_only_counts_wheels_is_refused_for_a_velocity_base(model):
    with pytest.raises(UserError, match=f"drive.kind: velocity does not fit the board {model}, which only counts"):
        WiredBoard(model, kind="velocity")
