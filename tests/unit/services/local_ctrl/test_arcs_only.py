# SPDX-License-Identifier: Apache-2.0
"""A robot that drives no tighter arc than its own, and may not turn on the spot: nothing else is ever commanded."""

from math import pi

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from services.local_ctrl.config import CONTROLLERS
from services.local_ctrl.local_plan import PathAhead, cut_at_turn
from services.local_ctrl.rollout import DT, limits_of
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import FollowState, RecoveryKind
from tests.unit.services.local_ctrl.test_controllers import config
from tests.unit.services.local_ctrl.test_mppi import SHAPE, clutter, scene
from tests.unit.services.local_ctrl.tiny_world import ControlLoop, TinyWorld, drive_goal, recovery

X80 = load_robot("x80sv").robot
RADIUS = 0.5
DRIVE = X80.drive.model_copy(update={"min_turning_radius": RADIUS, "turns_in_place": False})
CAR = X80.model_copy(update={"drive": DRIVE})


def keeps_its_arcs(velocities):
    v, w = np.abs(np.array(velocities, float)).T
    return (w <= v / RADIUS + 1e-6).all()


@pytest.mark.parametrize("name", CONTROLLERS)
@settings(deadline=None, max_examples=8)
@given(
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.003, 0.02]),
    st.floats(-3, 3),
    st.floats(-0.15, 0.8),
    st.floats(-1, 1),
    st.sampled_from([0.0, 0.15]),
)
# contact comes before the robot can stop
@example(seed=1, share=0.003, heading=0.0, v=0.75, bend=0.0, reverse=0.0)
def test_no_controller_plans_or_commands_a_tighter_arc_and_all_keep_the_drive_s_limits(
    name, seed, share, heading, v, bend, reverse
):
    limits = limits_of(DRIVE, 10.0, reverse)
    v = max(v, -reverse)
    w = max(min(bend * abs(v) / RADIUS, limits.w_max), -limits.w_max)
    driver = CONTROLLERS[name](config(name, max_reverse_speed=reverse), limits)
    solution = driver.solve(scene(clutter(seed, share), heading, v=v, w=w), SHAPE, 0)
    assert keeps_its_arcs(solution.velocities)
    speeds = np.concatenate(([v], solution.velocities[:, 0]))
    rates = np.concatenate(([w], solution.velocities[:, 1]))
    assert (abs(rates) <= limits.w_max + 1e-6).all()
    assert (np.diff(abs(speeds)) >= -DRIVE.max_braking * DT - 1e-6).all()
    assert (abs(np.diff(rates)) <= DRIVE.max_turn_acceleration * DT + 1e-6).all()


def arc_to_the_left(n=60):
    """(n, 2) m: a half circle of the robot's radius and on, from (1, 2) heading along x."""
    along = np.linspace(0, pi * 0.7, n)
    turn = np.column_stack((1.0 + 0.7 * np.sin(along / 0.7), 2.0 + 0.7 * (1 - np.cos(along / 0.7))))
    back = np.column_stack((np.linspace(1.0, 0.5, 10)[1:], np.full(9, 3.4)))
    return np.concatenate((turn, back))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_half_circle_is_driven_round_and_not_cut_across(name):
    loop = ControlLoop(CAR, TinyWorld(6, 6), Pose2(1.0, 2.0, 0.0), config(name))
    goal = Pose2(0.5, 3.4, pi)
    run = loop.give(drive_goal(goal, yaw_tolerance=10.0), arc_to_the_left()).drive(15)
    assert run.reached
    assert keeps_its_arcs([(command.v, command.w) for command in run.commands])
    assert max(pose.x for pose in run.poses) > 1.45
    assert loop.truth.distance(goal) < 0.15


@pytest.mark.parametrize("name", ["dwa", "pursuit"])
def test_a_plan_that_begins_behind_is_not_taken_by_turning_on_the_spot(name):
    loop = ControlLoop(CAR, TinyWorld(6, 6), Pose2(3.0, 3.0, 0.0), config(name))
    loop.give(drive_goal(Pose2(1.0, 3.0, pi)), np.array([[3.0, 3.0], [1.0, 3.0]])).drive(2)
    assert keeps_its_arcs([(command.v, command.w) for command in loop.run.commands])


def test_the_recovery_that_turns_is_refused_by_name():
    loop = ControlLoop(CAR, TinyWorld(6, 6), Pose2(3.0, 3.0, 0.0), config("pursuit"))
    loop.give(recovery(RecoveryKind.TURN, 1.0)).drive(1)
    status = loop.run.statuses[-1]
    assert (status.state, status.reason) == (FollowState.FAILED, reasons.NO_TURN_IN_PLACE.code)
    assert not any(command.w for command in loop.run.commands)


def test_at_the_goal_with_another_heading_it_says_so_instead_of_turning():
    loop = ControlLoop(CAR, TinyWorld(6, 6), Pose2(1.0, 3.0, 0.0), config("pursuit"))
    loop.give(drive_goal(Pose2(3.0, 3.0, pi / 2)), np.array([[1.0, 3.0], [3.0, 3.0]])).drive(8)
    status = loop.run.statuses[-1]
    assert (status.state, status.reason) == (FollowState.FAILED, reasons.HEADING_MISSED.code)
    assert keeps_its_arcs([(command.v, command.w) for command in loop.run.commands])


@given(st.floats(0.2, 3.0))
def test_the_way_ahead_ends_where_it_has_turned_by_so_much(most):
    points = arc_to_the_left(100)
    cut = cut_at_turn(PathAhead(points, 3.0, True, Pose2()), most)
    whole = len(cut.points) == len(points)
    assert cut.ends == whole
    angle = np.arctan2(*(cut.points[-1] - cut.points[-3])[::-1])
    assert whole or angle == pytest.approx(most, abs=0.15)
