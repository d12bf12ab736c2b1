# SPDX-License-Identifier: Apache-2.0
"""The closed loop: doors, boxes, walls, clutter, a turn at the start, and two of the BARN challenge's worlds."""

import gzip
import json
import os
from math import pi
from pathlib import Path

import numpy as np
import pytest

from services.local_ctrl.config import LocalCtrlConfig
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from tests.unit.services.local_ctrl.tiny_world import QUICK, ControlLoop, TinyRun, TinyWorld, drive_goal, off, planned

X80 = load_robot("x80sv").robot
JACKAL = load_robot("jackal").robot
DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # the environment says where the data is


def driven(
    world: TinyWorld,
    start: Pose2,
    goal: Pose2,
    known: TinyWorld | None = None,
    config: LocalCtrlConfig = QUICK,
    seconds: float = 30.0,
) -> tuple[ControlLoop, TinyRun]:
    """Drives the plan made on `known`, by default the world as it is."""
    loop = ControlLoop(X80, world, start, config).give(drive_goal(goal), planned(known or world, start, goal, 0.28))
    return loop, loop.drive(seconds)


def arrived(loop: ControlLoop, run: TinyRun, goal: Pose2) -> None:
    assert run.reached
    away, turned = off(loop.truth, goal)
    assert away <= 0.15
    assert turned <= 0.2
    assert run.least_clearance > 0


@pytest.mark.parametrize("start", [Pose2(1.0, 1.0, 0.0), Pose2(4.3, 2.0, pi / 2)])
def test_it_drives_through_a_door_without_swinging(start: Pose2) -> None:
    world = TinyWorld(10, 4).box(4.9, 0, 5.1, 4).box(4.8, 1.6, 5.2, 2.4, full=False)
    goal = Pose2(8.0, 3.0, pi / 2)
    loop, run = driven(world, start, goal, config=LocalCtrlConfig())
    arrived(loop, run, goal)
    assert run.least_clearance > 0.12
    assert run.seconds < 15
    turns = [command.w for command, pose in zip(run.commands, run.poses) if 4.0 < pose.x < 6.0 and abs(command.w) > 0.3]
    assert np.count_nonzero(np.diff(np.sign(turns))) <= 6


def test_it_drives_around_a_box_on_the_plan() -> None:
    goal = Pose2(8.0, 2.0, 0.0)
    world = TinyWorld(10, 4).box(4.0, 1.7, 4.5, 2.3)
    loop, run = driven(world, Pose2(1.0, 2.0, 0.0), goal, known=TinyWorld(10, 4))
    arrived(loop, run, goal)
    assert run.least_clearance > 0.12
    assert run.seconds < 15


def test_before_a_wall_on_the_plan_it_stops_and_says_blocked() -> None:
    world = TinyWorld(10, 4).box(4.0, 0.0, 4.2, 4.0)
    loop, run = driven(world, Pose2(1.0, 2.0, 0.0), Pose2(8.0, 2.0, 0.0), known=TinyWorld(10, 4), seconds=11)
    assert run.commands[-1].reason == run.statuses[-1].reason == reasons.BLOCKED.code
    assert run.least_clearance > 0.03
    assert run.v[-60:] == [0.0] * 60
    assert loop.truth.x > 2.5


def test_on_a_plan_that_lies_somewhere_else_it_stands_and_says_why() -> None:
    goal = Pose2(6.0, 2.0, 0.0)
    loop = ControlLoop(X80, TinyWorld(8, 4), Pose2(1.0, 2.0, 0.0)).give(
        drive_goal(goal), np.array([[1.0, 2.0], [6.0, 2.0]])
    )
    loop.drive(1.5)
    assert loop.run.v[-1] > 0.2
    loop.give(drive_goal(goal), np.array([[-50.0, 130.0], [-51.0, 130.0]]))
    loop.drive(1.5)
    assert loop.run.commands[-1].reason == loop.run.statuses[-1].reason == reasons.POSE_JUMPED.code
    assert loop.run.v[-10:] == [0.0] * 10
    loop.give(drive_goal(goal), np.array([[1.0, 2.0], [6.0, 2.0]]))
    loop.drive(15)
    arrived(loop, loop.run, goal)


def test_when_the_way_opens_again_it_drives_on() -> None:
    world = TinyWorld(8, 4).box(3.0, 0.0, 3.2, 4.0)
    goal = Pose2(6.0, 2.0, 0.0)
    loop = ControlLoop(X80, world, Pose2(1.0, 2.0, 0.0)).give(drive_goal(goal), np.array([[1.0, 2.0], [6.0, 2.0]]))
    loop.drive(6)
    assert loop.run.commands[-1].reason == reasons.BLOCKED.code
    loop.world = TinyWorld(8, 4)
    loop.drive(15)
    arrived(loop, loop.run, goal)


def test_a_path_that_begins_behind_is_taken_by_turning_on_the_spot() -> None:
    world = TinyWorld(10, 1.4)  # no room for an arc
    start, goal = Pose2(8.0, 0.7, 0.0), Pose2(1.0, 0.7, pi)
    loop, run = driven(world, start, goal)
    arrived(loop, run, goal)
    turning = [pose for pose in run.poses if abs(pose.yaw) < pi / 2]
    assert max(pose.distance(start) for pose in turning) < 0.15
    assert min(run.v) > -0.05


