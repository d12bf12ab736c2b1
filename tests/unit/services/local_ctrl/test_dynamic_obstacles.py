# SPDX-License-Identifier: Apache-2.0
"""What came into seen-free space is followed as a disc with a velocity; what merely comes into sight is not."""

from functools import cache
from math import cos, pi, sin

import numpy as np
import pytest
from numpy.testing import assert_allclose

from services.local_ctrl.config import CONTROLLERS, LocalCtrlConfig
from services.local_ctrl.controller import ControlScene
from services.local_ctrl.cost_to_go import CostToGoConfig
from services.local_ctrl.dynamic_obstacles import (
    DynamicObstacle,
    DynamicObstaclesConfig,
    TrackersByLaser,
    predicted_discs,
)
from services.local_ctrl.footprint import footprint_of
from services.local_ctrl.local_costmap import CostmapConfig, LocalCostmap
from services.local_ctrl.local_plan import LocalPlan
from services.local_ctrl.mppi import Mppi, MppiConfig
from services.local_ctrl.path_following import PathFollower, PathFollowingConfig
from services.local_ctrl.rollout import Motion, limits_of
from services.local_ctrl.zones import LocalZones
from shared.config import Mount, load_robot
from shared.geometry import Pose2
from shared.messages import Goal, LaserScan
from shared.types import NS_PER_S

MS = 10**6
PERIOD_NS = 50 * MS
N = 720
STEP = 2 * pi / N
EXACT_M, EXACT_M_S = 0.02, 0.05
"""Of a disc seen without noise: its echoes lie on a circle, and what is found of it is off by 1 um and 1 um/s."""


