# SPDX-License-Identifier: Apache-2.0
"""The driver of the simulated robot in benchmarks of the mapper alone. It knows the true world and the true pose.

The planner plans its paths on the true map. Its speeds are those of local control. The simulator gives wheels,
encoders, odometry and laser. So the mapper's inputs are like those of a drive of the whole stack, at a tenth of the
cost.
"""

from math import atan2, copysign, hypot, sin

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.planning import PlanningConfig, plan_path
from services.sim.world import World
from shared.config import Robot, UserError
from shared.distance_field import distance_field
from shared.geometry import Pose2, wrapped
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS, Truth
from shared.types import Float64s

CELL = 0.05  # m
ARRIVED = 0.15  # m from the end of a way
GOAL_TOLERANCE = 0.3  # m that a way may end from its goal
MAX_GOAL_DISTANCE = GOAL_TOLERANCE + 2 * ARRIVED  # m from the goal that count as reached
LOOK = 0.45  # m: how far down the way it heads for
TURN_FROM, TURN_UNTIL = 0.9, 0.25  # rad off the way at which a robot turns on the spot
TURN_RATE = 1.5  # rad/s at most, on the spot
FULL_SPEED_CLEARANCE_M, MIN_SPEED_SHARE = 0.3, 0.25  # full speed from this clearance; share of it at no clearance
ACROSS, BRAKING = 2.0, 0.5  # m/s^2 at most in a bend: v^2 times the curvature; before the end of a way
CREEP = 0.1  # m/s, from a stand and at the end
AHEAD = 0.9  # m of the way that must be free of people
PERSON = 0.25  # m, a person's radius
PATIENCE, ENOUGH = 2.5, 25.0  # s that it stands before people until it drives around them; until it gives up


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
        """A pose at which the robot can turn and from which it can drive."""
        while True:
            row, column = self._cells[int(rng.integers(len(self._cells)))].tolist()
            x, y = self.terrain.centre(row, column)
            if self.clear_at(x, y) > 0.1:
                return Pose2(x, y, float(rng.uniform(-np.pi, np.pi)))

    def clear_at(self, x: float, y: float) -> float:
        """m between the robot's outline and what stands still."""
        row, column = self.grid.cell(x, y)
        return float(self.clearance[row, column]) if self.grid.holds(row, column) else 0.0


class GroundTruthDriver:
    """Follows one way after the other: pure pursuit (Coulter 1992) by the true pose; stops for people."""

    def __init__(self, paths: PathFinder) -> None:
        self.paths, self.drive = paths, paths.robot.drive
        self.goal = Pose2()
        self.waited = self.barred = 0.0  # s that it stands before people now; that it stood before, on this way
        self._follow(np.zeros((0, 2)))

    def go(self, goal: Pose2, truth: Truth) -> bool:
        """Drives there from now on; says whether there is a way."""
        self.goal = goal
        self.waited = self.barred = 0.0
        self._follow(self.paths.path(truth.world_from_base, goal))
        return len(self.points) > 0

    def _follow(self, path: Float64s) -> None:
        self.points, self.at = path, 0
        self.turning = False

    def command(self, truth: Truth, seconds: float) -> tuple[float, float] | None:
        """v m/s and w rad/s for the next `seconds`; None where the way has ended, or people bar it for too long."""
        pose = truth.world_from_base
        if self.waited > PATIENCE:
            self.barred, self.waited = self.barred + self.waited, 0.0
            around = self.paths.path(pose, self.goal, np.column_stack((truth.people_x, truth.people_y)))
            if len(around):
                self._follow(around)
        if not len(self.points) or self.barred > ENOUGH:
            return None
        ahead = self.points[self.at : self.at + 60]
        self.at += int(np.argmin(np.hypot(ahead[:, 0] - pose.x, ahead[:, 1] - pose.y)))
        left = hypot(*(self.points[-1] - (pose.x, pose.y)))
        if left < ARRIVED or (self.at >= len(self.points) - 2 and left < 2 * ARRIVED):
            return None
        carrot = self.points[min(self.at + round(LOOK / CELL), len(self.points) - 1)]
        off = wrapped(atan2(carrot[1] - pose.y, carrot[0] - pose.x) - pose.yaw)
        if abs(off) > TURN_FROM or (self.turning and abs(off) > TURN_UNTIL):
            self.turning = True
            return 0.0, copysign(min(TURN_RATE, 0.3 + 2.0 * abs(off)), off)
        self.turning = False
        if self._is_person_ahead(truth):
            self.waited += seconds
            return 0.0, 0.0
        self.waited = 0.0
        curvature = 2 * sin(off) / max(hypot(carrot[0] - pose.x, carrot[1] - pose.y), 0.2)
        room = min(self.paths.clear_at(pose.x, pose.y), self.paths.clear_at(*carrot.tolist()))
        v = self.drive.max_speed * min(max(room / FULL_SPEED_CLEARANCE_M, MIN_SPEED_SHARE), 1.0)
        v = min(v, (ACROSS / max(abs(curvature), 1e-3)) ** 0.5, (CREEP + 2 * BRAKING * left) ** 0.5)
        v = min(v, max(truth.v, CREEP) + self.drive.max_acceleration * seconds * 1.5)  # more, as the motors lag
        return self.drive.clamped(v, curvature * v)

    def _is_person_ahead(self, truth: Truth) -> bool:
        ahead = self.points[self.at : self.at + round(AHEAD / CELL) : 2]
        distances = np.hypot(ahead[:, :1] - truth.people_x, ahead[:, 1:] - truth.people_y)
        return bool((distances < PERSON + self.paths.robot.inscribed_radius + 0.05).any())


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
