# SPDX-License-Identifier: Apache-2.0
"""Obstacles near the robot: points of the scans and the range sensors in `odom`, and remembered ones out of view.

Points without neighbours are noise, as in the radius outlier removal of PCL. Here the neighbours are beams beside the
point, and points of the scan before. The memory of points out of view is our own.
"""

from collections.abc import Callable
from math import pi

import numpy as np
from pydantic import Field

from shared.config import Laser, Robot, Section
from shared.geometry import Pose2
from shared.messages import LaserScan, RangeReadings
from shared.odometry_buffer import OdometryBuffer
from shared.polygon import contains
from shared.types import Bools, Float64s

ECHO_MATCH_M = 0.08  # between a range reading and a laser echo of the same object
MAX_BEAMS = 1440  # of one scan, 0.25 degrees of a full turn; of a finer scan each second, third ... beam is used
MAX_REMEMBERED = 500  # points, the nearest
MAX_CONTACTS = 8  # places, the newest
NO_POINTS = np.empty((0, 2))


class ObstaclesConfig(Section):
    """What counts as an obstacle."""

    min_points: int = Field(2, ge=1, le=10, description="neighbouring points that make an obstacle; fewer are noise")
    support_radius: float = Field(0.1, gt=0, le=1, description="m within which points support each other")
    memory: float = Field(
        20.0, ge=0, le=120, description="s that an obstacle is remembered outside the view of all sensors"
    )


