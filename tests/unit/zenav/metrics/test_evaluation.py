# SPDX-License-Identifier: Apache-2.0
"""A run's figures, on runs whose figures are known."""

from math import hypot, pi, radians

import numpy as np
import pytest
from numpy.testing import assert_allclose

from services.sim.world import World
from services.sim.world_loader import load_world
from shared.geometry import Pose2, arc
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapUpdate, Odometry, PoseEstimate, Truth
from zenav.metrics.evaluation import (
    RunTrack,
    aligned_map_errors,
    completeness,
    evaluation_summary,
    explored_share,
    map_errors,
    occupied_middles,
    pose_errors,
    visible_surface,
)
from zenav.render.floor_plan import GoalMark, floor_plan

WORLD = load_world("room")
START = WORLD.start
RADIUS = 0.22
REACH = 12.0
TICK = 20_000_000


def driven(map_error: Pose2 = Pose2(), n: int = 100, odom_drift: float = 0.0) -> RunTrack:  # noqa: B008  # frozen
    """A curve through the room; the mapper knows its pose but for `map_error`, odometry drifts by a share."""
    track, map_from_base, odom_from_base = RunTrack(), Pose2(), Pose2()
    empty = np.zeros(0, np.float32)
    for i in range(n):
        stamp = (i + 1) * TICK
        truth = Truth(stamp, START @ map_from_base, START, 0.5, 0.1, False, 0, 0.01 * i, empty, empty)
        track.add(truth, stamp)
        track.add(Odometry(stamp, odom_from_base, 0.5, 0.1, np.zeros(9)), stamp)
        if i % 10 == 0:
            told = map_from_base @ map_error
            from_odom = told @ odom_from_base.inverse()
            track.add(PoseEstimate(stamp, told, from_odom, np.zeros(9), 1.0, Localization.GOOD), stamp)
        map_from_base = map_from_base @ arc(0.01, 0.002)
        odom_from_base = odom_from_base @ arc(0.01 * (1 + odom_drift), 0.002)
    return track


