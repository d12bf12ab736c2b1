# SPDX-License-Identifier: Apache-2.0
"""Whatever fails while the robot drives at full speed, the motors get a zero command within the promised time."""

from dataclasses import replace
from functools import partial

import pytest

from services.sim.service import SimService
from shared import topics
from shared.geometry import Pose2
from shared.messages import BoardReport, GuardState, Localization, PoseEstimate, Velocity
from tests.lockstep.stack import MS, QUICK, LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

SLACK = 50  # ms on top of an age limit: from noticing to the motors' zero


@pytest.fixture
def driving(tmp_path):
    """At full speed towards a goal four metres ahead."""
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.go(4.0)
    stack.drives()
    return stack


def zero_within(stack: LockstepStack, ms: float) -> None:
    assert stack.until(lambda: not stack.commanded, 5.0) <= ms * MS


@pytest.mark.parametrize(
    ("name", "age", "reason"),
    [("odometry", 200, "odom_old"), ("local_ctrl", 200, "command_old"), ("mapper", 1000, "pose_old")],
)
def test_a_service_that_dies_stops_the_robot_and_with_it_back_the_robot_goes_on(driving, name, age, reason):
    driving.lockstep.kill(name)
    zero_within(driving, age + SLACK)
    driving.lockstep.run(0.2)
    assert driving.guard.reason == reason
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    driving.stands_for(1.0)
    driving.start(name)
    driving.until(driving.ended, 40.0)
    assert driving.truth.n_contacts == 0
    assert driving.old == []


def test_without_a_guard_the_base_stops_and_with_it_back_the_robot_goes_on(driving):
    driving.lockstep.kill("guard")
    zero_within(driving, 250)
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    driving.stands_for(1.0)
    driving.start("guard")
    driving.until(driving.reached, 30.0)
    assert driving.old == []


def test_without_a_base_driver_the_boards_own_time_limit_stops_the_wheels(driving):
    driving.lockstep.kill("base_driver")
    driving.until(lambda: abs(driving.truth.v) < 0.02, 1.2)  # 0.2 s of limit, then the wheels roll out
    driving.lockstep.run(1.0)
    assert abs(driving.truth.v) < 0.02
    driving.start("base_driver")
    driving.until(driving.ended, 40.0)
    assert driving.truth.n_contacts == 0


def test_without_scans_the_robot_stands_until_they_come_again(driving):
    laser = driving.file.robot.laser
    lost_from = driving.now
    driving.lost["scan"] = lambda sent: sent >= lost_from
    scan = driving.newest["scan"]
    ends = scan.stamp + round(laser.scan_time * 1e9)
    driving.until(lambda: not driving.commanded, 2.0)
    assert driving.now - ends <= (300 + SLACK) * MS
    driving.lockstep.run(0.2)
    assert driving.guard.reason == "scan_old"
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    driving.stands_for(1.0)
    del driving.lost["scan"]
    driving.until(driving.reached, 30.0)
    assert driving.old == []


def test_an_old_plan_stops_the_robot_with_its_reason(driving):
    driving.go(6.5)
    driving.lockstep.run(0.5)
    driving.lockstep.kill("planner")
    plan_age, braking = 2000, 1000
    zero_within(driving, plan_age + braking)
    driving.lockstep.run(0.1)
    assert driving.guard.reason == "plan_old"
    driving.stands_for(6.0)  # also when the navigator has it planned again


class Pose:
    """In the place of a killed mapper: the last map_from_odom goes on, 10 times a second, moved and in a state."""

    def __init__(self, stack: LockstepStack) -> None:
        self.stack, self.shift, self.state = stack, 0.0, Localization.GOOD
        stack.lockstep.kill("mapper")
        self.last: PoseEstimate = stack.newest["pose"]
        self.say()

    def say(self) -> None:
        odom = self.stack.newest["odom"]
        map_from_odom = Pose2(0.0, self.shift, 0.0) @ self.last.map_from_odom
        estimate = replace(
            self.last,
            stamp=odom.stamp,
            map_from_odom=map_from_odom,
            map_from_base=map_from_odom @ odom.odom_from_base,
            state=self.state,
        )
        self.stack.lockstep.publish(topics.POSE(estimate), "mapper")
        self.stack.lockstep.at(0.1, self.say)


