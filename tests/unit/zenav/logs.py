# SPDX-License-Identifier: Apache-2.0
"""Logs that tests make up."""

from itertools import pairwise
from math import ceil, floor, hypot, pi

import numpy as np

from shared.geometry import Pose2, interpolated
from tests.unit.services.mapper.rooms import CORNERS, RING, ROOM, START, cast


def room_log(n=40, mount=Pose2(0.2, 0.0, 0.0), first=100.0):  # noqa: B008  # a pose is a value
    """A CARMEN log of a robot that circles in a made-up room; its odometry's wheels are 3 % too small."""
    angles = np.radians(np.arange(-90, 90))
    true, odom = Pose2(), Pose2()
    for k in range(n):
        step = Pose2(0.06, 0, 0.1)
        true, odom = true @ step, odom @ Pose2(0.062, 0, 0.1)
        stamp = first + 0.2 * k
        laser, seen = true @ mount, odom @ mount
        ranges = cast(ROOM, np.tile((laser.x, laser.y), (180, 1)), laser.yaw + angles)
        ranges[ranges > 30] = 81.83
        yield f"ODOM {odom.x:.6f} {odom.y:.6f} {odom.yaw:.6f} 0 0 0 {stamp - 0.1:.6f} host 0"
        yield (
            "FLASER 180 " + " ".join(f"{r:.2f}" for r in ranges)
            + f" {seen.x:.6f} {seen.y:.6f} {seen.yaw:.6f} {odom.x:.6f} {odom.y:.6f} {odom.yaw:.6f} {stamp:.6f} host 0"
        )  # fmt: skip


def ring_poses(n_laps=3):
    """The true poses of a robot that drives round the ring in steps of 0.2 m, and turns on the spot at its corners."""
    poses = [START]
    for k in range(4 * n_laps):
        (x0, y0), (x1, y1) = CORNERS[k % 4], CORNERS[(k + 1) % 4]
        motions = [Pose2(0.2, 0, 0)] * round(hypot(x1 - x0, y1 - y0) / 0.2) + [Pose2(0, 0, pi / 26)] * 13
        for motion in motions:
            poses.append(poses[-1] @ motion)
    return poses


def ring_log(poses, late):
    """A CARMEN log of a drive round the ring, 5 scans a second. late: (n,) scans by which odometry is late at each."""
    angles, rng = np.radians(np.arange(-90, 91)), np.random.default_rng(1)
    odom = [Pose2()]
    for a, b in pairwise(poses):
        step = a.inverse() @ b
        odom.append(odom[-1] @ Pose2(1.01 * step.x, step.y, 1.01 * step.yaw + 0.001 * rng.normal()))
    for k, (pose, lag) in enumerate(zip(poses, late, strict=True)):
        ranges = cast(RING, np.tile((pose.x, pose.y), (181, 1)), pose.yaw + angles) + 0.01 * rng.normal(size=181)
        at = min(max(k - lag, 0.0), len(odom) - 1.0)
        seen = interpolated(odom[floor(at)], odom[ceil(at)], at - floor(at))
        pose_words = f"{seen.x:.6f} {seen.y:.6f} {seen.yaw:.6f}"
        yield f"FLASER 181 {' '.join(f'{r:.3f}' for r in ranges)} {pose_words} {pose_words} {100 + 0.2 * k:.6f} host 0"