def true_map(world_from_map: Pose2, known: float = 1.0) -> OccupancyGrid:
    """The map that a perfect mapper draws, in its own frame, of the lower `known` share of the world."""
    grid = OccupancyGrid(0.05, 1)
    side = 64 * 10
    rows, columns = np.mgrid[:side, :side]
    x, y = (columns.ravel() + 0.5) * 0.05 - side * 0.025, (rows.ravel() + 0.5) * 0.05 - side * 0.025
    in_world = world_from_map @ np.column_stack((x, y))
    occupied, x0, y0 = WORLD.occupied(0.05)
    r, c = np.floor((in_world[:, ::-1] - (y0, x0)) / 0.05).astype(int).T
    held = (r >= 0) & (c >= 0) & (r < occupied.shape[0]) & (c < occupied.shape[1]) & (r < known * occupied.shape[0])
    cells = np.full(len(x), -1, np.int8)
    cells[held] = np.where(occupied[r[held], c[held]], 100, 0)
    tiles = cells.reshape(10, 64, 10, 64).swapaxes(1, 2).reshape(100, 4096)
    index = np.arange(100, dtype=np.int32)
    grid.apply(MapUpdate(1, 1, 1, 0.05, index // 10 - 5, index % 10 - 5, tiles))
    return grid


def test_a_perfect_run_has_no_pose_error():
    metres, angles = pose_errors(driven())
    assert len(metres) == 100
    assert_allclose(metres, 0, atol=1e-9)
    assert_allclose(angles, 0, atol=1e-9)


def test_the_mapper_s_error_is_the_pose_error():
    metres, angles = pose_errors(driven(Pose2(0.03, 0.04, radians(2))))
    assert metres[0] == pytest.approx(0.05)
    assert_allclose(np.degrees(angles), 2, atol=1e-6)


def test_what_odometry_drifts_between_two_scans_counts():
    metres, _ = pose_errors(driven(odom_drift=0.1))
    assert metres.max() == pytest.approx(9 * 0.01 * 0.1, rel=0.02)  # the last odometry before the next pose


def test_yaw_is_compared_around_the_turn():
    track = driven()
    track.truths = [(t, x, y, yaw + 2 * pi) for t, x, y, yaw in track.truths]
    assert_allclose(pose_errors(track)[1], 0, atol=1e-9)


def test_a_run_without_poses_has_figures_all_the_same():
    figures = evaluation_summary(RunTrack(), WORLD, RADIUS, REACH)
    assert figures["pose_error_mean_m"] is None
    assert figures["explored_share"] == 0.0


@pytest.mark.parametrize("world_from_map", [START, Pose2(1.0, -0.5, 0.7) @ START])
def test_a_perfect_map_is_explored_and_on_the_walls(world_from_map):
    grid = true_map(world_from_map)
    assert explored_share(grid, WORLD, world_from_map, RADIUS) == 1.0
    errors = map_errors(grid, WORLD, world_from_map)
    on_surface = errors <= 0.05
    assert len(errors) > 100
    assert on_surface.mean() > 0.3  # the rest is the walls' inside, which a laser never sees


def test_half_a_map_is_explored_in_part():
    share = explored_share(true_map(START, 0.5), WORLD, START, RADIUS)
    assert 0.2 < share < 0.8


def test_a_wall_in_the_wrong_place_is_as_far_off_as_it_is():
    grid = OccupancyGrid(0.05, 1)
    cells = np.full((1, 4096), -1, np.int8)
    cells[0, 0] = 100
    zero = np.zeros(1, np.int32)
    grid.apply(MapUpdate(1, 1, 1, 0.05, zero, zero, cells))
    (error,) = map_errors(grid, WORLD, START)
    x, y = START.x, START.y
    at = START @ Pose2(0.025, 0.025)
    outline = WORLD.outline()
    steps = np.linspace(0, 1, 2001)[:, None]
    nearest = min(
        float(np.hypot(*((a + steps * (b - a)) - (at.x, at.y)).T).min()) for a, b in outline.reshape(-1, 2, 2)
    )
    assert error == pytest.approx(nearest, abs=0.01)
    assert hypot(x - at.x, y - at.y) < 0.05


def test_the_first_motion_is_when_the_truth_moves():
    assert driven().first_motion == TICK


def test_the_picture_is_one():
    from io import BytesIO

    from PIL import Image

    track = driven()
    track.grid = true_map(START)
    image = Image.open(BytesIO(floor_plan(track, WORLD, [GoalMark("there", Pose2(1, 0, 0), False)])))
    assert image.size[0] == 1800
    assert len(image.getcolors(1 << 20)) > 5


def test_aligned_what_is_wrong_with_the_frame_alone_goes_and_is_told():
    grid, off = true_map(START), Pose2(0.06, -0.03, 0.004)
    middles = occupied_middles(grid, START)
    inner = WORLD.solid_at(middles) & (map_errors(grid, WORLD, START) > 0.04)
    cells = grid.cells.copy()
    cells[tuple(np.argwhere(grid.occupied)[inner].T)] = -1  # what no laser sees
    grid.cells = cells
    before, (after, found) = map_errors(grid, WORLD, off @ START), aligned_map_errors(grid, WORLD, off @ START)
    assert (before <= 0.05).mean() < 0.9
    assert (after <= 0.05).mean() > 0.97
    back = found @ off
    assert hypot(back.x, back.y) < 0.02
    assert abs(back.yaw) < 0.004


def box(low_x: float, low_y: float, high_x: float, high_y: float) -> np.ndarray:
    return np.array([(low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)])


def hall(*solid: np.ndarray) -> World:
    """A hall of 6 x 4 m between walls 0.2 m thick, with what stands in it."""
    walls = box(-0.2, -0.2, 6.2, 0), box(-0.2, 4, 6.2, 4.2), box(-0.2, -0.2, 0, 4.2), box(6, -0.2, 6.2, 4.2)
    return World("hall", (-0.2, -0.2, 6.2, 4.2), Pose2(1, 1, 0), (*walls, *solid))


def test_only_the_inner_sides_of_a_hall_can_be_seen():
    seen = visible_surface(hall(), 0.2, REACH)
    x, y = seen.T
    on_a_side = (np.abs(x) < 1e-9) | (np.abs(x - 6) < 1e-9) | (np.abs(y) < 1e-9) | (np.abs(y - 4) < 1e-9)
    corner = 0.03  # m of the outer walls' ends, beside a beam's end
    assert (on_a_side | ((x > -corner) & (x < 6 + corner) & (y > -corner) & (y < 4 + corner))).all()
    for side in (x[np.abs(y) < 1e-9], x[np.abs(y - 4) < 1e-9]):
        assert np.diff(np.sort(side)).max() < 0.05


def test_what_stands_behind_something_where_the_robot_cannot_go_is_not_visible():
    cupboard, beside_wall = box(2, 0, 2.2, 0.6), box(2.6, 0, 2.8, 0.6)  # 0.4 m apart: too narrow for the robot
    seen = visible_surface(hall(cupboard, beside_wall), 0.3, REACH)
    between = seen[(seen[:, 0] > 2.25) & (seen[:, 0] < 2.55) & (np.abs(seen[:, 1]) < 1e-9)]
    assert len(between) > 10  # the robot sees the wall through the gap
    closed = visible_surface(hall(cupboard, beside_wall, box(2, 0.6, 2.8, 0.7)), 0.3, REACH)
    assert not len(closed[(closed[:, 0] > 2.25) & (closed[:, 0] < 2.55) & (np.abs(closed[:, 1]) < 0.5)])


def test_a_wall_beyond_the_laser_s_reach_is_not_visible():
    long = World(
        "long", (0, 0, 20, 2), Pose2(1, 1, 0),
        (box(0, -0.2, 20, 0), box(0, 2, 20, 2.2), box(-0.2, 0, 0, 2), box(20, 0, 20.2, 2), box(6, 0, 6.2, 0.9),
         box(6, 1.1, 6.2, 2)),
    )  # fmt: skip  # the robot stays left of the gap at 6 m
    assert visible_surface(long, 0.3, 30.0)[:, 0].max() == pytest.approx(20, abs=0.03)
    assert visible_surface(long, 0.3, 5.0)[:, 0].max() < 10.8


@pytest.mark.parametrize(("world_from_map", "share"), [(START, 0.98), (WORLD.start @ Pose2(0, 0, -pi / 4), 0.995)])
def test_a_perfect_map_is_complete(world_from_map, share):
    """A map whose cells are turned against the world's misses some of what its cells touch."""
    assert share < completeness(true_map(world_from_map), WORLD, world_from_map, RADIUS, REACH) <= 1


def test_half_a_map_is_complete_in_part_though_all_of_its_walls_are_right():
    half = true_map(START, 0.5)
    assert map_errors(half, WORLD, START).mean() == pytest.approx(
        map_errors(true_map(START), WORLD, START).mean(), abs=0.05
    )
    assert 0.3 < completeness(half, WORLD, START, RADIUS, REACH) < 0.7


def test_a_map_whose_walls_are_elsewhere_is_not_complete():
    assert completeness(true_map(START), WORLD, Pose2(0.15, 0.15, 0) @ START, RADIUS, REACH) < 0.5


def test_without_a_map_nothing_is_complete():
    assert completeness(OccupancyGrid(), WORLD, START, RADIUS, REACH) == 0.0
    assert evaluation_summary(RunTrack(), WORLD, RADIUS, REACH)["map_completeness"] == 0.0