def test_turning_on_the_spot_goes_back_where_the_way_has_become_another() -> None:
    start = Pose2(5.0, 5.0, 0.0)
    left, right = ((start @ Pose2(0.0, 0.0, yaw)) @ Pose2(3.0) for yaw in (2.4, -1.3))
    loop = ControlLoop(X80, TinyWorld(10, 10), start).give(drive_goal(left), np.array([[5.0, 5.0], [left.x, left.y]]))
    while loop.truth.yaw < 1.0:
        loop.drive(0.1)
    loop.give(drive_goal(right, goal_id=2), np.array([[5.0, 5.0], [right.x, right.y]])).drive(8)
    assert max(pose.yaw for pose in loop.run.poses) < 1.6
    assert min(pose.yaw for pose in loop.run.poses) > -2.0
    arrived(loop, loop.run, right)


def test_an_open_floor_is_crossed_at_full_speed_without_a_stop() -> None:
    goal = Pose2(8.0, 2.0, 1.0)
    loop, run = driven(TinyWorld(10, 4), Pose2(1.0, 2.0, 0.0), goal)
    arrived(loop, run, goal)
    cruising = [v for v, pose in zip(run.v, run.poses) if 2.0 < pose.x < 7.0]
    assert min(cruising) > 0.7
    assert np.mean(np.abs(np.diff([command.w for command in run.commands]))) < 0.08


def cluttered(seed: int) -> TinyWorld:
    """Ten discs that no plan knows of, with a passage between them."""
    rng = np.random.default_rng(seed)
    while True:
        world = TinyWorld(6, 4)
        for _ in range(8):
            world.disc(rng.uniform(1.3, 4.7), rng.uniform(0.3, 3.7), rng.uniform(0.05, 0.25))
        try:
            planned(world, Pose2(0.6, 2.0), Pose2(5.4, 2.0), 0.32)
        except ValueError:
            continue
        return world


@pytest.mark.parametrize("seed", range(12))
def test_clutter_that_the_plan_ignores_is_not_touched(seed: int) -> None:
    start, goal = Pose2(0.6, 2.0, 0.0), Pose2(5.4, 2.0, 0.0)
    loop, run = driven(cluttered(seed), start, goal, known=TinyWorld(6, 4))
    arrived(loop, run, goal)
    assert run.least_clearance > 0.03


def test_a_person_who_walks_into_the_way_is_not_touched_and_leaves_no_ghost() -> None:
    goal = Pose2(6.0, 2.0, 0.0)
    loop = ControlLoop(X80, TinyWorld(8, 4), Pose2(1.0, 2.0, 0.0)).give(
        drive_goal(goal), np.array([[1.0, 2.0], [6.0, 2.0]])
    )
    for i in range(80):
        loop.world = TinyWorld(8, 4).disc(3.5, 0.3 + 0.03 * i, 0.2)  # 0.3 m/s across
        loop.drive(0.1, until=lambda _: False)
    assert loop.run.least_clearance > 0
    loop.world = TinyWorld(8, 4)
    loop.drive(15)
    arrived(loop, loop.run, goal)


def barn(world_id: str) -> tuple[TinyWorld, Pose2, Pose2]:
    assert DATA is not None
    text = gzip.decompress((Path(DATA) / "barn" / "barn_worlds.json.gz").read_bytes())
    worlds = json.loads(text)
    shift = np.array((5.0, 1.0))
    cylinders = np.array(worlds["worlds"][world_id]["cylinders"]) + shift
    width, height = cylinders.max(axis=0) + 1.0
    world = TinyWorld(max(width, 6.0), max(height, 16.0))
    rows, columns = np.indices((9, 9)) - 4
    for x, y in cylinders:
        row, column = int(y / world.cell), int(x / world.cell)
        near = np.hypot((rows + row + 0.5) * world.cell - y, (columns + column + 0.5) * world.cell - x) <= 0.075
        world.occupied[(rows + row)[near], (columns + column)[near]] = True
    start, goal = worlds["start"], worlds["goal"]
    return world, Pose2(start[0] + 5, start[1] + 1, start[2]), Pose2(goal[0] + 5, goal[1] + 1, start[2])


@pytest.mark.skipif(DATA is None, reason="ZENAV_DATA is not set: no BARN worlds")
@pytest.mark.parametrize("world_id", ["101", "283"])
def test_a_jackal_gets_through_a_barn_world_fast(world_id: str) -> None:
    world, start, goal = barn(world_id)
    loop = ControlLoop(JACKAL, world, start, LocalCtrlConfig(), delay=0.06)
    loop.give(drive_goal(goal, tolerance=1.0, yaw_tolerance=10.0), planned(world, start, goal, 0.3))
    run = loop.drive(25)
    assert run.reached
    assert run.least_clearance > 0.03
    assert run.seconds < 10
