# SPDX-License-Identifier: Apache-2.0
"""Is a scan a new measurement of the configured laser? Checks of its beams, and of a repeated buffer.

Both checks are our own: the first compares with the configuration, the second with noise and motion.
"""

from math import hypot, pi, radians

import numpy as np

from shared.config import Laser, Mount
from shared.geometry import Pose2, wrapped
from shared.messages import LaserScan
from shared.types import Bools

MAX_UNLIKE_SHARE = 0.1
"""Of beam count and increment, between the configuration and a scan that is followed: a motor's speed varies."""
MAX_UNLIKE_ARC = radians(3.0)
"""Between the ends of the configured sweep and a scan's, beside one increment."""

MIN_REPEATS = 2
MIN_REPEATED_NS = 250_000_000
MAX_USUAL_REPEATS = 3
"""A driver may publish each sweep several times. Only more repeats than usual are a fault."""
MAX_GAP_NS = 1_000_000_000
"""Between two scans that belong to one stream."""
MIN_RETURNS = 30
"""A scan of fewer returns may repeat by chance: readings have steps."""
MIN_VALUES = 5
"""Different ranges of a scan: a covered laser may measure its cover, always the same."""
N_SECTORS = 12
N_PAIRS = 10
MIN_SECTORS_SHARE = 0.75
"""Noise is everywhere, people are not: of the sectors, those in which readings changed over N_PAIRS standing scans."""
STANDING_M, STANDING_RAD = 0.001, 0.001
SETTLING_NS = 500_000_000
"""Of standing, before scans count for noise: below the encoders' resolution a robot may still move."""
MIN_NOISE_M = 0.0005
"""By which two readings differ; a device has steps of 1 mm or more."""
MOVED_M, MOVED_RAD = 0.15, 0.1
"""Motion after which a scan of anything but a featureless corridor has changed, also with steps of 5 cm."""
MIN_CONTRADICTIONS = 0.15
"""Share of the returns that a motion should have moved."""
AGREES_M = 0.06


def mismatch(scan: LaserScan, laser: Laser) -> str:
    """Difference of a scan's beams from its laser's, in words with both numbers; empty where the scan is usable.

    A scan contains its own angles, so small differences are accepted. They are 10 % of beam count and increment, and
    3 degrees and one increment at the ends of the sweep. Beams may run in either direction.
    """
    n, step = len(scan.ranges), abs(scan.angle_increment)
    name = f"robot.lasers.{laser.name}" if laser.name else "robot.laser"
    n_configured, configured_step = laser.n_beams, abs(laser.angle_increment)
    if abs(n - n_configured) > max(1.0, MAX_UNLIKE_SHARE * n_configured):
        return f"{n} beams came, {name}.n_beams is {n_configured}"
    if abs(step - configured_step) > MAX_UNLIKE_SHARE * configured_step:
        return f"beams {step:.6g} rad apart came, {name}.angle_increment is {configured_step:.6g}"
    slack = MAX_UNLIKE_ARC + configured_step
    sweep, configured_sweep = step * (n - 1), configured_step * (n_configured - 1)
    if abs(sweep - configured_sweep) > slack:
        return (
            f"a sweep of {sweep:.4g} rad came ({n} beams, {step:.6g} rad apart), "
            f"{name} has {configured_sweep:.4g} ({n_configured} beams, {configured_step:.6g} rad apart)"
        )
    first = min(scan.angle_min, scan.angle_min + (n - 1) * scan.angle_increment)
    configured_first = min(laser.angle_min, laser.angle_min + (n_configured - 1) * laser.angle_increment)
    full_turn = configured_sweep > 2 * pi - slack
    if not full_turn and abs(wrapped(first - configured_first)) > slack:
        return f"a sweep from {first:.4g} rad came, {name} begins at {configured_first:.4g}"
    return ""


