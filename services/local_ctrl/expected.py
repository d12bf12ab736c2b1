# SPDX-License-Identifier: Apache-2.0
"""Where will what moves be? On an arc at first; how it turns is the less known the later."""

import numpy as np

from services.local_ctrl.footprint import Float64s
from services.local_ctrl.rollout import DT

LASTS = 1.5  # s in which a turn rate falls to its e-th part


def expected(movers: Float64s, steps: int) -> Float64s:
    """(steps, k, 3) x, y m, radius m of movers (k, 6), see Movers.discs, after 1, 2, ... steps of DT."""
    after = DT * np.arange(1, steps + 1)[:, None]
    turned = movers[:, 5] * LASTS * (1.0 - np.exp(-(after - 0.5 * DT) / LASTS))
    heading = np.arctan2(movers[:, 3], movers[:, 2]) + turned
    speed = np.hypot(movers[:, 2], movers[:, 3])
    ways = np.empty((steps, len(movers), 3))
    ways[:, :, 0] = movers[:, 0] + np.cumsum(DT * speed * np.cos(heading), axis=0)
    ways[:, :, 1] = movers[:, 1] + np.cumsum(DT * speed * np.sin(heading), axis=0)
    ways[:, :, 2] = movers[:, 4]
    return ways
