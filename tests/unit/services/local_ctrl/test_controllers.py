# SPDX-License-Identifier: Apache-2.0
"""What holds for every controller, and what each is picked for."""

from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from services.local_ctrl.config import CONTROLLERS, LocalCtrlConfig
from services.local_ctrl.controller import Controller
from services.local_ctrl.footprint import collides
from services.local_ctrl.mppi import MppiConfig
from services.local_ctrl.pursuit import lookahead_point
from services.local_ctrl.rollout import DT, arc_step, limits_of, speed_after, turn_rate_after
from shared import reasons
from shared.config import Robot, load_robot
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.messages import FollowState
from tests.unit.services.local_ctrl.test_debug_topics import pictures, watched
from tests.unit.services.local_ctrl.test_driving import arrived, cluttered
from tests.unit.services.local_ctrl.test_mppi import LIMITS, RESOLUTION, ROBOT, SHAPE, N, clutter, scene
from tests.unit.services.local_ctrl.tiny_world import ControlLoop, TinyWorld, drive_goal, off, planned

JACKAL = load_robot("jackal").robot
NAMES = tuple(CONTROLLERS)
SIMPLE = ("dwa", "pursuit")  # what MPPI alone keeps is in test_mppi and test_driving


def config(name: str, **settings: object) -> LocalCtrlConfig:
    return LocalCtrlConfig.model_validate({"controller": name, "mppi": MppiConfig(rollouts=300), **settings})


def controller(name: str, reverse: float = 0.15) -> Controller:
    return CONTROLLERS[name](config(name), limits_of(ROBOT.drive, 10.0, reverse))


def test_a_controller_of_another_name_is_refused_with_the_names_that_there_are() -> None:
    with pytest.raises(ValidationError, match="'mppi', 'dwa' or 'pursuit'"):
        config("teb")


@pytest.mark.parametrize("name", SIMPLE)
@settings(deadline=None, max_examples=30)
@given(
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.003, 0.02]),
    st.floats(-3, 3),
    st.floats(-0.15, 0.8),
    st.floats(-2, 2),
    st.sampled_from([0.0, 0.15]),
)
def test_no_limit_of_the_drive_is_passed(
    name: str, seed: int, share: float, heading: float, v: float, w: float, reverse: float
) -> None:
    v = max(v, -reverse)
    solution = controller(name, reverse).solve(scene(clutter(seed, share), heading, v=v, w=w), SHAPE, 0)
    speeds = np.concatenate(([v], solution.velocities[:, 0]))
    rates = np.concatenate(([w], solution.velocities[:, 1]))
    assert (speeds <= LIMITS.v_max + 1e-9).all()
    assert (speeds >= -reverse - 1e-9).all()
    assert (abs(rates) <= LIMITS.w_max + 1e-9).all()
    faster = np.diff(abs(speeds))
    assert (faster <= LIMITS.acceleration * DT + 1e-9).all()
    assert (faster >= -LIMITS.braking * DT - 1e-9).all()
    assert (abs(np.diff(rates)) <= LIMITS.turn_acceleration * DT + 1e-9).all()


@pytest.mark.parametrize("name", SIMPLE)
@settings(deadline=None, max_examples=30)
@given(st.integers(0, 1000), st.sampled_from([0.003, 0.01, 0.03]), st.floats(-3, 3), st.floats(-0.15, 0.8))
def test_after_a_command_that_is_driven_braking_touches_nothing(
    name: str, seed: int, share: float, heading: float, v: float
) -> None:
    met = scene(clutter(seed, share), heading, v=v)
    solution = controller(name).solve(met, SHAPE, 0)
    if solution.collides:
        return
    x, y, yaw = met.x, met.y, met.yaw
    v, w = solution.velocities[0]
    while True:
        chord, _, _, half = arc_step(v, w, DT)
        x, y, yaw = x + chord * cos(yaw + half), y + chord * sin(yaw + half), yaw + 2 * half
        assert not collides(met.field, met.occupied, RESOLUTION, x, y, cos(yaw), sin(yaw), SHAPE)
        if v == 0.0 and w == 0.0:
            break
        v, w = speed_after(v, 0.0, LIMITS, DT), turn_rate_after(w, 0.0, LIMITS, DT)