class Obstacles:
    """Points in `odom` within `reach` m of the robot that the protective field must keep clear of."""

    def __init__(self, config: ObstaclesConfig, robot: Robot, reach: float) -> None:
        self.config, self.robot, self.reach = config, robot, reach
        self.clear()

    def clear(self) -> None:
        """Drops all points: odometry restarted."""
        # by the laser's name: the last scan's points, and those of them that are not noise
        self._seen = {laser.name: NO_POINTS for laser in self.robot.all_lasers}
        self._solid_of = dict(self._seen)
        self._remembered = NO_POINTS
        self._remembered_at = np.empty(0)  # s
        self._echoes: dict[int, tuple[Float64s, int]] = {}  # sensor -> its points, ns of the reading
        self._contacts: list[tuple[Float64s, int]] = []  # points, ns of the contact

    def points(self, odom_from_base: Pose2, now: int) -> Float64s:
        """(n, 2) m in `base` at the given pose. now: ns."""
        age = self.config.memory * 1e9
        echoes = [points for points, stamp in self._echoes.values() if now - stamp <= age]
        touched = [points for points, stamp in self._contacts if now - stamp <= age]
        return odom_from_base.inverse() @ np.concatenate([self._solid, self._remembered, *echoes, *touched])

    def add_contacts(self, points: Float64s, odom_from_base: Pose2, is_new: bool, now: int) -> None:
        """Remembers where the robot touches something, or sees no floor: no other sensor may see it.

        points: (n, 2) m in `base`.  is_new: something more is touched than before.  now: ns.
        What stays touched is farther on while the robot rolls on, and stays where it is when the robot leaves.
        """
        touched = odom_from_base @ points
        if not is_new and self._contacts:
            (before, _), middle = self._contacts[-1], touched.mean(axis=0)
            advance = (middle - before.mean(axis=0)) @ (middle - (odom_from_base.x, odom_from_base.y))
            if advance <= 0:
                return
            self._contacts.pop()
        self._contacts = [*self._contacts[1 - MAX_CONTACTS :], (touched, now)]

    @property
    def _solid(self) -> Float64s:
        """(n, 2) m in `odom`: the points of each laser's last scan that are not noise."""
        return np.concatenate(list(self._solid_of.values()))

    def add_scan(
        self,
        scan: LaserScan,
        track: OdometryBuffer,
        covered: bool = False,
        laser: Laser | None = None,
        has_seen: Callable[[Float64s], Bools] = lambda bearings: np.ones(len(bearings), bool),
    ) -> None:
        """Replaces the points of a laser's last scan. Points outside the new scan's view are remembered.

        covered: hardly any beam leaves the robot, so returns from inside its outline are its own.
        laser: whose scan it is; none: the first one's.  has_seen: (n,) whether the laser can see along bearings, rad.
        """
        laser = laser or self.robot.laser
        mount = laser.mount
        base_from_laser = Pose2(mount.x, mount.y, mount.yaw)
        stride = -(-len(scan.ranges) // MAX_BEAMS)
        ends, radius = self._ends(scan, track, base_from_laser, stride, covered)
        solid = is_supported(ends, self._seen[laser.name], radius, self.config.min_points)
        self._update_remembered(scan, track, base_from_laser, self._solid_of[laser.name], has_seen)
        self._seen[laser.name], self._solid_of[laser.name] = ends[np.isfinite(ends[:, 0])], ends[solid]

    def add_ranges(self, readings: RangeReadings, track: OdometryBuffer) -> None:
        """Replaces the echoes of the range sensors.

        An echo that a laser point explains is dropped, as the laser is more exact. An echo below a sensor's range
        stays where it was.
        """
        odom_from_base = _pose(track.poses(np.zeros(1), readings.stamp)[0])
        columns = (readings.x, readings.y, readings.yaw, readings.field_of_view, readings.ranges)
        for i, (x, y, yaw, cone, reach) in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
            odom_from_sensor = odom_from_base @ Pose2(x, y, yaw)
            if np.isfinite(reach):
                distance, bearing = _polar(odom_from_sensor.inverse() @ self._solid)
                is_explained = (np.abs(bearing) <= cone / 2 + 0.1) & (distance <= reach + ECHO_MATCH_M)
                echo = NO_POINTS if is_explained.any() else odom_from_sensor @ _arc(reach, cone)
            else:
                echo = self._echoes.get(i, (NO_POINTS, 0))[0]
                if len(echo):
                    distance, _ = _polar(odom_from_sensor.inverse() @ echo)
                    least = self.robot.ranges[i].range_min if i < len(self.robot.ranges) else 0.0
                    echo = echo[distance <= least + ECHO_MATCH_M]
            self._echoes[i] = echo, readings.stamp

    def _ends(
        self, scan: LaserScan, track: OdometryBuffer, base_from_laser: Pose2, stride: int, covered: bool
    ) -> tuple[Float64s, Float64s]:
        """Ends (n, 2) and radius (n,) of `beam_ends`; NaN where the end is out of reach or on the robot, too."""
        ends, in_base, radius = beam_ends(scan, track, base_from_laser, stride)
        if covered:
            ends[contains(self.robot.corners, in_base)] = np.nan
        ends[~(np.hypot(in_base[:, 0], in_base[:, 1]) <= self.reach)] = np.nan
        return ends, self.config.support_radius + radius

    def _update_remembered(
        self,
        scan: LaserScan,
        track: OdometryBuffer,
        base_from_laser: Pose2,
        before: Float64s,
        has_seen: Callable[[Float64s], Bools],
    ) -> None:
        """Keeps the points, of the laser's scan before (n, 2) and of those remembered, that this scan could not see."""
        points = np.concatenate([before, self._remembered])
        seen = np.concatenate([np.full(len(before), scan.stamp * 1e-9), self._remembered_at])
        odom_from_base = _pose(track.poses(np.array([scan.scan_time / 2]), scan.stamp)[0])
        distance, bearing = _polar((odom_from_base @ base_from_laser).inverse() @ points)
        looked = is_in_sweep(scan, bearing) & has_seen(bearing)
        too_near = looked & (distance < scan.range_min + 0.02)
        is_recent = scan.stamp * 1e-9 - seen <= self.config.memory
        here = track.odom_from_base
        close = np.hypot(points[:, 0] - here.x, points[:, 1] - here.y) <= self.reach
        kept = close & (too_near | (~looked & is_recent))
        # an obstacle below range_min does not age while the robot stays
        seen[too_near] = scan.stamp * 1e-9
        self._remembered, self._remembered_at = points[kept], seen[kept]
        if len(self._remembered) > MAX_REMEMBERED:
            _, first = np.unique(np.round(self._remembered / 0.03), axis=0, return_index=True)
            order = first[
                np.argsort(np.hypot(*(self._remembered[first] - (here.x, here.y)).T), kind="stable")[:MAX_REMEMBERED]
            ]
            self._remembered, self._remembered_at = self._remembered[order], self._remembered_at[order]


def beam_ends(
    scan: LaserScan, track: OdometryBuffer, base_from_laser: Pose2, stride: int
) -> tuple[Float64s, Float64s, Float64s]:
    """The ends of each `stride`-th beam, de-skewed. base_from_laser: the laser's mount.

    Returns (n, 2) m in `odom`, NaN without an echo; (n, 2) m in `base` at that beam; and (n,) m, the distance to a
    neighbour's end on the same surface, as beams spread.
    """
    beams = np.arange(0, len(scan.ranges), stride)
    ranges = scan.ranges[::stride].astype(float)
    ranges[~((ranges >= scan.range_min) & (ranges <= scan.range_max))] = np.nan
    angles = scan.angle_min + scan.angle_increment * beams
    in_base = base_from_laser @ np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))
    x, y = in_base[:, 0], in_base[:, 1]
    poses = track.poses(scan.scan_time * beams / (len(scan.ranges) - 1), scan.stamp)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ends = np.column_stack((poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y))
    return ends, in_base, 3 * stride * abs(scan.angle_increment) * ranges


