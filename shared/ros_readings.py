# SPDX-License-Identifier: Apache-2.0
"""ROS's LaserScan, covariances, stamps and transforms as the stack's. Layouts are those of the `rosbags` package."""

from math import isfinite, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.messages import LaserScan
from shared.types import Float64s

MAX_RANGE_M = 250.0  # of a range in a LaserScan of the stack
MAX_BEAMS = 20_000
MAX_SWEEP_S = 2.0
MAX_TURNS = 10  # of the first beam's angle
PLANE = np.add.outer(np.array((0, 1, 5)) * 6, (0, 1, 5)).ravel()  # x, y, yaw of the six by six that ROS has


def laser_scan(message: Any, stamp: int, mirrored: bool) -> LaserScan:
    """A sweep in the plane. mirrored: the laser hangs upside-down, so its beams run the other way round.

    No echo is NaN: what is not finite, not over 0, or over range_max (REP 117). Where beams were taken from the last to
    the first (a negative time_increment) they are turned about, so that the stamp is the first beam's.
    """
    ranges = _ranges(message)
    increment, first, step = float(message.angle_increment), float(message.angle_min), float(message.time_increment)
    n = len(ranges)
    if not 2 <= n <= MAX_BEAMS or not isfinite(increment) or not abs(first) <= 2 * pi * MAX_TURNS:
        raise ValueError("a scan without beams, or without angles")
    low, high = float(message.range_min), float(message.range_max)
    largest = float(np.nanmax(ranges, initial=0.0))
    if not 0 < high <= MAX_RANGE_M:  # some drivers leave it 0, or say infinity
        high = min(max(largest, 1.0), MAX_RANGE_M)
    if not 0 <= low < high:
        low = 0.0
    ranges = np.where(ranges <= np.float32(high), ranges, np.nan).astype(np.float32)
    intensities = _intensities(message, n)
    scan_time = step * (n - 1)
    if not abs(scan_time) <= MAX_SWEEP_S:
        step = scan_time = 0.0
    if step < 0:
        ranges, intensities = ranges[::-1].copy(), intensities[::-1].copy()
        first, increment = first + increment * (n - 1), -increment
        stamp, scan_time = stamp + round(scan_time * 1e9), -scan_time
    if mirrored:
        first, increment = -first, -increment
    turns = round(first / (2 * pi))
    scan = LaserScan(
        stamp=max(stamp, 0),
        angle_min=first - 2 * pi * turns,
        angle_increment=increment,
        scan_time=scan_time,
        range_min=low,
        range_max=high,
        ranges=ranges,
        intensities=intensities,
    )
    if not abs(increment) <= pi or increment == 0 or (problem := scan.problem()):
        raise ValueError("the angles are none" if increment == 0 or abs(increment) > pi else problem)
    return scan


def _ranges(message: Any) -> NDArray[np.float32]:
    """(n,) m; of several echoes of a beam the first."""
    if hasattr(message, "intensities") and len(message.ranges) and hasattr(message.ranges[0], "echoes"):
        values = np.array([beam.echoes[0] if len(beam.echoes) else np.nan for beam in message.ranges], np.float32)
    else:
        values = np.asarray(message.ranges, np.float32)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(values) & (values > 0), values, np.float32(np.nan))


def _intensities(message: Any, n: int) -> NDArray[np.float32]:
    """(n,) or (0,): the device's own scale, as far as it is one."""
    values = message.intensities
    if len(values) != n or hasattr(values[0], "echoes"):
        return np.empty(0, np.float32)
    return np.clip(np.nan_to_num(np.asarray(values, np.float32)), 0, 65535)


def covariance(of_six: Any) -> Float64s:
    """(9,) of x, y, yaw out of ROS's 36; zeros where they are no numbers."""
    values = np.asarray(of_six, np.float64)[PLANE]
    return values if np.isfinite(values).all() and np.abs(values).max() <= 1e12 else np.zeros(9)


def stamp_of(header: Any) -> int:
    """ns; 0 where the publisher set none."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def frame_name(name: str) -> str:
    """A frame's name as tf2 has it: tf allowed a leading slash."""
    return str(name).strip("/")


def transform_row(message: Any) -> Float64s:
    """(7,) x y z and the quaternion x y z w of a geometry_msgs/Transform."""
    t, q = message.translation, message.rotation
    return np.array((t.x, t.y, t.z, q.x, q.y, q.z, q.w), np.float64)
