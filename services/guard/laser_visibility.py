# SPDX-License-Identifier: Apache-2.0
"""Visibility of the direction of travel: a scan without returns does not prove free space.

Static obstacles do not vanish. A sector goes dark where expected returns vanish at once, over 20 degrees or
more. It stays dark until returns come back in it. The points seen there are kept.

The method is our own: the returns that a sector should show are those of the last scan, moved by odometry.
"""

from math import pi, radians

import numpy as np
from pydantic import Field

from services.guard.obstacles import MAX_BEAMS, NO_POINTS, beam_ends, is_supported
from shared.config import Laser, Robot, Section
from shared.geometry import Pose2, arc
from shared.messages import LaserScan
from shared.odometry_buffer import OdometryBuffer
from shared.polygon import contains
from shared.scan_faults import returns
from shared.types import Bools, Float64s, Int64s

MIN_DIRECTION_RAD = radians(3.0)  # width of a direction; two beams at least
SECTOR_HALF_WIDTH_RAD = radians(15.0)  # of the sector about a direction
MIN_EXPECTED = 0.6  # share of a sector that the last scan filled; a passing person uncovers less between scans
MIN_EXPECTED_WHOLE = 0.1  # the same of the whole sweep: less suffices, as everything vanishes at once
MAX_KEPT_OF_LOST = 0.25  # share of the expected returns under which a sector is dark
MIN_RETURNED = 0.5  # share of them from which a dark sector is seen again
MIN_STILL_EXPECTED = 0.3  # share of a dark sector with remembered points: with fewer, nothing proves it dark
AHEAD_HALF_WIDTH_RAD = radians(25.0)  # about straight ahead or back
MIN_DARK = 0.25  # share of the directions that the robot will sweep
SUPPORT_RADIUS_M = 0.1  # of two returns that support each other: a single one is noise
MAX_LOST_POINTS = 1000  # kept, the nearest
MIN_RETURN_BEHIND_M = 0.3  # by which a return must lie behind a kept point to disprove it
MIN_RANGE_MARGIN_M = 0.05  # over range_min: a point there may leave the range by noise
MAX_RANGE_SHARE = 0.8  # of range_max: some dark and slanted surfaces return nothing beyond
MIN_FAR_MARGIN_M = 0.1  # under range_max: a point there may leave the range by noise
MIN_EXPECTED_FAR = 0.9  # share of a sector that the last scan filled, also beyond MAX_RANGE_SHARE
MAX_KEPT_OF_FAR = 0.05  # share of these returns under which the sector is dark
LOOKAHEAD_M = 1.0  # beyond the stopping distance
MAX_TURN_AHEAD_RAD = pi / 2
N_STEPS = 6  # poses on the arc ahead
MAX_OUTLINE_GAP_M = 0.1  # between points of the outline


class VisibilityConfig(Section):
    """When a scan counts as a view. In halls wider than the laser's range and in open air set both shares to 0."""

    min_share: float = Field(
        0.05, ge=0, le=1, description="share of the beams that must return; with fewer the laser has no view at all"
    )
    min_ahead: float = Field(
        0.05,
        ge=0,
        le=1,
        description=(
            "share of the directions within 25 degrees of the motion that must return, unless a range "
            "sensor covers them, for more than `field.blind_speed`"
        ),
    )
    blind_after: float = Field(
        0.3,
        ge=0.05,
        le=2,
        description="s without a view until navigation stops and teleop drives at most `field.blind_speed`",
    )
    dark_sectors: bool = Field(
        True, description="returns that vanish at once over 20 degrees or more make a sector dark"
    )
    inf_is_free: bool = Field(
        False, description="a beam of +inf counts as a view of free space (REP 117); NaN never does"
    )


