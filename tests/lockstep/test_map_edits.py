# SPDX-License-Identifier: Apache-2.0
"""An edited map and the whole stack: an erased phantom lets the robot through, and a virtual wall turns it back."""

from dataclasses import replace

import numpy as np
import pytest

from services.mapper.grid.edit_cells import edited_rows_and_columns, with_edits
from services.mapper.maps.map_file import SavedMap, pack_map, unpack_map
from shared import requests
from shared.geometry import Pose2
from shared.messages import EditKind, Localization, MapEdit, MapMode, NavState
from shared.recording import CONFIG, Writer, sink
from shared.requests import EditMap, Navigate
from shared.runners.lockstep import Lockstep
from tests.lockstep.stack import QUICK, LockstepStack
from tests.lockstep.test_map_modes import StackMapClient, fetch, start
from zenav.maps.map_files import grid_from_update
from zenav.replay.reprocess import replay_file
from zenav.stack.service_loader import build_service

ROOMS = """
start: {x: 2.0, y: 3.0}
walls:
  - {points: [[0, 0], [10, 0], [10, 6], [0, 6]], closed: true}
boxes:
  - {x: 5.0, y: 0.4, size: [0.4, 0.8]}
  - {x: 5.0, y: 3.0, size: [0.4, 2.0]}
  - {x: 5.0, y: 5.6, size: [0.4, 0.8]}
  - {x: 8.0, y: 5.7, size: [0.6, 0.6]}
"""
"""Two rooms, and a wall between them with a door of 1.2 m in the south and one in the north."""
SOUTH, NORTH = ((3.0, -2.4), (3.0, -0.8)), ((3.0, 0.8), (3.0, 2.4))
"""Lines across the doors, m in `map`, which begins at the robot."""


def across(kind, line, width=0.2):
    xs, ys = np.array(line, float).T
    return MapEdit(0, 0, EditKind(kind), xs.copy(), ys.copy(), width)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> SavedMap:
    """The rooms' map, from a drive through both doors."""
    stack = LockstepStack(tmp_path_factory.mktemp("mapped"), ROOMS, settings=QUICK)
    for place in ((6.0, -1.5), (6.0, 1.5), (0.0, 1.5), (0.0, 0.0)):
        stack.go(*place)
        stack.until(stack.reached, 60.0)
    return unpack_map(fetch(stack), "the rooms")


def localised(folder, saved: SavedMap) -> LockstepStack:
    stack = LockstepStack(folder, ROOMS, settings=QUICK)
    plans = stack.plans = []
    stack.lockstep.watch("plan", plans.append)
    start(stack, MapMode.LOCALISE, pack_map(saved), Pose2())
    stack.lockstep.run(1.5)
    assert stack.newest["pose"].state is Localization.GOOD
    return stack


def edit(stack, *edits, **values):
    reply = stack.lockstep.ask(requests.EDIT_MAP, EditMap(stack.now, edits, **values))
    assert reply.accepted, reply


def door_of(plan) -> str:
    """Which door the plan leads through."""
    return "south" if plan.ys[np.argmin(np.abs(plan.xs - 3.0))] < 0 else "north"


def test_a_phantom_in_the_doors_keeps_the_robot_out_until_it_is_erased(rooms, tmp_path):
    phantom = with_edits(rooms.tiles, [across("wall", SOUTH), across("wall", NORTH)])
    stack = localised(tmp_path, replace(rooms, tiles=phantom))
    stack.go(6.0)
    stack.until(stack.ended, 30.0)
    assert stack.newest["nav/status"].state is not NavState.REACHED
    assert stack.newest["nav/status"].reason == "unreachable"
    edit(stack, across("erase", SOUTH, 0.5))
    stack.go(6.0)
    stack.until(stack.reached, 60.0)
    assert door_of(next(plan for plan in reversed(stack.plans) if len(plan.xs) and plan.xs.min() < 3.0)) == "south"
    assert stack.newest["pose"].state is Localization.GOOD