@pytest.mark.parametrize("name", SIMPLE)
@pytest.mark.parametrize("ahead", [0.35, 0.5, 0.8])
def test_the_nearer_the_wall_on_the_plan_the_slower_and_before_it_not_at_all(name: str, ahead: float) -> None:
    occupied = np.zeros((N, N), bool)
    occupied[:, 60 + round((ahead + 0.2) / RESOLUTION)] = True
    # what leads on knows nothing of the wall: the controller alone sees to it
    met = scene(np.zeros((N, N), bool))._replace(occupied=occupied, field=distance_field(occupied, RESOLUTION))
    driver, v, x = controller(name), 0.0, met.x
    for _ in range(120):
        rest = met.path[met.path[:, 0] >= x - RESOLUTION]
        solution = driver.solve(met._replace(x=x, v=v, path=rest), SHAPE, 1)
        v = 0.0 if solution.collides else float(solution.velocities[0, 0])
        x += v * DT
        assert not collides(met.field, met.occupied, RESOLUTION, x, met.y, 1.0, 0.0, SHAPE)
    assert v < 0.02
    assert x > met.x + ahead - 0.2


@pytest.mark.parametrize("name", SIMPLE)
def test_where_the_robot_cannot_stop_any_more_it_says_so(name: str) -> None:
    occupied = np.zeros((N, N), bool)
    occupied[60 - 4 : 60 + 5, 60 + 4] = True  # 0.2 m ahead, and the robot drives at it
    assert controller(name).solve(scene(occupied, v=0.8), SHAPE, 0).collides


@pytest.mark.parametrize("name", SIMPLE)
def test_the_same_calls_give_the_same_bytes(name: str) -> None:
    def velocities() -> list[bytes]:
        driver = controller(name)
        met = [scene(clutter(seed, 0.003), 0.3 * seed, v=0.3) for seed in range(5)]
        return [driver.solve(s, SHAPE, 1).velocities.tobytes() for s in met]

    assert velocities() == velocities()


@given(st.floats(0.05, 3.0), st.floats(-1, 1), st.floats(-1, 1))
def test_the_point_steered_for_is_on_the_path_and_as_far_away_as_it_should_be(look: float, x: float, y: float) -> None:
    along = np.linspace(0, 2.5, 51)
    path = np.column_stack((along, 0.3 * np.sin(2 * along)))
    px, py = lookahead_point(path, x, y, look)
    away = hypot(px - x, py - y)
    dense = np.linspace(0, 2.5, 5001)
    assert np.hypot(dense - px, np.interp(dense, along, path[:, 1]) - py).min() < 1e-3
    assert away == pytest.approx(look, abs=0.01) or (px, py) == tuple(path[-1]) or (px, py) == tuple(path[0])


@pytest.mark.parametrize("name", SIMPLE)
def test_an_open_floor_is_crossed_fast_and_smoothly(name: str) -> None:
    world, start, goal = TinyWorld(10, 4), Pose2(1.0, 2.0, 0.0), Pose2(8.0, 2.0, 1.0)
    loop = ControlLoop(ROBOT, world, start, config(name)).give(drive_goal(goal), planned(world, start, goal, 0.28))
    run = loop.drive(20)
    arrived(loop, run, goal)
    assert run.seconds < 13.5
    assert min(v for v, pose in zip(run.v, run.poses) if 2.5 < pose.x < 6.5) > 0.7
    assert np.mean(np.abs(np.diff([command.w for command in run.commands]))) < 0.04


@pytest.mark.parametrize("name", SIMPLE)
@pytest.mark.parametrize("seed", [1, 2])
def test_between_what_the_plan_knows_it_touches_nothing(name: str, seed: int) -> None:
    world, start, goal = cluttered(seed), Pose2(0.6, 2.0, 0.0), Pose2(5.4, 2.0, 0.0)
    loop = ControlLoop(ROBOT, world, start, config(name)).give(drive_goal(goal), planned(world, start, goal, 0.28))
    arrived(loop, loop.drive(25), goal)