def ranges_of(discs: list[tuple[float, float, float]], x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """The true ranges of a full turn from (x, y), 8 m where nothing is nearer: a round room."""
    ranges = np.full(N, 8.0)
    for i in range(N):
        c, s = cos(i * STEP - pi), sin(i * STEP - pi)
        for a, b, radius in discs:
            along, across = (a - x) * c + (b - y) * s, (b - y) * c - (a - x) * s
            if along > 0 and abs(across) < radius:
                ranges[i] = min(ranges[i], along - np.sqrt(radius**2 - across**2))
    return ranges.astype(np.float32)


def seen(
    costmap: LocalCostmap, k: int, discs: list[tuple[float, float, float]], x: float = 0.0, turns: float = 1.0
) -> int:
    """turns: 1 counter-clockwise, -1 clockwise."""
    ranges = ranges_of(discs, x)
    return seen_as(costmap, k, ranges if turns > 0 else np.roll(ranges[::-1], 1), x, turns)


def seen_as(costmap: LocalCostmap, k: int, ranges: np.ndarray, x: float = 0.0, turns: float = 1.0) -> int:
    """The k-th scan, with these ranges; its stamp."""
    stamp = 10 * NS_PER_S + k * PERIOD_NS
    scan = LaserScan(stamp, -turns * pi, turns * STEP, 0.0, 0.1, 30.0, ranges)
    costmap.add_scan(scan, np.tile((x, 0.0, 0.0), (N, 1)), Mount())
    return stamp


def made() -> LocalCostmap:
    costmap = LocalCostmap(CostmapConfig(dynamic_obstacles=DynamicObstaclesConfig(enabled=True)), 4.0)
    costmap.recentre(0.0, 0.0)
    return costmap


@pytest.mark.parametrize(("vx", "vy", "radius"), [(0.0, 1.2, 0.5), (-1.0, 0.4, 0.25), (0.5, -0.6, 0.15)])
def test_a_disc_that_moves_is_followed_where_it_is_and_goes(vx, vy, radius):
    costmap = made()
    for k in range(14):
        t = k * PERIOD_NS / NS_PER_S
        x, y = 2.0 + vx * (t - 0.3), vy * (t - 0.3)
        stamp = seen(costmap, k, [(x, y, radius), (-1.5, 1.0, 0.3)])
    ((px, py, pvx, pvy, found, turn),) = costmap.dynamic_obstacles.discs(stamp).tolist()
    assert_allclose((px, py), (x, y), atol=EXACT_M)
    assert_allclose((pvx, pvy), (vx, vy), atol=EXACT_M_S)
    assert_allclose(found, radius, atol=EXACT_M)
    assert abs(turn) < 0.15
    ahead = costmap.dynamic_obstacles.discs(stamp + NS_PER_S)[0]
    assert_allclose(ahead[:2], (px + pvx, py + pvy), atol=EXACT_M_S)


@pytest.mark.parametrize("turn", [0.6, -0.6])
def test_one_that_bends_its_way_is_expected_on_its_arc(turn):
    def at(t: float) -> tuple[float, float]:
        return 2.5 - 1.2 / turn * (1 - cos(turn * t)), 1.2 / turn * sin(turn * t)

    costmap = made()
    for k in range(20):
        t = k * PERIOD_NS / NS_PER_S - 0.95
        stamp = seen(costmap, k, [(*at(t), 0.4)])
    discs = costmap.dynamic_obstacles.discs(stamp)
    assert_allclose(discs[0, 5], turn, atol=0.15)
    ways = predicted_discs(discs, 20)
    assert_allclose(ways[-1, 0, :2], at(t + 1.0), atol=0.15)
    assert_allclose(ways[-1, 0, 2], discs[0, 4])
    assert np.hypot(*(discs[0, :2] + discs[0, 2:4] - at(t + 1.0))) > 0.25  # straight on it would be elsewhere


def test_one_that_turns_back_is_expected_where_it_goes_now():
    costmap = made()
    for k in range(24):
        y = 1.2 * abs(k - 19) * PERIOD_NS / NS_PER_S - 0.4
        stamp = seen(costmap, k, [(2.5, y, 0.4)])
    ((_, _, vx, vy, _, _),) = costmap.dynamic_obstacles.discs(stamp).tolist()
    assert_allclose((vx, vy), (0.0, 1.2), atol=EXACT_M_S)


def test_what_moves_goes_on_where_nobody_saw_that_it_was_free_until_it_stands():
    mover = DynamicObstacle()
    for k in range(60):
        share, y = float(k < 12), 0.05 * min(k, 40)
        mover.update(k * PERIOD_NS, (2.0, y, 0.5, share, 1.0), (0.0, 0.0), 0.2)
        assert mover.moves or not 5 <= k <= 40, k
    assert not mover.moves


def test_what_is_wider_than_a_known_disc_is_it_and_another():
    mover = DynamicObstacle()
    for k in range(10):
        mover.update(k * PERIOD_NS, (2.0, 0.05 * k, 0.5, 1.0, 1.0), (0.0, 0.0), 0.2)
    assert mover.moves
    assert mover.is_hidden((2.0, 0.8, 0.75, 1.0, 0.0))
    assert not mover.is_hidden((2.0, 0.5, 0.5, 1.0, 1.0))


def test_a_disc_that_creeps_is_followed_too():
    costmap = made()
    for k in range(50):
        stamp = seen(costmap, k, [(2.0, 0.28 * (k * PERIOD_NS / NS_PER_S - 1.0), 0.5)])
    ((_, _, vx, vy, _, _),) = costmap.dynamic_obstacles.discs(stamp).tolist()
    assert_allclose((vx, vy), (0.0, 0.28), atol=EXACT_M_S)


@pytest.mark.parametrize("turns", [1.0, -1.0])
def test_two_that_touch_are_two_and_each_goes_its_own_way(turns):
    costmap = made()
    for k in range(30):
        t = k * PERIOD_NS / NS_PER_S - 1.45
        # they come from both sides, and overlap by a fifth at the end
        stamp = seen(costmap, k, [(2.0, -0.4 + 1.0 * t, 0.5), (2.0, 0.4 - 0.6 * t, 0.5)], turns=turns)
    discs = costmap.dynamic_obstacles.discs(stamp)
    assert len(discs) == 2
    found = discs[np.argsort(discs[:, 1])]
    assert_allclose(found[:, :2], [(2.0, -0.4), (2.0, 0.4)], atol=EXACT_M)
    assert_allclose(found[:, 2:4], [(0.0, 1.0), (0.0, -0.6)], atol=0.1)  # 0.067 is measured


def behind_a_post(noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """(40, 2) of each scan from 1 s on, while a disc at 1 m/s passes behind a post: m and m/s that it is off."""
    costmap, rng, errors = made(), np.random.default_rng(seed), []
    for k, ranges in enumerate(passing()):
        y = 1.0 * (k * PERIOD_NS / NS_PER_S - 1.5)
        noisy = (ranges + rng.normal(0.0, noise, N)).astype(np.float32) if noise else ranges
        stamp = seen_as(costmap, k, noisy)
        if k >= 20:
            moving = costmap.dynamic_obstacles.discs(stamp)
            nearest = moving[np.argmin(np.hypot(moving[:, 0] - 2.5, moving[:, 1] - y))]
            errors.append(np.abs(nearest[:4] - (2.5, y, 0.0, 1.0)).reshape(2, 2).max(axis=1))
    return np.array(errors)


@cache
def passing() -> list[np.ndarray]:
    """The true ranges of 60 scans: a disc passes behind a post."""
    return [ranges_of([(1.0, 0.0, 0.15), (2.5, k * PERIOD_NS / NS_PER_S - 1.5, 0.5)]) for k in range(60)]


def test_one_that_goes_behind_a_post_keeps_its_place_and_speed():
    errors = behind_a_post()
    assert (errors.max(axis=0) < (EXACT_M, EXACT_M_S)).all()


def test_one_that_goes_behind_a_post_is_followed_with_noise_too_and_well_once_it_is_past():
    """1 cm of noise. Of 16 seeds the worst is 0.36 m off; the mean is 0.16 m/s, in the last 8 scans 0.12 m/s at most.

    While it is hidden in part, 2 of the 16 are off by twice its speed for a moment: that is not bounded here.
    """
    errors = np.array([behind_a_post(0.01, seed) for seed in range(16)])
    assert errors[:, :, 0].max() < 0.45, "less than its radius"
    assert errors[:, :, 1].mean() < 0.19
    assert (errors[:, -8:, 1] < 0.15).all()


def test_what_moves_leaves_nothing_in_the_window_and_what_stands_stays():
    costmap = made()
    for k in range(20):
        stamp = seen(costmap, k, [(2.0, 1.2 * (k * PERIOD_NS / NS_PER_S - 0.5), 0.4), (-1.5, 1.0, 0.3)])
    costmap.refresh(stamp, Pose2(), footprint_of(load_robot("jackal").robot, 0.03))
    rows, columns = np.nonzero(costmap.occupied)
    x, y = costmap.x0 + columns * costmap.resolution, costmap.y0 + rows * costmap.resolution
    assert (np.hypot(x + 1.5, y - 1.0) < 0.4).any()
    assert not ((x > 1.0) & (x < 3.0) & (abs(y) < 2.0)).any()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_what_moves_is_an_obstacle_where_it_is_unless_the_controller_predicts_it(controller):
    tracking = CostmapConfig(dynamic_obstacles=DynamicObstaclesConfig(enabled=True))
    costmap = LocalCostmap(LocalCtrlConfig(controller=controller, costmap=tracking).tracked_costmap, 4.0)
    costmap.recentre(0.0, 0.0)
    for k in range(20):
        place = 2.0, 1.2 * (k * PERIOD_NS / NS_PER_S - 0.5), 0.4
        stamp = seen(costmap, k, [place])
    costmap.refresh(stamp, Pose2(), footprint_of(load_robot("jackal").robot, 0.03))
    rows, columns = np.nonzero(costmap.occupied)
    x, y = costmap.x0 + columns * costmap.resolution, costmap.y0 + rows * costmap.resolution
    is_in_costmap = bool((np.hypot(x - place[0], y - place[1]) < 0.5).any())
    assert is_in_costmap != bool(len(costmap.moving_discs))
    assert is_in_costmap == (controller != "mppi")


def test_nothing_moves_in_a_world_that_stands_however_the_robot_drives():
    costmap = made()
    rng = np.random.default_rng(3)
    posts = [(a, b, 0.075) for a, b in rng.uniform(-3.5, 3.5, (60, 2)).tolist() if abs(b) > 0.5]
    for k in range(40):
        stamp = seen(costmap, k, posts, x=-1.0 + 2.0 * k * PERIOD_NS / NS_PER_S)
        assert not len(costmap.dynamic_obstacles.discs(stamp)), k


def test_out_of_sight_it_goes_on_for_a_while_and_is_forgotten():
    costmap = made()
    for k in range(20):
        stamp = seen(costmap, k, [(2.0, -0.5 + 1.0 * k * PERIOD_NS / NS_PER_S, 0.4)])
    assert len(costmap.dynamic_obstacles.discs(stamp)) == 1
    memory = round(costmap.config.dynamic_obstacles.memory * NS_PER_S / PERIOD_NS)
    for k in range(20, 20 + memory - 1):
        stamp = seen(costmap, k, [])
        assert len(costmap.dynamic_obstacles.discs(stamp)) == 1
    for k in range(20 + memory, 22 + memory):
        stamp = seen(costmap, k, [])
    assert not len(costmap.dynamic_obstacles.discs(stamp))


def followed(comes: bool) -> tuple[float, float]:
    """Command (m/s, rad/s) for a standing robot whose plan leads backwards. comes: an obstacle approaches it."""
    robot = load_robot("jackal").robot
    limits, footprint = limits_of(robot.drive, 10.0, 0.15), footprint_of(robot, 0.03)
    costmap = made()
    costmap.refresh(10 * NS_PER_S, Pose2(), footprint)
    costmap.moving_discs = np.array([[0.0, -1.6, 0.0, 1.0, 0.5, 0.0]]) if comes else costmap.dynamic_obstacles.discs(0)
    controller, zones = Mppi(MppiConfig(), limits), LocalZones(robot)
    follower = PathFollower(PathFollowingConfig(), CostToGoConfig(), controller, limits, footprint, zones)
    xs = np.linspace(0.0, -3.0, 31)
    goal = Goal(0, 1, True, Pose2(-3.0, 0.0, pi), 0.2, 0.2, False)
    outcome = follower.follow(LocalPlan(xs, 0 * xs, pi), goal, costmap, Motion(Pose2(), 0.0, 0.0), Pose2(), 1, 0)
    return outcome.v, outcome.w


def test_it_is_no_time_to_turn_on_the_spot_when_something_comes():
    v, w = followed(comes=False)
    assert v == 0
    assert w != 0
    v, _ = followed(comes=True)
    assert v > 0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_solution_keeps_off_where_what_moves_will_be(side):
    robot = load_robot("jackal").robot
    limits, footprint = limits_of(robot.drive, 10.0, 0.15), footprint_of(robot, 0.03)
    n = 240
    field = np.full((n, n), 20.0, np.float32)
    row, column = np.indices((n // 2, n // 2))
    to_go = np.hypot(0.1 * column + 0.025 - 9.0, 0.1 * row + 0.025 - 6.0).astype(np.float32)
    # it comes from the side and would meet the robot 1 s from now, 1.5 m ahead
    mover = np.array([[4.5, 6.0 - side * 1.2, 0.0, side * 1.2, 0.5, 0.0]])
    path = np.array([[3.0, 6.0], [9.0, 6.0]])
    scene = ControlScene(
        field, np.zeros((n, n), bool), 0.05, to_go, 9.0, 6.0, True, 3.0, 6.0, 0.0, 1.5, 0.0, path, mover
    )
    solution = Mppi(MppiConfig(), limits).solve(scene, footprint, 1)
    assert not solution.collides
    x, y, yaw, least, least_before = 3.0, 6.0, 0.0, np.inf, np.inf
    for t, (v, w) in enumerate(solution.velocities, start=1):
        yaw += 0.05 * w
        x, y = x + 0.05 * v * cos(yaw), y + 0.05 * v * sin(yaw)
        there = mover[0, :2] + 0.05 * t * mover[0, 2:4]
        least = min(least, float(np.hypot(x - there[0], y - there[1])) - 0.5)
        stopping = v * v / (2 * limits.braking)
        before = x + stopping * cos(yaw), y + stopping * sin(yaw)
        least_before = min(least_before, float(np.hypot(*(there - before))) - 0.5)
    assert least > footprint.circumscribed
    assert least_before > footprint.inscribed  # or the guard brakes, and leaves it standing in the way
    straight = Mppi(MppiConfig(), limits).solve(scene._replace(dynamic_obstacles=np.zeros((0, 6))), footprint, 1)
    assert straight.velocities[:20, 0].min() > 1.2  # without it, the robot would just have driven on


@pytest.mark.parametrize(("outside", "left"), [(False, [5.0]), (True, [1.0])])
def test_obstacles_in_a_square_are_cleared_or_all_others(outside, left):
    trackers = TrackersByLaser(DynamicObstaclesConfig(enabled=True))
    tracker = trackers.by_key["scan"]
    for x in (1.0, 5.0):
        obstacle = DynamicObstacle()
        obstacle.seen.append((5, x, 0.0))
        tracker.all.append(obstacle)
    trackers.clear_square(0.0, 0.0, 4.0, outside)
    assert [obstacle.seen[-1][1] for obstacle in tracker.all] == left
