# SPDX-License-Identifier: Apache-2.0
"""The clock of a driven robot: delays are ages, and one that was set stops the robot until it is steady."""

import msgpack
import numpy as np
import pytest

from services.ros2.config import Ros2Config
from services.ros2.robot_clock import MAX_JUMP_NS, STEADY_NS, UNTRUSTED_NS, RobotClock
from services.ros2.robot_input import COMMAND, TWIST
from services.ros2.ros_types import Distro, ros_types
from services.ros2.service import Ros2Service
from shared import sample_messages, topics
from shared.config import configured
from shared.event_maps import event_maps
from shared.geometry import Pose2
from shared.messages import GuardState, Odometry, SerialData, Velocity
from shared.ports import PortConfig
from shared.ros_messages import ODOM, SCAN, RosFrames, RosMessages
from shared.runners.lockstep import Lockstep
from shared.service import Out, Service, every, on
from zenav.stack.service_loader import build_service

MS, S = 1_000_000, 1_000_000_000
START = 1_000 * S
COVARIANCE = np.diag([1e-4, 1e-4, 1e-4]).ravel()
FILE = configured("x80sv", ["robot.drive.kind=velocity", "robot.ranges=[]"])


class Sender:
    """A robot that sends every 50 ms. ahead: ns of its clock, less ours."""

    def __init__(self) -> None:
        self.clock, self.now, self.ahead = RobotClock(), START, 0

    def ages(self, seconds: float, delay: int = 0) -> list[int]:
        """delay: ns from the robot to here."""
        found = []
        for _ in range(round(seconds * 20)):
            self.now += 50 * MS
            found.append(self.clock.age(self.now - delay + self.ahead, self.now))
        return found


@pytest.fixture
def sender():
    sender = Sender()
    sender.ages(5)
    return sender


def test_a_delay_is_the_age(sender):
    assert sender.ages(1, 200 * MS) == [200 * MS] * 20
    assert sender.ages(1) == [0] * 20


def test_messages_after_a_hold_up_are_old_and_the_next_prompt_one_is_believed(sender):
    sender.now += 3 * S
    held_up = [sender.clock.age(sender.now - 3 * S + i * 50 * MS, sender.now) for i in range(1, 50)]
    assert all(age >= UNTRUSTED_NS for age in held_up)
    assert sender.ages(0.1) == [0, 0]
    assert sender.clock.doubt == ""


@pytest.mark.parametrize("jump", [-3600 * S, -600 * MS, 600 * MS, 3600 * S])
def test_a_clock_that_was_set_is_believed_after_it_was_steady(sender, jump):
    sender.ahead = jump
    ages = sender.ages(20)
    steady = STEADY_NS // (50 * MS)
    assert all(age >= UNTRUSTED_NS for age in ages[:steady])
    assert ages[steady:] == [0] * (len(ages) - steady)
    assert sender.clock.offset == -jump


def test_a_step_within_the_bound_is_a_delay_or_none(sender):
    sender.ahead = -MAX_JUMP_NS
    assert sender.ages(0.1) == [MAX_JUMP_NS] * 2
    sender.ahead = 0
    assert sender.ages(0.1) == [0, 0]


def test_a_clock_that_jumps_again_or_a_gap_begins_the_time_again(sender):
    for jump in (2 * S, 4 * S, 6 * S):
        sender.ahead = jump
        assert min(sender.ages(9)) >= UNTRUSTED_NS
    sender.now += 2 * S
    assert min(sender.ages(9)) >= UNTRUSTED_NS
    assert sender.ages(2)[-1] == 0


def test_a_clock_that_was_set_forward_and_back_must_be_steady_too(sender):
    sender.ahead = 2 * S
    sender.ages(1)
    sender.ahead = 0
    assert min(sender.ages(9.9)) >= UNTRUSTED_NS
    assert sender.ages(1)[-1] == 0


def test_the_first_messages_may_have_waited_for_us():
    sender = Sender()
    assert sender.ages(0.1, 3 * S) == [0, 0]
    assert sender.ages(0.1) == [0, 0]
    assert sender.clock.doubt == ""


class RosRobot(Service):
    """A robot with ROS 2 behind the bridge's port, and teleop. ahead: ns of its clock, less ours."""

    config_type = Ros2Config

    def __init__(self) -> None:
        super().__init__(Ros2Config(), FILE.robot)
        self.types = ros_types(Distro.JAZZY)
        self.make = RosMessages(self.types.types, RosFrames())
        self.ahead, self.x, self.v, self._tick = 0, 0.0, 0.0, 0
        self.is_driven = True

    @property
    def ports(self):
        return {"ros": PortConfig()}

    @on(topics.RX)
    def obey(self, data: SerialData) -> Out:
        for order in event_maps(data.data):
            if order["publish"] == COMMAND:
                self.v = self.types.decode(order["data"], TWIST).linear.x
        return ()

    @every(hz=50)
    def send(self) -> Out:
        self._tick += 1
        stamp = self.now + self.ahead
        self.x += 0.02 * self.v
        odometry = Odometry(stamp, Pose2(self.x, 0.0, 0.0), self.v, 0.0, COVARIANCE)
        yield self._event("/odom", ODOM, self.make.odometry(odometry))
        if self._tick % 5 == 0:
            yield self._event("/scan", SCAN, self.make.scan(sample_messages.scan(stamp, FILE.robot.laser)))
        if self.is_driven:
            yield topics.TELEOP(Velocity(self.now, 0.1, 0.0, ""))

    def _event(self, name, type_, message):
        data = self.types.encode(message)
        event = {"event": "message", "name": name, "type": type_, "data": data, "gid": b"", "sent": 0, "came": 0}
        return topics.TX(SerialData(self.now, "ros", msgpack.packb(event)))


@pytest.mark.parametrize("jump", [-20 * S, 20 * S])
def test_the_guard_stops_the_robot_whose_clock_was_set_and_lets_it_drive_when_it_is_steady(jump):
    robot = RosRobot()
    services = {name: build_service(name, FILE, FILE.robot) for name in ("base_driver", "odometry", "guard")}
    bridge = Ros2Service(Ros2Config(drives=True), FILE.robot)
    lockstep = Lockstep(
        {**services, "ros2": bridge, "dashboard": robot}, wires=((("ros2", "ros"), ("dashboard", "ros")),)
    )
    statuses = []
    lockstep.watch("guard/status", statuses.append)
    lockstep.run(4)
    assert robot.v > 0.05
    robot.ahead = jump
    lockstep.run(0.1)
    assert robot.v == 0, "the bridge does not wait for the guard"
    lockstep.run(1)
    assert (statuses[-1].state, statuses[-1].reason) == (GuardState.HOLD, "bad_stamps")
    stands_at = robot.x
    lockstep.run(8.5)
    assert robot.x == stands_at
    robot.is_driven = False
    lockstep.run(3)
    robot.is_driven = True
    lockstep.run(2)
    assert robot.v > 0.05
