# SPDX-License-Identifier: Apache-2.0
"""Paths and places on the true map of a simulated world, as the planner finds them."""

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.planning import PlanningConfig, plan_path
from services.sim.world import World
from shared.config import Robot, UserError
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS
from shared.types import Float64s

CELL = 0.05  # m
GOAL_TOLERANCE = 0.3  # m that a way may end from its goal
MAX_DRAWS = 10_000  # cells that are drawn for one pose
PERSON = 0.25  # m, a person's radius


class PathFinder:
    """Ways over a world's floor, in the world's frame, as the planner finds them on the true map."""

    def __init__(self, world: World, robot: Robot) -> None:
        grid = _true_map(world)
        self.terrain = GlobalCostmap(CostConfig(unknown="forbidden"), robot, CELL)
        self.terrain.update(grid, None)
        self.clearance = distance_field(grid.occupied, CELL) - robot.inscribed_radius
        self.grid, self.robot = grid, robot
        self._outline = HierarchicalSearch()
        regions = self.terrain.components.labels_in(0, 0, *self.terrain.costs.shape)
        region = regions[self.terrain.cell(world.start.x, world.start.y)]
        rows, columns = np.nonzero(regions == region)
        if not region:
            raise UserError(f"world {world.name}: the robot has no room at its start", "move `start:`")
        self._cells = np.column_stack((rows, columns))

    def path(self, start: Pose2, goal: Pose2, people: Float64s | None = None) -> Float64s:
        """(n, 2) m, points of a path from start to the goal, or as near as it gets; n = 0 without one.

        people: (p, 2) m, further obstacles.
        """
        terrain = self.terrain if people is None else self._costs_with(people)

        return plan_path(terrain, self._outline, start, goal, GOAL_TOLERANCE, PlanningConfig()).points

    def _costs_with(self, people: Float64s) -> GlobalCostmap:
        grid = OccupancyGrid(CELL, 1)
        grid.first_row, grid.first_column = self.grid.first_row, self.grid.first_column
        rows, columns = np.indices(self.grid.cells.shape)
        x, y = self.grid.x0 + (columns + 0.5) * CELL, self.grid.y0 + (rows + 0.5) * CELL
        occupied_by_people = np.zeros(x.shape, bool)
        for person in people:
            occupied_by_people |= np.hypot(x - person[0], y - person[1]) <= PERSON
        grid.cells = np.where(occupied_by_people, np.int8(100), self.grid.cells)
        terrain = GlobalCostmap(self.terrain.config, self.robot, CELL)
        terrain.update(grid, None)
        return terrain

    def random_pose(self, rng: np.random.Generator) -> Pose2:
        """A pose at which the robot can turn and from which it can drive. Raises UserError where none is found."""
        for _ in range(MAX_DRAWS):
            row, column = self._cells[int(rng.integers(len(self._cells)))].tolist()
            x, y = self.terrain.centre(row, column)
            if self.clear_at(x, y) > 0.1:
                return Pose2(x, y, float(rng.uniform(-np.pi, np.pi)))
        raise UserError("this world has no place at which the robot can turn", "take a wider one: --world office")

    def clear_at(self, x: float, y: float) -> float:
        """m between the robot's outline and what stands still."""
        row, column = self.grid.cell(x, y)
        return float(self.clearance[row, column]) if self.grid.holds(row, column) else 0.0


def _true_map(world: World) -> OccupancyGrid:
    """What stands still, as a map in the world's frame."""
    occupied, x0, y0 = world.occupied(CELL)
    grid = OccupancyGrid(CELL, 1)
    row0, column0 = round(y0 / CELL), round(x0 / CELL)
    grid.first_row, grid.first_column = row0 // TILE_CELLS, column0 // TILE_CELLS
    r, c = row0 - grid.first_row * TILE_CELLS, column0 - grid.first_column * TILE_CELLS
    h, w = (-(-(n + before) // TILE_CELLS) * TILE_CELLS for n, before in zip(occupied.shape, (r, c)))
    grid.cells = np.full((h, w), 100, np.int8)
    grid.cells[r : r + occupied.shape[0], c : c + occupied.shape[1]] = 100 * occupied
    return grid
