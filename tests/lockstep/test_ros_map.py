# SPDX-License-Identifier: Apache-2.0
"""A map of ROS map_server, given to a stack: the robot is found on it by driving, as on a map of the stack's own."""

import numpy as np
import pytest

from services.mapper.maps.map_file import pack_map, unpack_map
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapMode
from shared.ros_map import write_ros_map
from shared.types import Bools
from tests.lockstep.stack import QUICK, LockstepStack
from tests.lockstep.test_map_modes import ELSEWHERE, by_hand, fetch, start
from zenav.maps.foreign_map import read_map
from zenav.maps.map_files import coarse_cells, grid_from_update


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Folders with the hall's map as pgm and yaml alone, of 5 and 10 cm a cell."""
    stack = LockstepStack(tmp_path_factory.mktemp("drawn"), settings=QUICK)
    stack.go(7.0)
    stack.until(stack.reached, 40.0)
    grid = grid_from_update(unpack_map(fetch(stack), "the mapper's").tiles)
    folder = tmp_path_factory.mktemp("ros")
    for step in (1, 2):
        write_ros_map(folder / str(step), coarse_cells(grid.cells, step), step * grid.resolution, grid.x0, grid.y0)
    return folder


def driven_until_good(stack: LockstepStack) -> None:
    for k in range(40):
        by_hand(stack, 0.25, 0.35 if k % 4 < 2 else -0.35, 1.0)
        if stack.newest["pose"].state is Localization.GOOD:
            break
    by_hand(stack, 0.0, 0.0, 0.5)
    assert stack.newest["pose"].state is Localization.GOOD
    hall_from_map = stack.truth.world_from_base @ stack.newest["pose"].map_from_base.inverse()
    assert (hall_from_map.x, hall_from_map.y, hall_from_map.yaw) == pytest.approx((1.0, 2.0, 0.0), abs=0.07)


@pytest.mark.parametrize("step", [1, 2])
def test_the_robot_is_found_without_a_pose_and_drives_to_a_goal(pictures, tmp_path, step):
    content = pack_map(read_map(pictures / str(step), 0.05))
    stack = LockstepStack(tmp_path, ELSEWHERE, settings=QUICK)
    start(stack, MapMode.LOCALISE, content)
    stack.lockstep.run(0.5)
    assert stack.newest["pose"].state is Localization.LOST
    driven_until_good(stack)
    stack.go(2.0)
    stack.until(stack.reached, 60.0)
    assert fetch(stack) == content, "to the byte"


def test_mapping_goes_on_with_it(pictures, tmp_path):
    loaded = read_map(pictures / "1", 0.05)
    stack = LockstepStack(tmp_path, ELSEWHERE, settings=QUICK)
    start(stack, MapMode.CONTINUE, pack_map(loaded))
    driven_until_good(stack)
    stack.go(2.0)
    stack.until(stack.reached, 60.0)
    gone_on = unpack_map(fetch(stack), "the mapper's")
    new = gone_on.graph.nodes > loaded.graph.nodes[-1]
    assert new.sum() > 5
    joined = gone_on.graph.loop & gone_on.graph.on & (gone_on.graph.i <= loaded.graph.nodes[-1])
    assert joined.sum() > 5, "new keyframes are tied to the map"
    before, after = grid_from_update(loaded.tiles), grid_from_update(gone_on.tiles)
    assert share_near(surface_of(before), before, after) > 0.97, "no wall is lost"
    assert share_near(after.occupied, after, before) > 0.97, "and none doubled"


def surface_of(grid: OccupancyGrid) -> Bools:
    """(h, w) occupied cells beside free ones."""
    free = np.pad(grid.free, 1)
    return grid.occupied & (free[2:, 1:-1] | free[:-2, 1:-1] | free[1:-1, 2:] | free[1:-1, :-2])


def share_near(cells: Bools, grid: OccupancyGrid, other: OccupancyGrid) -> float:
    """Of cells (h, w) of a grid, the share with an occupied cell of the other one within two cells."""
    rows, columns = np.argwhere(cells).T
    centres = np.column_stack((columns + 0.5, rows + 0.5)) * grid.resolution + (grid.x0, grid.y0)
    walls = np.argwhere(other.occupied)
    away = np.abs(other.cells_of(centres)[:, None] - walls[None]).max(axis=2).min(axis=1)
    return float((away <= 2).mean())
