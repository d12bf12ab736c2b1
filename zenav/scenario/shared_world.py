# SPDX-License-Identifier: Apache-2.0
"""One world for several simulated robots: where they start, and what each one's simulator shows of the others."""

from collections.abc import Mapping

import numpy as np

from services.sim.other_robots import discs_at, footprint_discs
from services.sim.world import World
from shared.config import Robot, UserError
from shared.geometry import Pose2
from shared.messages import RobotDiscs, Truth
from shared.types import Float64s

GRID_M = 0.1  # cells in which starts are looked for
START_ROOM_M = 0.3  # m around a robot that starts
START_GAP_M = 0.6  # m between two robots that start


def start_poses(world: World, n: int, radius: float) -> list[Pose2]:
    """Starts for n robots of `radius` m: the world's own one, then the nearest free places that it can reach.

    Raises UserError where the world has no room for so many.
    """
    free, x0, y0 = world.centres(GRID_M, radius + START_ROOM_M)
    rows, columns = np.nonzero(free)
    places = np.column_stack((x0 + (columns + 0.5) * GRID_M, y0 + (rows + 0.5) * GRID_M))
    first = np.array([world.start.x, world.start.y])
    chosen = [first]
    for place in places[np.argsort(np.hypot(*(places - first).T), kind="stable")]:
        if len(chosen) == n:
            break
        if min(np.hypot(*(np.array(chosen) - place).T)) >= 2 * radius + START_GAP_M:
            chosen.append(place)
    if len(chosen) < n:
        raise UserError(f"world {world.name} has room for {len(chosen)} robots at its start", "name fewer: --robots")
    return [Pose2(float(x), float(y), world.start.yaw) for x, y in chosen]


class SharedWorld:
    """The robots by name. `others` is what one's simulator is shown."""

    def __init__(self, robots: Mapping[str, Robot]) -> None:
        self._discs = {name: footprint_discs(robot.corners) for name, robot in robots.items()}
        self._placed: dict[str, Float64s] = {}

    def n_discs(self, name: str) -> int:
        """Discs of all robots but this one: `sim.other_discs` of its simulator."""
        return sum(len(discs) for other, discs in self._discs.items() if other != name)

    def move(self, name: str, truth: Truth) -> None:
        """A robot is there now."""
        self._placed[name] = discs_at(self._discs[name], truth.world_from_base)

    def others(self, name: str, stamp: int) -> RobotDiscs:
        """The discs of all robots but this one that have been heard of."""
        discs = [placed for other, placed in self._placed.items() if other != name]
        x, y, radius = np.concatenate(discs).astype(np.float32).T if discs else np.zeros((3, 0), np.float32)
        return RobotDiscs(stamp, x.copy(), y.copy(), radius.copy())
