# SPDX-License-Identifier: Apache-2.0
"""Beams that end on another robot are no part of the map, and match nothing: they are taken out of the scan.

A person is found by the motion that the scans show. Robots that stand side by side at their start show none. The rule
is our own.
"""

from dataclasses import replace

import numpy as np

from shared.geometry import Pose2
from shared.messages import LaserScan, OtherRobots
from shared.robot import Mount
from shared.types import NS_PER_S

MAX_AGE_NS = NS_PER_S
"""ns after which the places of the robots are too old."""
MARGIN_M = 0.2  # around a robot: its pose, its motion, and this robot's pose


class RobotMask:
    """The newest places of the other robots."""

    def __init__(self) -> None:
        self.others: OtherRobots | None = None

    def masked(self, scan: LaserScan, mount: Mount, map_from_base: Pose2, now: int) -> LaserScan:
        """The scan without the beams that end on a robot: they have range 0, which is no measurement. now: ns."""
        others = self.others
        if others is None or not len(others.names) or abs(now - others.stamp) > MAX_AGE_NS:
            return scan
        beams = mount.yaw + scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        ends = map_from_base @ np.column_stack(
            (mount.x + scan.ranges * np.cos(beams), mount.y + scan.ranges * np.sin(beams))
        )
        step = int((now - others.stamp) / NS_PER_S / others.period)
        step = min(max(step, 0), others.xs.shape[1] - 1)
        hidden = np.zeros(len(beams), bool)
        for x, y, radius in zip(others.xs[:, step], others.ys[:, step], others.radii, strict=True):
            hidden |= np.hypot(ends[:, 0] - x, ends[:, 1] - y) < radius + MARGIN_M
        return replace(scan, ranges=np.where(hidden, np.float32(0.0), scan.ranges)) if hidden.any() else scan
