# SPDX-License-Identifier: Apache-2.0
"""Where another robot will be: on its published path, at its present speed, and no farther than it holds."""

import numpy as np

from services.traffic.neighbours import Neighbour
from shared.types import NS_PER_S, Float64s

PERIOD_S = 0.25  # between two predicted places
N_STEPS = 17  # 4 s
REJOINS_M = 1.0  # of path on which a robot beside its path comes back to it
STARTS_MPS = 0.1  # least speed of a robot that holds a way ahead
NO_PATH_S = 1.0  # that a robot without a path goes on as it moves


def predicted_places(neighbour: Neighbour, now: int) -> Float64s:
    """(N_STEPS, 2) m in `map`: places of a robot at `now` (ns) and each PERIOD_S after it."""
    intent, robot = neighbour.intent, neighbour.robot
    late = max(now - intent.stamp - neighbour.delay, 0) / NS_PER_S
    after = late + PERIOD_S * np.arange(N_STEPS)
    here = robot.place[0]
    held = robot.path[: robot.held]
    if len(held) < 2:
        heading = np.array([np.cos(intent.map_from_base.yaw), np.sin(intent.map_from_base.yaw)])
        return np.asarray(here + intent.v * np.minimum(after, NO_PATH_S)[:, None] * heading)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(held, axis=0).T))))
    driven = np.minimum(max(abs(intent.v), STARTS_MPS) * after, along[-1])
    places = np.column_stack((np.interp(driven, along, held[:, 0]), np.interp(driven, along, held[:, 1])))
    beside = np.maximum(1.0 - driven / REJOINS_M, 0.0)[:, None] * (here - held[0])
    return np.asarray(places + beside)
