# SPDX-License-Identifier: Apache-2.0
"""Which path did the laser take, by its scans alone? The mapper's own code, with the laser as the robot's frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.mapper.config import MapperConfig
from shared.config import Laser, Mount, Robot, UserError
from shared.geometry import Pose2
from shared.messages import LaserScan, Localization, Odometry
from shared.types import Float64s, Int64s
from zenav.calibrate.rolling import WheelGeometry, WheelTravel, composed_poses
from zenav.slam.offline_slam import OfflineRun

MIN_SCANS = 20


class ScanTrack(NamedTuple):
    """Poses (n, 3) of the laser in a map of its own, yaw unwrapped, at stamps (n,) ns; good: (n,) bool, trusted."""

    stamps: Int64s
    poses: Float64s
    good: NDArray[np.bool_]

    @property
    def travel(self) -> float:
        """m"""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())

    @property
    def turning(self) -> float:
        """rad, both ways added"""
        return float(np.abs(np.diff(self.poses[:, 2])).sum())


def scan_track(
    scans: list[LaserScan], rolled: WheelTravel, robot: Robot, wheels: WheelGeometry, mount: Float64s
) -> ScanTrack:
    """Places the scans from odometry's guess by `wheels` and base_from_laser `mount` (3,), which need not be right.

    Raises UserError where there are too few scans, or too few of them find their place.
    """
    if len(scans) < MIN_SCANS:
        raise UserError(f"there are {len(scans)} scans", "record scan and base/wheels together for half a minute")
    run = OfflineRun(MapperConfig(), laser_at_origin(robot))
    run.mapper.warm_up()
    map_from_base = rolled.poses(wheels)
    start_from_laser = composed_poses(_inverse(mount), composed_poses(map_from_base, mount))
    i_odometry = 0
    for scan in scans:
        end = scan.stamp + round(scan.scan_time * 1e9)
        while i_odometry < len(rolled.stamps):
            stamp = int(rolled.stamps[i_odometry])
            x, y, yaw = (float(v) for v in start_from_laser[i_odometry])
            run.mapper.now = max(run.mapper.now, stamp)
            run.add(run.mapper.odometry(Odometry(stamp, Pose2(x, y, yaw), 0.0, 0.0, np.zeros(9))))
            i_odometry += 1
            if stamp >= end:
                break
        run.mapper.now = max(run.mapper.now, end)
        run.add(run.mapper.scan(scan))
    run.mapper.now += 1_000_000_000
    run.add(run.mapper.release())
    estimates = run.estimates
    poses = np.array([(e.map_from_base.x, e.map_from_base.y, e.map_from_base.yaw) for e in estimates]).reshape(-1, 3)
    poses[:, 2] = np.unwrap(poses[:, 2])
    good = np.array([e.state is Localization.GOOD for e in estimates], bool)
    if good.sum() < MIN_SCANS or good.mean() < 0.5:
        raise UserError(
            f"only {int(good.sum())} of {len(scans)} scans find their place among the others",
            "record in a room with walls within the laser's range, and drive slowly",
        )
    return ScanTrack(np.array([e.stamp for e in estimates], np.int64), poses, good)


def laser_at_origin(robot: Robot) -> Robot:
    """The robot as if its laser sat at its origin, looking ahead."""
    laser = Laser(**(robot.laser.model_dump() | {"mount": Mount()}))
    return robot.model_copy(update={"laser": laser})


def _inverse(pose: Float64s) -> Float64s:
    inverse = Pose2(*(float(v) for v in pose)).inverse()
    return np.array((inverse.x, inverse.y, inverse.yaw))