class LaserVisibility:
    """Dark directions in `laser`, since when, and the points that stood there. now: ns."""

    def __init__(self, config: VisibilityConfig, robot: Robot, laser: Laser) -> None:
        self.config, self.robot = config, robot
        mount = laser.mount
        self.base_from_laser = Pose2(mount.x, mount.y, mount.yaw)
        self.n_directions = round(2 * pi / max(MIN_DIRECTION_RAD, 2 * abs(laser.angle_increment)))
        self.sector_half = max(1, round(SECTOR_HALF_WIDTH_RAD * self.n_directions / (2 * pi)))
        corners = robot.corners
        edges = np.roll(corners, -1, axis=0) - corners
        self.outline = np.concatenate(
            [
                corner + np.linspace(0, 1, 2 + int(np.hypot(*edge) / MAX_OUTLINE_GAP_M))[:-1, None] * edge
                for corner, edge in zip(corners, edges)
            ]
        )
        self.detail = ""
        self.clear()

    def clear(self) -> None:
        """Drops everything: odometry restarted."""
        self._covered: Bools = np.zeros(self.n_directions, bool)
        self._dark_since: Int64s = np.zeros(self.n_directions, np.int64)  # ns, 0: not dark
        self._all_since = 0  # ns since when everything is dark, 0: not
        self._few_since = 0  # ns since when under min_share of the beams return, 0: enough return
        self._seen_at: Int64s = np.zeros(self.n_directions, np.int64)  # ns
        self._ends = NO_POINTS  # (k, 2) m in `odom`: returns of the last scan, and lost ones
        self._lost: Bools = np.zeros(0, bool)  # (k,) which of them were seen before their direction went dark

    def points(self, odom_from_base: Pose2) -> Float64s:
        """(k, 2) m in `base`: points in directions that are dark now."""
        return odom_from_base.inverse() @ self._ends[self._lost]

    def add_scan(self, scan: LaserScan, track: OdometryBuffer, now: int) -> None:
        """Takes the next scan."""
        stride = -(-len(scan.ranges) // MAX_BEAMS)
        ends, in_base, radius = beam_ends(scan, track, self.base_from_laser, stride)
        own = np.isfinite(ends[:, 0]) & contains(self.robot.corners, in_base)
        hit = np.isfinite(ends[:, 0]) & ~own
        ends[~hit] = np.nan
        seen = hit | (self.config.inf_is_free & np.isposinf(scan.ranges[::stride]))
        angles: Float64s = scan.angle_min + scan.angle_increment * stride * np.arange(len(hit), dtype=np.float64)
        bins = self._directions_of(angles)
        n_beams = np.bincount(bins, minlength=self.n_directions)
        self._covered = n_beams > 0
        returned_share = np.bincount(bins[seen], minlength=self.n_directions) / np.maximum(n_beams, 1)
        self._seen_at[returned_share > 0] = now
        middle = track.poses(np.array([scan.scan_time / 2]), scan.stamp)[0]
        odom_from_laser = Pose2(float(middle[0]), float(middle[1]), float(middle[2])) @ self.base_from_laser
        known = odom_from_laser.inverse() @ self._ends
        distance, at = np.hypot(known[:, 0], known[:, 1]), self._directions_of(_bearings(known))
        due = (
            (distance > scan.range_min + MIN_RANGE_MARGIN_M)
            & (distance < scan.range_max - MIN_FAR_MARGIN_M)
            & self._covered[at]
            & self.config.dark_sectors
        )
        near, expected = (
            np.minimum(np.bincount(at[which], minlength=self.n_directions) / np.maximum(n_beams, 1), 1.0)
            for which in (due & (distance < MAX_RANGE_SHARE * scan.range_max), due)
        )
        self._update_dark_sectors(returned_share, near, expected, float(seen.mean()), now)
        self._update_points(ends, radius, bins, odom_from_laser, distance, at)
        self.detail = (
            self._description(scan, int(stride * np.count_nonzero(own))) if self._few_since or self._dark.any() else ""
        )

    def is_blind(self, v: float, w: float, now: int) -> bool:
        """Whether the direction of travel at v m/s and w rad/s has been without a view for `blind_after`."""
        if not self.is_dark:
            return False
        before = now - round(self.config.blind_after * 1e9)
        if any(0 < since <= before for since in (self._few_since, self._all_since)):
            return True
        dark = self._dark & (self._dark_since <= before)
        if not dark.any():
            return False
        swept = self._swept_directions(v, w)
        return bool(len(swept)) and float(dark[swept].mean()) >= MIN_DARK

    def is_empty(self, direction: float, now: int) -> bool:
        """Whether nothing has returned for `blind_after` from around a direction in `base`, rad."""
        offsets = np.arange(-AHEAD_HALF_WIDTH_RAD, AHEAD_HALF_WIDTH_RAD + 1e-9, 2 * pi / self.n_directions)
        about = np.unique(self._directions_of(direction - self.base_from_laser.yaw + offsets))
        about = about[self._covered[about]]
        is_recent = now - self._seen_at[about] <= round(self.config.blind_after * 1e9)
        return bool(len(about)) and float(is_recent.mean()) < self.config.min_ahead

    def has_seen(self, bearings: Float64s) -> Bools:
        """(n,) whether anything ever returned from these bearings in `laser`, rad; else a part of the robot hides them.

        Beams that the driver masks, or that end in the footprint, never return.
        """
        return np.asarray(self._seen_at[self._directions_of(bearings)] > 0)

    @property
    def is_covered(self) -> bool:
        """Whether under `min_share` of the last scan's beams returned from outside the robot."""
        return self._few_since > 0

    @property
    def is_dark(self) -> bool:
        """Whether any sector lacks returns that should be seen."""
        return bool(self._few_since or self._all_since or self._dark.any())

    @property
    def _dark(self) -> Bools:
        return self._dark_since > 0

    def _directions_of(self, angles: Float64s) -> Int64s:
        return (angles % (2 * pi) * (self.n_directions / (2 * pi))).astype(np.int64) % self.n_directions

    def _update_dark_sectors(
        self, returned_share: Float64s, near: Float64s, expected: Float64s, share: float, now: int
    ) -> None:
        """Updates the dark sectors. Arrays are (n,): share of each direction's beams that returned, and that should.

        near: those that should, from the part of the range in which every surface returns.
        """
        is_gone = self._is_gone(returned_share, near, MIN_EXPECTED, MAX_KEPT_OF_LOST)
        is_gone |= self._is_gone(returned_share, expected, MIN_EXPECTED_FAR, MAX_KEPT_OF_FAR)
        again = np.minimum(returned_share, expected)
        total, again_near = float(near.sum()), float(np.minimum(returned_share, near).sum())
        n_covered = np.count_nonzero(self._covered)
        fresh = (
            (self._sector_sum(is_gone.astype(float)) > 0)
            & (expected > 0)
            & (returned_share < MAX_KEPT_OF_LOST * expected)
        )
        if not self._all_since and total >= MIN_EXPECTED_WHOLE * n_covered and again_near < MAX_KEPT_OF_LOST * total:
            self._all_since = now
            fresh |= (near > 0) & (returned_share == 0)
        self._dark_since[fresh & ~self._dark] = now
        dark = self._dark
        due, back = self._sector_sum(expected * dark), self._sector_sum(again * dark)
        proven = due >= MIN_STILL_EXPECTED * self._sector_sum(dark.astype(float))
        self._dark_since[dark & ~(proven & (back < MIN_RETURNED * due))] = 0
        if again_near >= MIN_RETURNED * total or total < MIN_EXPECTED_WHOLE / 2 * n_covered:
            self._all_since = 0
        few = share < self.config.min_share
        self._few_since = (self._few_since or now) if few else 0

    def _is_gone(self, returned_share: Float64s, expected: Float64s, min_expected: float, max_kept: float) -> Bools:
        """(n,) whether a direction's sector was filled to a share, and has kept less than another one of that."""
        due = self._sector_sum(expected)
        kept = self._sector_sum(np.minimum(returned_share, expected))
        return np.asarray((due >= min_expected * (2 * self.sector_half + 1)) & (kept < max_kept * due))

    def _update_points(
        self,
        ends: Float64s,
        radius: Float64s,
        bins: Int64s,
        odom_from_laser: Pose2,
        distance: Float64s,
        at: Int64s,
    ) -> None:
        """Takes the returns of this scan, and keeps the known points that lie in the dark.

        `ends`, `bins`: (b, 2) m in `odom` and (b,) directions of this scan's beams. `distance`, `at`: (k,) m and
        direction of the known points.
        """
        hidden = self._dark | bool(self._few_since or self._all_since)
        farthest = np.full(self.n_directions, -1.0)
        hit = np.isfinite(ends[:, 0])
        away = np.hypot(ends[hit, 0] - odom_from_laser.x, ends[hit, 1] - odom_from_laser.y)
        np.maximum.at(farthest, bins[hit], away)
        kept = hidden[at] & self._covered[at] & (farthest[at] < distance + MIN_RETURN_BEHIND_M)
        kept |= self._lost & ~self._covered[at]  # out of the sweep now: its state is unknown
        order = np.flatnonzero(kept)
        if len(order) > MAX_LOST_POINTS:
            order = order[np.argsort(distance[order], kind="stable")[:MAX_LOST_POINTS]]
        solid = ends[is_supported(ends, NO_POINTS, SUPPORT_RADIUS_M + radius, 2)]
        self._lost = np.concatenate([np.ones(len(order), bool), np.zeros(len(solid), bool)])
        self._ends = np.concatenate([self._ends[order], solid])

    def _sector_sum(self, shares: Float64s) -> Float64s:
        """(n,) sum over each direction's sector."""
        wrapped = np.concatenate([shares[-self.sector_half :], shares, shares[: self.sector_half + 1]])
        sums = np.concatenate([[0.0], np.cumsum(wrapped)])
        width = 2 * self.sector_half + 1
        return np.asarray(np.round(sums[width : width + self.n_directions] - sums[: self.n_directions], 9))

    def _swept_directions(self, v: float, w: float) -> Int64s:
        """(k,) covered directions of the area that the outline sweeps next at v m/s and w rad/s."""
        drive = self.robot.drive
        rim = max(abs(v) + abs(w) * self.robot.circumscribed_radius, 1e-6)
        seconds = (LOOKAHEAD_M + v * v / (2 * drive.max_braking)) / rim
        seconds = min(seconds, MAX_TURN_AHEAD_RAD / max(abs(w), 1e-6))
        steps = seconds * np.arange(1, N_STEPS + 1) / N_STEPS
        swept = np.concatenate([arc(v * t, w * t) @ self.outline for t in steps.tolist()])
        swept = swept[~contains(self.robot.corners, swept)]
        in_laser = self.base_from_laser.inverse() @ swept
        bins = np.unique(self._directions_of(_bearings(in_laser)))
        return bins[self._covered[bins]]

    def _description(self, scan: LaserScan, n_own: int) -> str:
        """Contents of the scan for `guard/status`. n_own: returns from inside the robot's outline."""
        ranges, n_directions = scan.ranges, len(scan.ranges)
        counts = {
            "from the robot itself": n_own,
            "NaN": np.count_nonzero(np.isnan(ranges)),
            "+inf": np.count_nonzero(np.isposinf(ranges)),
            f"under {scan.range_min:g} m": np.count_nonzero(ranges < scan.range_min),
            f"over {scan.range_max:g} m": np.count_nonzero(np.isfinite(ranges) & (ranges > scan.range_max)),
        }
        words = [f"{count} {name}" for name, count in counts.items() if count]
        text = f"{np.count_nonzero(returns(scan))} of {n_directions} beams return"
        if words:
            text += f", {', '.join(words)}"
        if not self._few_since:
            text += f"; {np.count_nonzero(self._dark) * 360 // self.n_directions} degrees went dark"
        return text


def _bearings(points: Float64s) -> Float64s:
    return np.asarray(np.arctan2(points[:, 1], points[:, 0]))