def test_a_virtual_wall_sends_the_robot_through_the_other_door(rooms, tmp_path):
    stack = localised(tmp_path, rooms)
    stack.go(6.0, -1.5)
    stack.until(lambda: stack.plans and len(stack.plans[-1].xs), 5.0)
    assert door_of(stack.plans[-1]) == "south"
    edit(stack, across("wall", SOUTH, 0.1))
    lowest = []
    stack.lockstep.watch("sim/truth", lambda truth: lowest.append(door_offset(truth)))
    stack.until(stack.reached, 90.0)
    assert min(lowest) > 0, "the robot's centre was never in the south door"
    assert stack.newest["pose"].state is Localization.GOOD
    in_wall = Navigate(stack.now, (Pose2(3.0, -1.6, 0.0),), 0.0, 1, True)
    assert stack.lockstep.ask(requests.NAVIGATE, in_wall).reason == "goal_blocked"
    edit(stack, clear=True)
    stack.go(0.0, -1.5)
    stack.until(stack.reached, 60.0)
    assert min(lowest) < 0, "without the wall it drives through"


def door_offset(truth) -> float:
    """m that the robot is north of the rooms' middle while it is in a door; 1 elsewhere."""
    place = truth.world_from_base
    return place.y - 3.0 if 4.8 < place.x < 5.2 else 1.0


@pytest.mark.parametrize("mode", [MapMode.LOCALISE, MapMode.CONTINUE])
def test_a_mapper_that_died_comes_back_with_its_edits_and_what_lies_below_them(rooms, tmp_path, mode):
    stack = localised(tmp_path, rooms)
    start(stack, mode)
    edit(stack, across("wall", SOUTH, 0.1), across("erase", ((2.7, -3.2), (2.9, -2.6)), 0.3))
    stack.lockstep.run(6.0)
    before = unpack_map(fetch(stack), "before")
    stack.lockstep.kill("mapper")
    stack.lockstep.run(0.5)
    stack.start("mapper")
    stack.lockstep.run(3.0)
    after = unpack_map(fetch(stack), "after")
    assert stack.newest["pose"].state is not Localization.LOST
    assert stack.newest["pose"].map_from_base.distance(Pose2()) < 0.06
    assert [e.id for e in after.edits] == [e.id for e in before.edits] == [1, 2]
    wall = edited_rows_and_columns(after.edits[0], 0.05)
    shown = grid_from_update(stack.lockstep.latched["map"].message)
    place = tuple((wall - np.array((shown.first_row, shown.first_column)) * 64).T)
    assert (shown.cells[place] == 100).all()
    a, b = grid_from_update(before.tiles), grid_from_update(after.tiles)
    assert (b.cells[place] <= 25).sum() > 30, "below the wall the laser saw free space"
    assert (np.abs(a.cells[place].astype(int) - b.cells[place]) < 20).mean() > 0.9
    if mode is MapMode.LOCALISE:
        np.testing.assert_array_equal(a.cells >= 65, b.cells >= 65)
    edit(stack, clear=True)
    shown = grid_from_update(stack.lockstep.latched["map"].message)
    assert (np.abs(shown.cells[place].astype(int) - b.cells[place]) < 20).mean() > 0.9, "as before the wall"


def test_a_run_with_edits_is_replayed_to_the_byte(rooms, tmp_path):
    path, names = tmp_path / "run.mcap", ("sim", "base_driver", "odometry", "mapper")
    file = LockstepStack(tmp_path, ROOMS).file
    with Writer(path, {"robot": file.robot.name}, {CONFIG: file.text.encode()}) as writer:
        lockstep = Lockstep({name: build_service(name, file, file.robot) for name in names}, sink(writer))
        stack = StackMapClient(lockstep)
        stack.lockstep.run(3.0)
        assert lockstep.ask(requests.EDIT_MAP, EditMap(lockstep.now, (across("wall", SOUTH, 0.1),))).accepted
        lockstep.run(1.0)
        assert lockstep.ask(requests.EDIT_MAP, EditMap(lockstep.now, (), (1,))).accepted
        lockstep.run(1.0)
    report = replay_file(path, ["mapper"], None, lambda name: build_service(name, file, file.robot), lambda n, of: None)
    state = next(topic for topic in report.topics if topic.key == "map/state")
    assert state.n_equal == 2
    assert all(topic.n_different == topic.n_lacking == topic.n_new == 0 for topic in report.topics)