def is_supported(ends: Float64s, earlier: Float64s, radius: Float64s, least: int) -> Bools:
    """(n,) bool: which ends of beams (n, 2) belong to an obstacle. Isolated points are noise.

    A point counts itself, the ends of neighbouring beams within its radius (n,), and the points of the scan before (k,
    2). So a thin leg counts, which one beam of each scan hits.
    """
    count = np.isfinite(ends[:, 0]).astype(int)
    for shift in range(1, min(least + 1, len(ends) // 2 + 1)):
        gaps = ends - np.concatenate((ends[shift:], ends[:shift]))  # to the end `shift` beams later
        lengths = np.hypot(gaps[:, 0], gaps[:, 1])
        count += lengths <= radius
        count += np.concatenate((lengths[-shift:], lengths[:-shift])) <= radius
    lone = np.flatnonzero((count > 0) & (count < least))
    if len(lone) and len(earlier):
        to_earlier = ends[lone, None, :] - earlier
        count[lone] += (np.hypot(to_earlier[:, :, 0], to_earlier[:, :, 1]) <= radius[lone, None]).sum(axis=1)
    return np.asarray(count >= least)


def is_in_sweep(scan: LaserScan, bearings: Float64s) -> Bools:
    """(n,) bool: which directions in `laser`, rad, lie in the sweep."""
    sweep = abs(scan.angle_increment) * (len(scan.ranges) - 1)
    from_first = (bearings - scan.angle_min) * (1.0 if scan.angle_increment > 0 else -1.0)
    # half a beam on either side: a full turn's last beam ends one step before its first
    half = abs(scan.angle_increment) / 2
    return np.asarray((from_first + half) % (2 * pi) <= sweep + 2 * half)


def _arc(reach: float, cone: float) -> Float64s:
    """(k, 2) m in the sensor's frame: possible places of a cone's echo, at most 0.1 m apart."""
    angles = np.linspace(-cone / 2, cone / 2, 2 + int(reach * cone / 0.1))
    return np.column_stack((reach * np.cos(angles), reach * np.sin(angles)))


def _polar(points: Float64s) -> tuple[Float64s, Float64s]:
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _pose(row: Float64s) -> Pose2:
    return Pose2(float(row[0]), float(row[1]), float(row[2]))
