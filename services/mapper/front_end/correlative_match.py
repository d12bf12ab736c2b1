# SPDX-License-Identifier: Apache-2.0
"""Correlative scan matching: scores of all poses of a window, for a scan whose registration failed.

Olson, "Real-time correlative scan matching", ICRA 2009, section IV, at one resolution: the window is small.
"""

from math import ceil, cos, floor, isnan, pi, sin

import numpy as np
from numba import njit
from pydantic import Field

from services.mapper.front_end.point_map import PointMap, nearest
from shared.config import Section
from shared.geometry import Pose2
from shared.types import Float64s


class SearchConfig(Section):
    """The search around the prior where few beams agree with the map."""

    below: float = Field(0.85, ge=0, le=1, description="quality under which the search starts; 0: never")
    reach: float = Field(0.5, ge=0.05, le=5, description="m, half width of the window")
    turn: float = Field(0.35, ge=0.01, le=pi, description="rad, half range of headings")
    step: float = Field(0.1, ge=0.02, le=0.5, description="m between poses")
    turn_step: float = Field(0.035, ge=0.005, le=0.2, description="rad between headings")
    gain: float = Field(
        0.05, ge=0, le=1, description="share of the beams by which another pose must be better to replace the first"
    )


def candidate_poses(points: Float64s, map_: PointMap, centre: Pose2, config: SearchConfig, n: int = 3) -> list[Pose2]:
    """At most n poses of the window about `centre`, best first, no two of them neighbours.

    points: (k, 2) m in `base`.  The poses are in the frame of the map, as `centre`.
    """
    k, t = ceil(config.reach / config.step), ceil(config.turn / config.turn_step)
    scores = window_scores(points, (centre.x, centre.y, centre.yaw), k, t, config.step, config.turn_step, *map_.index)
    best = []
    for _ in range(n):
        i, j, h = (int(v) for v in np.unravel_index(int(np.argmax(scores)), scores.shape))
        if scores[i, j, h] <= 0:
            break
        best.append(
            Pose2(
                centre.x + (i - k) * config.step,
                centre.y + (j - k) * config.step,
                centre.yaw + (h - t) * config.turn_step,
            )
        )
        scores[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3, max(h - 3, 0) : h + 4] = 0
    return best


@njit(cache=True, nogil=True)
def window_scores(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    source, centre, n_steps, n_turns, step, turn_step, points, following, keys, heads
):
    """(2 n_steps + 1, 2 n_steps + 1, 2 n_turns + 1) float64: scores by x, y and yaw, 0..1.

    source: (m, 2) m in `base`.  centre: x, y m and yaw rad.  step: m, turn_step: rad between two poses.
    A score is the mean over the points of 1 at a point of the map, falling to 0 at a distance of 2 steps.
    """
    m = len(source)
    far = 0.0
    for k in range(m):
        far = max(far, np.hypot(source[k, 0], source[k, 1]))
    half = ceil((far + (n_steps + 2) * step) / step)
    side = 2 * half + 1
    # nan: not computed yet, so that only the cells under the scan are computed
    scores_of_cells = np.full((side, side), np.nan)
    scores = np.zeros((2 * n_steps + 1, 2 * n_steps + 1, 2 * n_turns + 1))
    if m == 0:
        return scores
    for h in range(2 * n_turns + 1):
        yaw = centre[2] + (h - n_turns) * turn_step
        c, s = cos(yaw), sin(yaw)
        for k in range(m):
            px = floor((c * source[k, 0] - s * source[k, 1]) / step + 0.5) + half
            py = floor((s * source[k, 0] + c * source[k, 1]) / step + 0.5) + half
            for i in range(-n_steps, n_steps + 1):
                for j in range(-n_steps, n_steps + 1):
                    value = scores_of_cells[px + i, py + j]
                    if isnan(value):
                        x = centre[0] + (px + i - half) * step
                        y = centre[1] + (py + j - half) * step
                        nearest_point, d = nearest(x, y, 0.0, 0.0, 2 * step, points, following, keys, heads)
                        value = max(1.0 - np.sqrt(d) / (2 * step), 0.0) if nearest_point >= 0 else 0.0
                        scores_of_cells[px + i, py + j] = value
                    scores[i + n_steps, j + n_steps, h] += value
    return scores / m
