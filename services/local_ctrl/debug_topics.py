# SPDX-License-Identifier: Apache-2.0
"""The debug topics: local costmap, rollouts and moving obstacles, published only while a client watches."""

import numpy as np
from numpy.typing import NDArray

from services.local_ctrl.controller import Controller
from services.local_ctrl.footprint import Footprint
from services.local_ctrl.local_costmap import LocalCostmap
from services.local_ctrl.path_following import PathFollower
from services.local_ctrl.rollout import DT, Motion
from shared import topics
from shared.messages import Costmap, MovingObstacles, Rollouts
from shared.service import Out
from shared.types import Float32s, Float64s
from shared.watched_topic import WatchedTopic

PERIOD_NS = 200_000_000  # between two messages
MAX_SHOWN = 24  # of some hundred rollouts
COST_FADE_M = 0.5  # beyond the inscribed radius, over which a cell's cost falls to 0
OCCUPIED, TOUCHING, UNKNOWN = 100, 99, -1


class DebugTopics(WatchedTopic):
    """When the topics are due, and which rollouts were published last."""

    def __init__(self) -> None:
        super().__init__(PERIOD_NS)
        self._n_solved = 0

    def publications(self, now: int, costmap: LocalCostmap, path_follower: PathFollower, start: Motion) -> Out:
        """The debug topics; the rollouts only if there are new ones, moving obstacles only where they are tracked."""
        yield topics.COSTMAP(self.costmap(now, costmap, path_follower.footprint))
        if costmap.config.dynamic_obstacles.enabled:
            yield topics.MOVING(moving_obstacles(now, costmap.dynamic_obstacles.discs(now)))
        rollouts = self.rollouts(now, path_follower.controller, start)
        if rollouts is not None:
            yield topics.ROLLOUTS(rollouts)

    def costmap(self, now: int, costmap: LocalCostmap, footprint: Footprint) -> Costmap:
        """The local costmap, with each cell's cost by its distance to the nearest obstacle."""
        off = (costmap.field - footprint.inscribed) / COST_FADE_M
        cells = np.where(off <= 0, TOUCHING, np.maximum(0.0, TOUCHING * (1 - off))).astype(np.int8)
        cells[costmap.occupied] = OCCUPIED
        cells[costmap.unknown & ~costmap.occupied] = UNKNOWN
        half = 0.5 * costmap.resolution  # its x0, y0 are the centre of the first cell
        return Costmap(now, costmap.x0 - half, costmap.y0 - half, costmap.resolution, cells)

    def rollouts(self, now: int, controller: Controller, start: Motion) -> Rollouts | None:
        """The rollouts since the last call, from `start` in `odom`; None without any."""
        if controller.n_solved in (0, self._n_solved):
            return None
        self._n_solved = controller.n_solved
        velocities, costs = controller.evaluated_rollouts()
        chosen = np.append(0, np.linspace(1, len(costs) - 1, min(MAX_SHOWN, len(costs) - 1)).astype(int))
        xs, ys = _polylines(velocities[chosen], start)
        return Rollouts(now, xs, ys, np.clip(costs[chosen], 0, 1e12).astype(np.float32))


def moving_obstacles(now: int, discs: Float64s) -> MovingObstacles:
    """discs: (k, 6), see DynamicObstacles.discs.  now: ns."""
    xs, ys, vxs, vys, radii = (np.ascontiguousarray(column, np.float32) for column in discs.T[:5])
    return MovingObstacles(stamp=now, xs=xs, ys=ys, vxs=vxs, vys=vys, radii=radii)


def _polylines(velocities: NDArray[np.floating], start: Motion) -> tuple[Float32s, Float32s]:
    """(k, n + 1) x and y, m in `odom`, of velocities (k, n, 2) m/s, rad/s: chords of arcs, DT each."""
    v, w = velocities[:, :, 0], velocities[:, :, 1]
    half = 0.5 * w * DT
    headings = start.pose.yaw + np.cumsum(w * DT, axis=1) - half
    chords = v * DT * np.sinc(half / np.pi)
    ends = [np.cumsum(chords * trig(headings), axis=1) for trig in (np.cos, np.sin)]
    xs, ys = (np.pad(end, ((0, 0), (1, 0))) for end in ends)
    return (start.pose.x + xs).astype(np.float32), (start.pose.y + ys).astype(np.float32)
