# SPDX-License-Identifier: Apache-2.0
"""The planner's costs for a client that watches: obstacles, zones and unknown space, and no other plan by it."""

from dataclasses import replace

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.costmap_topic import MAX_CELLS, costmap_message
from services.planner.service import PlannerConfig, PlannerService
from shared import sample_messages as sample
from shared.config import load_robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid, update_of_cells
from shared.messages import Costmap, Message, Zone, ZoneKind, Zones
from shared.requests import Watch
from shared.service import Out
from shared.topics import Publication

ROBOT = load_robot("x80sv").robot
SIDE, WALL = 128, 60  # cells; column of a wall
PERIOD_NS = 500_000_000


def cells_with_a_wall() -> np.ndarray:
    """Free space with a wall, open at its upper end, and unknown space at the left."""
    cells = np.zeros((SIDE, SIDE), np.int8)
    cells[: SIDE - 40, WALL] = 100
    cells[:, :10] = -1
    return cells


def costmap_of(cells: np.ndarray, **config: object) -> GlobalCostmap:
    grid = OccupancyGrid()
    grid.apply(update_of_cells(cells, 0.05, 0.0, 0.0))
    costmap = GlobalCostmap(CostConfig(**config), ROBOT, 0.05)
    costmap.update(grid, None)
    return costmap


def sent(out: Out) -> list[Message]:
    return [item.message for item in out if isinstance(item, Publication)]


class Planner:
    """A planner with a map and a pose, and what it publishes at its ticks."""

    def __init__(self, is_watched: bool) -> None:
        self.service, self.is_watched = PlannerService(PlannerConfig(), ROBOT), is_watched
        self.plans: list[Message] = []
        self.costmaps: list[Costmap] = []
        update = replace(update_of_cells(cells_with_a_wall(), 0.05, 0.0, 0.0), map_id=1)
        self.take(self.service.map(update))
        self.take(self.service.pose(sample.pose_estimate(0, Pose2(1.0, 1.0, 0.0))))
        if is_watched:
            self.watch(60.0)

    def watch(self, seconds: float) -> None:
        list(self.service.watch_costmap(Watch(self.service.now, seconds)))

    def take(self, out: Out) -> None:
        for message in sent(out):
            (self.costmaps if isinstance(message, Costmap) else self.plans).append(message)

    def run(self, n_ticks: int) -> None:
        for _ in range(n_ticks):
            self.service.now += PERIOD_NS
            self.take(self.service.pose(sample.pose_estimate(self.service.now, Pose2(1.0, 1.0, 0.0))))
            self.take(self.service.confirm())


def test_obstacles_are_100_cells_too_near_to_them_99_far_ones_0_and_unknown_ones_minus_1():
    message = costmap_message(costmap_of(cells_with_a_wall()), 7)
    row = message.cells[20]
    assert (message.stamp, message.x, message.y, message.resolution) == (7, 0.0, 0.0, 0.05)
    assert (row[WALL], row[WALL + 1], row[5], row[-1]) == (100, 99, -1, 0)
    slope = row[WALL : WALL + 25].astype(int)
    assert (np.diff(slope) <= 0).all()
    assert ((slope > 0) & (slope < 99)).any()


def test_unknown_space_beside_an_obstacle_is_too_near_whatever_the_policy():
    cells = cells_with_a_wall()
    cells[20, 5] = 100
    for policy in ("allowed", "costly", "forbidden"):
        shown = costmap_message(costmap_of(cells, unknown=policy), 0).cells
        assert (shown[20, 5], shown[20, 6], shown[80, 5]) == (100, 99, -1)


def test_space_beyond_the_map_is_no_part_of_it():
    message = costmap_message(costmap_of(cells_with_a_wall(), beyond_map=2.0), 0)
    assert (message.x, message.y, message.cells.shape) == (0.0, 0.0, (SIDE, SIDE))


def test_a_large_map_has_larger_cells_with_the_highest_cost_in_each():
    side = 1088  # cells, 17 tiles
    cells = np.zeros((side, side), np.int8)
    cells[501, 701] = 100
    cells[1:500] = -1
    message = costmap_message(costmap_of(cells), 0)
    assert message.cells.size <= MAX_CELLS
    assert (message.cells.shape, message.resolution) == ((544, 544), 0.1)
    assert (message.cells[250, 350], message.cells[9, 9], message.cells[-1, -1]) == (100, -1, 0)
    assert message.problem() is None


def test_it_is_published_without_a_goal_while_a_client_watches_every_2_s():
    planner = Planner(is_watched=False)
    planner.run(4)
    assert planner.costmaps == []
    planner.watch(3.0)
    planner.run(20)
    assert len(planner.costmaps) == 2
    assert planner.costmaps[0].cells[20, WALL] == 100


def test_a_keep_out_zone_is_an_obstacle():
    planner = Planner(is_watched=True)
    xs, ys = np.array([4.0, 5.0, 5.0, 4.0]), np.array([4.0, 4.0, 5.0, 5.0])
    planner.take(planner.service.zones(Zones(0, (Zone(0, "shelf", ZoneKind.KEEP_OUT, xs, ys),))))
    planner.run(1)
    assert planner.costmaps[0].cells[90, 90] == 100
    assert cells_with_a_wall()[90, 90] == 0


def test_a_client_that_watches_changes_no_plan():
    planners = [Planner(is_watched) for is_watched in (False, True)]
    for planner in planners:
        planner.run(3)
        planner.take(planner.service.new_goal(sample.goal(planner.service.now, 1, Pose2(5.0, 1.0))))
        planner.service.now += PERIOD_NS // 2
        cells = cells_with_a_wall()
        cells[70:75, 70:75] = 100
        planner.take(planner.service.map(replace(update_of_cells(cells, 0.05, 0.0, 0.0), map_id=1, version=2)))
        planner.run(5)
    assert planners[0].plans
    assert planners[0].costmaps == []
    assert len(planners[1].costmaps) > 1
    assert list(map(repr, planners[0].plans)) == list(map(repr, planners[1].plans))