def test_a_pose_that_is_lost_for_two_seconds_stops_the_robot_with_its_reason(driving):
    driving.go(6.5)
    driving.lockstep.run(0.5)
    pose = Pose(driving)
    driving.lockstep.run(0.3)
    assert driving.commanded
    pose.state = Localization.LOST
    zero_within(driving, 2000 + 100 + SLACK)
    driving.lockstep.run(0.2)
    assert driving.guard.reason == "pose_lost"
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    driving.stands_for(1.0)


def test_a_pose_that_jumps_stops_the_robot_until_it_has_planned_again(driving):
    pose = Pose(driving)
    driving.lockstep.run(0.3)
    pose.shift = 0.6
    zero_within(driving, 100 + SLACK)
    assert driving.guard.reason == "pose_jumped"


def test_stop_outlives_guard_and_base_and_releasing_it_moves_nothing(driving):
    driving.stop(True)
    zero_within(driving, 20)
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    del driving.lockstep.latched["estop"]  # its publisher has ended, as `zenav estop` does at once
    for name in ("guard", "base_driver"):
        driving.lockstep.kill(name)
        driving.stands_for(0.5)
        driving.start(name)
        driving.stands_for(1.0)
        assert driving.guard.state is GuardState.STOPPED
        assert driving.guard.reason == "estop"
    driving.stop(False)
    driving.stands_for(2.0)
    driving.go(3.0)
    driving.until(driving.reached, 20.0)


def test_stop_that_was_pressed_while_there_was_no_guard_is_shown_and_releasing_it_moves_nothing(driving):
    driving.lockstep.kill("guard")
    driving.stop(True)
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    del driving.lockstep.latched["estop"]
    driving.start("guard")
    driving.stands_for(1.0)
    assert (driving.guard.state, driving.guard.reason) == (GuardState.STOPPED, "estop")
    driving.stop(False)
    driving.stands_for(2.0)
    driving.go(3.0)
    driving.until(driving.reached, 20.0)


class HeldWheel(SimService):
    """From a moment on, the left encoder counts no more."""

    held: int | None = None
    holds = False

    def _board(self) -> BoardReport:
        report = super()._board()
        if not self.holds:
            self.held = report.left_counts
            return report
        return replace(report, left_counts=self.held, left_speed=0.0)


def by_hand(stack: LockstepStack) -> None:
    """Drives straight on by hand from now on, 20 commands a second."""
    stack.lockstep.publish(topics.TELEOP(Velocity(stack.now, 0.4, 0.0, "")))
    stack.lockstep.at(0.05, partial(by_hand, stack))


def test_a_wheel_that_does_not_turn_is_named_and_stays_a_fault_over_a_restart(tmp_path):
    stack = LockstepStack(tmp_path, sim=HeldWheel, settings=QUICK)
    by_hand(stack)
    stack.drives(0.35)
    stack.lockstep.service("sim").holds = True
    zero_within(stack, 1000 + 2 * SLACK)  # the last 2 cm may be 50 ms old when the wheel stops
    stack.lockstep.run(0.1)
    assert (stack.guard.state, stack.guard.reason) == (GuardState.FAULT, "wheel_stuck")
    assert "left wheel" in stack.guard.detail
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.0)
    stack.lockstep.kill("base_driver")
    stack.lockstep.run(0.3)
    stack.lockstep.service("sim").holds = False
    stack.start("base_driver")
    stack.stands_for(2.0)
    assert (stack.guard.state, stack.guard.reason) == (GuardState.FAULT, "wheel_stuck")
    assert "left wheel" in stack.guard.detail
    stack.stop(False)
    stack.stands_for(1.0)
    assert stack.guard.state is not GuardState.FAULT


def test_commands_that_do_not_reach_the_board_for_a_moment_are_no_broken_wheel(driving):
    begun = driving.lockstep.now
    driving.lost["hardware/motors"] = lambda sent: sent < begun + 600 * MS
    seen: set[str] = set()
    driving.lockstep.watch("base/status", lambda status: seen.add(status.fault))
    driving.until(driving.ended, 40.0)
    assert driving.reached()
    assert seen == {"", "not_obeyed"}
    assert driving.truth.n_contacts == 0
