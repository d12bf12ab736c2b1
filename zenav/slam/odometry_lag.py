# SPDX-License-Identifier: Apache-2.0
"""How late is odometry against the laser? Causes are a driver's buffer, or two clocks.

A lag is found by the scans alone, as matches follow odometry where it is late. Only a large one that the whole drive
shows is corrected: the mapper itself covers a small one. The method is our own.
"""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from shared.geometry import Pose2, interpolated
from shared.types import NS_PER_S, Float64s
from zenav.convert.records import DriveLog, LoggedPose, LoggedScan
from zenav.slam.scan_turns import scan_turns

MAX_LAG_S = 1.0  # to either side
STEP = 0.01  # s
MIN_TURN_RAD = 3.0  # sum of all turns: a drive with less does not determine the lag
KERNEL_RAD = 0.05  # scale of a Geman-McClure kernel, for the turn between two scans
MIN_CLEAR_LAG_S = 0.25  # a smaller lag is within the errors that the mapper expects of odometry
PART_TURN_RAD, MIN_PARTS, MAX_PARTS = 4.0, 3, 8  # of a drive, by odometry's turns; each part shows the lag
MAX_SPREAD_S, MIN_AGREEING = 0.1, 0.75  # from the parts' lags to their median, and the share of such parts


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
    # robust: a wheel that slips must not outweigh all the rest. Squares: small errors between turns must not either
    squares = [(np.diff(np.interp(at + lag, stamps, yaw)) - turns) ** 2 for lag in lags]
    misfits = [float((square / (square + KERNEL_RAD**2)).sum()) for square in squares]
    best = int(np.argmin(misfits))
    if best in (0, len(lags) - 1):
        return None
    return round(float(lags[best]), 2)


def clear_lag(log: DriveLog) -> float:
    """s by which a log's odometry is late, by its scans; 0 where that is small, or not clear. Negative: it is early."""
    scans = sorted((record for record in log.records if isinstance(record, LoggedScan)), key=lambda scan: scan.stamp)
    if not log.has_odometry or len(scans) < 2:
        return 0.0
    odometry = headings(log)
    middles = [scan.stamp / NS_PER_S + scan.scan_time / 2 for scan in scans]  # of sweeps, which measure their mean turn
    placed = np.column_stack((middles, np.cumsum(scan_turns(scans))))
    lags = np.array([lag for lag in _lags_of_parts(odometry, placed) if lag is not None])
    if len(lags) < MIN_PARTS:
        return 0.0
    lag = float(np.median(lags))
    agrees = float(np.mean(np.abs(lags - lag) <= MAX_SPREAD_S)) >= MIN_AGREEING
    return lag if agrees and abs(lag) >= MIN_CLEAR_LAG_S else 0.0


def headings(log: DriveLog) -> Float64s:
    """(n, 2) s on the log's clock and rad, odometry's headings, in time."""
    rows = {record.stamp: record.odom_from_base.yaw for record in log.records}
    return np.array([(stamp / NS_PER_S, yaw) for stamp, yaw in sorted(rows.items())])


def _lags_of_parts(odometry: Float64s, placed: Float64s) -> Iterator[float | None]:
    """The lags of parts of a drive, in each of which odometry turns as much."""
    stamps, yaw = odometry[:, 0], np.unwrap(odometry[:, 1])
    turned = np.cumsum(np.abs(np.diff(np.interp(placed[:, 0], stamps, yaw), prepend=yaw[0])))
    n = min(int(turned[-1] / PART_TURN_RAD), MAX_PARTS)
    for part in np.array_split(placed, np.searchsorted(turned, turned[-1] * np.arange(1, n) / max(n, 1))):
        if len(part):
            near = (stamps > part[0, 0] - 2 * MAX_LAG_S) & (stamps < part[-1, 0] + 2 * MAX_LAG_S)
            yield odometry_lag(odometry[near], part)


def without_lag(log: DriveLog, lag: float) -> DriveLog:
    """A log with the odometry of each time, although that was logged `lag` s later."""
    late = round(lag * NS_PER_S)
    logged = sorted(((r.stamp, r.odom_from_base) for r in log.records), key=lambda pair: pair[0])
    stamps = [stamp for stamp, _ in logged]

    def at(stamp: int) -> Pose2:
        k = bisect_right(stamps, stamp)
        if k in (0, len(stamps)):
            return logged[max(k - 1, 0)][1]
        (before, a), (after, b) = logged[k - 1], logged[k]
        return interpolated(a, b, (stamp - before) / (after - before))

    records: list[LoggedPose | LoggedScan] = []
    for record in log.records:
        records.append(LoggedPose(record.stamp - late, record.odom_from_base, record.v, record.w))
        if isinstance(record, LoggedScan):
            records.append(replace(record, odom_from_base=at(record.stamp + late)))
    records.sort(key=lambda record: record.end if isinstance(record, LoggedScan) else record.stamp)
    return replace(log, records=records)
