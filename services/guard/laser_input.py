# SPDX-License-Identifier: Apache-2.0
"""One laser as an input of the guard: its newest scan, the age of it, and whether it still measures.

That each laser is watched alone is our own rule.
"""

import numpy as np

from services.guard.laser_visibility import LaserVisibility, VisibilityConfig
from services.guard.obstacles import Obstacles, is_in_sweep
from shared.lasers import about_laser
from shared.messages import LaserScan
from shared.odometry_buffer import OdometryBuffer
from shared.robot import Laser, Robot
from shared.scan_faults import RepeatedScans
from shared.topics import Topic


class LaserInput:
    """The state of one laser. now: ns."""

    def __init__(self, topic: Topic[LaserScan], laser: Laser, config: VisibilityConfig, robot: Robot) -> None:
        self.topic, self.laser = topic, laser
        self.visibility = LaserVisibility(config, robot, laser)
        self.repeats = RepeatedScans(laser.mount)
        self.scan: LaserScan | None = None
        self.valid_from: int | None = None  # start of its age: its last beam, or the arrival where the stamp is ahead
        self.is_frozen = False  # it repeats one scan
        self.is_blind = False  # it has no view in the direction of the command

    def take(self, scan: LaserScan, track: OdometryBuffer, obstacles: Obstacles, now: int) -> bool:
        """Takes the next usable scan. Returns whether the laser begins to repeat one scan with it."""
        self.scan, self.valid_from = scan, min(scan_end(scan), now)
        self.visibility.add_scan(scan, track, now)
        obstacles.add_scan(scan, track, self.visibility.is_covered, self.laser, self.visibility.has_seen)
        # a covered laser measures the same ranges always: then the cover is the cause
        was_frozen = self.is_frozen
        self.is_frozen = self.repeats.take(scan, track.odom_from_base) and not self.visibility.is_covered
        return self.is_frozen and not was_frozen

    @property
    def end(self) -> int | None:
        """ns of the newest scan's last beam."""
        return scan_end(self.scan) if self.scan is not None else None

    def clear(self) -> None:
        """Drops what was seen: odometry restarted, so its points have no place in the new frame."""
        self.visibility.clear()
        self.repeats.restart()
        self.scan = self.valid_from = None

    def covers(self, direction: float) -> bool:
        """Whether a direction in `base`, rad, lies in its sweep."""
        return self.scan is not None and bool(
            is_in_sweep(self.scan, np.array([direction - self.laser.mount.yaw])).all()
        )

    def about(self, words: str) -> str:
        """Words about this laser."""
        return about_laser(self.laser, words)


def scan_end(scan: LaserScan) -> int:
    """ns of the last beam."""
    return scan.stamp + round(scan.scan_time * 1e9)
