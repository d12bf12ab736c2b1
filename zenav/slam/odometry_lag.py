# SPDX-License-Identifier: Apache-2.0
"""How late is odometry against the laser? Causes are a driver's buffer, or two clocks."""

import numpy as np

from shared.types import Float64s

MAX_LAG_S = 1.0  # to either side
STEP = 0.01  # s
MIN_TURN_RAD = 3.0  # sum of all turns: a drive with less does not determine the lag


def odometry_lag(odometry: Float64s, placed: Float64s) -> float | None:
    """s by which odometry's stamps are late against the poses of scans; negative: they are early. None: too few turns.

    odometry: (n, 2) stamp (s) and yaw (rad); placed: (m, 2) the same of the placed scans; both rise in time.
    The lag is the shift at which the turns of both between scans agree best. Scan matching measures turns best.
    """
    if len(odometry) < 10 or len(placed) < 10:
        return None
    (stamps, yaw), (at, seen) = ((table[:, 0], np.unwrap(table[:, 1])) for table in (odometry, placed))
    inside = (at > stamps[0] + MAX_LAG_S) & (at < stamps[-1] - MAX_LAG_S)
    at, turns = at[inside], np.diff(seen[inside])
    if len(at) < 10 or np.abs(turns).sum() < MIN_TURN_RAD:
        return None
    lags = np.arange(-MAX_LAG_S, MAX_LAG_S + STEP / 2, STEP)
    # robust: a wheel that slips must not outweigh all the rest
    misfits = [float(np.abs(np.diff(np.interp(at + lag, stamps, yaw)) - turns).sum()) for lag in lags]
    best = int(np.argmin(misfits))
    if best in (0, len(lags) - 1):
        return None
    return round(float(lags[best]), 2)