class RepeatedScans:
    """Detects a laser that publishes one buffer repeatedly with new stamps.

    Equal ranges alone are no fault: a simulated laser without noise repeats while the robot stands. In an endless
    corridor it repeats also while the robot drives. A repetition is a fault in two cases:

    - The laser has noise. Scans of a standing robot that differ in all directions show it.
    - The motion by odometry contradicts the repetition.
    """

    def __init__(self, mount: Mount) -> None:
        self.base_from_laser = Pose2(mount.x, mount.y, mount.yaw)
        self.noisy = False
        self.frozen = False
        self.n_repeats = 0  # scans that equal the one before, in a row
        self._first: LaserScan | None = None  # of the equal ones
        self._newest = 0  # ns, stamp
        self._stands_since = 0  # ns, stamp
        self._odom_from_stand = Pose2()  # where it stands since then
        self._odom_from_first = Pose2()
        self._changed: Bools = np.zeros(N_SECTORS, bool)
        self._n_pairs = 0
        self._usual_repeats = 0  # in a row, of a stream that went on by itself

    def restart(self) -> None:
        """Forgets earlier scans and poses, after odometry restarted or the clock was set back. Noise stays known."""
        self._first, self.n_repeats, self.frozen = None, 0, False

    def take(self, scan: LaserScan, odom_from_base: Pose2) -> bool:
        """Adds the next scan with the newest pose by odometry. Returns whether the laser repeats one scan."""
        first = self._first
        self._stand(scan, odom_from_base)
        if first is None or not 0 < scan.stamp - self._newest <= MAX_GAP_NS or len(first.ranges) != len(scan.ranges):
            self._begin(scan, odom_from_base)
        elif np.array_equal(first.ranges, scan.ranges, equal_nan=True):
            self.n_repeats += 1
            self.frozen = self.frozen or self._proven(first, scan, odom_from_base)
        else:
            self._learn(first, scan)
            if not self.frozen and self._newest - first.stamp <= 2 * MIN_REPEATED_NS:
                self._usual_repeats = max(self._usual_repeats, min(self.n_repeats, MAX_USUAL_REPEATS))
            self._begin(scan, odom_from_base)
        self._newest = scan.stamp
        return self.frozen

    def _begin(self, scan: LaserScan, odom_from_base: Pose2) -> None:
        self._first, self._odom_from_first = scan, odom_from_base
        self.n_repeats, self.frozen = 0, False

    def _proven(self, first: LaserScan, scan: LaserScan, odom_from_base: Pose2) -> bool:
        enough = max(MIN_REPEATS, self._usual_repeats + 2 if self._usual_repeats else 0)
        if self.n_repeats < enough or scan.stamp - first.stamp < MIN_REPEATED_NS:
            return False
        measured = scan.ranges[returns(scan)]
        if len(measured) < MIN_RETURNS or len(np.unique(measured)) < MIN_VALUES:
            return False
        return self.noisy or self._contradicted(scan, self._odom_from_first.inverse() @ odom_from_base)

    def _stand(self, scan: LaserScan, odom_from_base: Pose2) -> None:
        """Notices since when the robot stands."""
        moved = self._odom_from_stand.inverse() @ odom_from_base
        if hypot(moved.x, moved.y) > STANDING_M or abs(moved.yaw) > STANDING_RAD:
            self._stands_since, self._odom_from_stand = scan.stamp, odom_from_base
            self._changed[:], self._n_pairs = False, 0

    def _learn(self, first: LaserScan, scan: LaserScan) -> None:
        if scan.stamp - self._stands_since < SETTLING_NS:
            return
        both = returns(first) & returns(scan)
        if np.count_nonzero(both) < MIN_RETURNS:
            return
        sectors = np.arange(len(both)) * N_SECTORS // len(both)
        changed = np.zeros(len(both), bool)
        changed[both] = np.abs(first.ranges[both] - scan.ranges[both]) >= MIN_NOISE_M
        self._changed[sectors[changed]] = True
        self._n_pairs += 1
        if self._n_pairs == N_PAIRS:
            filled = np.bincount(sectors[both], minlength=N_SECTORS) > 2
            n_changed, n_filled = np.count_nonzero(self._changed & filled), np.count_nonzero(filled)
            self.noisy = bool(n_changed >= MIN_SECTORS_SHARE * n_filled)
            self._changed, self._n_pairs = np.zeros(N_SECTORS, bool), 0

    def _contradicted(self, scan: LaserScan, motion: Pose2) -> bool:
        """Whether a robot that moved so would see another scan: its returns, moved, lie off the scan's own."""
        if hypot(motion.x, motion.y) < MOVED_M and abs(motion.yaw) < MOVED_RAD:
            return False
        beams = np.flatnonzero(returns(scan))
        ranges = scan.ranges.astype(float)
        angles = scan.angle_min + scan.angle_increment * beams
        points = np.column_stack((ranges[beams] * np.cos(angles), ranges[beams] * np.sin(angles)))
        laser_from_first = (motion @ self.base_from_laser).inverse() @ self.base_from_laser
        moved = laser_from_first @ points
        turn = (np.arctan2(moved[:, 1], moved[:, 0]) - scan.angle_min) * np.sign(scan.angle_increment) % (2 * pi)
        at = np.round(turn / abs(scan.angle_increment)).astype(int)
        n = len(ranges)
        met = at < n
        near = np.stack([ranges[np.clip(at[met] + shift, 0, n - 1)] for shift in (-1, 0, 1)])
        near[:, ~np.isfinite(near).all(axis=0)] = np.nan  # beside a beam without a return nothing is known
        distance = np.hypot(moved[met, 0], moved[met, 1])
        off = (distance < near.min(axis=0) - AGREES_M) | (distance > near.max(axis=0) + AGREES_M)
        n_known = np.count_nonzero(np.isfinite(near[0]))
        return bool(n_known >= MIN_RETURNS and np.count_nonzero(off) >= MIN_CONTRADICTIONS * n_known)


def returns(scan: LaserScan) -> Bools:
    """(n,) bool: beams with a range from range_min to range_max."""
    return np.asarray((scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max))