def test_dwa_goes_around_what_the_plan_does_not_know_and_pursuit_waits_before_it_for_another_plan() -> None:
    start, goal = Pose2(1.0, 2.0, 0.0), Pose2(4.4, 2.0, 0.0)
    world = TinyWorld(6, 4).box(2.6, 1.7, 3.0, 2.3)
    straight = np.array([[1.0, 2.0], [4.4, 2.0]])
    loop = ControlLoop(ROBOT, world, start, config("dwa")).give(drive_goal(goal), straight)
    arrived(loop, loop.drive(20), goal)
    loop = ControlLoop(ROBOT, world, start, config("pursuit")).give(drive_goal(goal), straight)
    loop.drive(6)
    status = loop.run.statuses[-1]
    assert (status.state, status.reason) == (FollowState.BLOCKED, reasons.BLOCKED.code)
    assert loop.run.least_clearance > 0
    assert loop.truth.x > 1.9
    loop.plan = planned(world, loop.truth, goal, 0.28)
    loop.drive(20)
    arrived(loop, loop.run, goal)


@pytest.mark.parametrize("name", SIMPLE)
@pytest.mark.parametrize("lost", ["odometry", "scan", "pose"])
def test_without_knowledge_there_is_no_motion(name: str, lost: str) -> None:
    world, start, goal = TinyWorld(8, 4), Pose2(1.0, 2.0, 0.0), Pose2(6.0, 2.0, 0.0)
    loop = ControlLoop(ROBOT, world, start, config(name)).give(drive_goal(goal), planned(world, start, goal, 0.25))
    loop.drive(1.5)
    assert loop.run.commands[-1].v > 0.3
    loop.lost = {lost}
    loop.drive(1.3)
    command = loop.run.commands[-1]
    assert (command.v, command.w) == (0.0, 0.0)
    assert command.reason in reasons.REASONS


@pytest.mark.parametrize("reverse", [0.3, 0.0])
def test_where_there_is_no_room_to_turn_pursuit_backs_out_if_it_may(reverse: float) -> None:
    world = TinyWorld(6, 3).box(0, 0, 6, 1.2).box(0, 1.8, 6, 3)  # the jackal's diagonal is longer than 0.6 m
    start, goal = Pose2(4.0, 1.5, 0.0), Pose2(2.0, 1.5, 0.0)
    driver = config("pursuit", max_reverse_speed=reverse)
    loop = ControlLoop(JACKAL, world, start, driver).give(
        drive_goal(goal, yaw_tolerance=10.0), np.array([[4, 1.5], [2, 1.5]])
    )
    run = loop.drive(20 if reverse else 4)
    assert run.least_clearance > 0
    if reverse:
        assert run.reached
        assert off(loop.truth, goal)[0] < 0.15
        assert abs(loop.truth.yaw) < pi / 8
    else:
        assert min(run.v) == 0.0
        assert loop.truth.distance(start) < 0.05
        assert run.commands[-1].reason == reasons.BLOCKED.code


@pytest.mark.parametrize("name", NAMES)
def test_who_watches_sees_what_was_weighed_up(name: str) -> None:
    world, start, goal = TinyWorld(8, 4), Pose2(1.0, 2.0, 0.0), Pose2(6.0, 2.0, 0.0)
    loop = ControlLoop(ROBOT, world, start, config(name)).give(drive_goal(goal), planned(world, start, goal, 0.25))
    loop.drive(1.5)
    watched(loop)
    shown = pictures(loop)["debug/rollouts"]
    assert len(shown.xs) == (1 if name == "pursuit" else 25)
    assert np.isfinite(shown.costs).all()
    assert shown.xs[0, -1] != shown.xs[0, 0]


@pytest.mark.parametrize("name", ["mppi", "dwa", "pursuit"])
def test_a_robot_with_its_axle_far_behind_its_bumper_sees_what_is_before_that(name: str) -> None:
    outline = ((-0.3, -0.2), (2.0, -0.2), (2.0, 0.2), (-0.3, 0.2))
    drive = {**ROBOT.drive.model_dump(), "max_speed": 0.3}
    long = Robot.model_validate({**ROBOT.model_dump(), "footprint": outline, "drive": drive})
    world = TinyWorld(8, 4).box(3.8, 1.0, 4.0, 3.0)
    ahead = np.column_stack((np.linspace(1.0, 7.0, 120), np.full(120, 2.0)))
    loop = ControlLoop(long, world, Pose2(1.0, 2.0), LocalCtrlConfig(controller=name, mppi=MppiConfig(rollouts=128)))
    loop.give(drive_goal(Pose2(7.0, 2.0)), ahead)
    loop.drive(8.0)
    assert loop.run.least_clearance > 0.0
