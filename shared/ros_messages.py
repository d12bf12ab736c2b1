# SPDX-License-Identifier: Apache-2.0
"""The stack's messages as ROS's, of ROS 1 and 2, and poses of ROS in the plane. Layouts are those of `rosbags`.

Frames and units are those of REP 103 and REP 105. A beam without an echo is +inf (REP 117).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import atan2, cos, sin
from typing import Any

import numpy as np

from shared.config import Mount
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, Odometry, Path, PoseEstimate
from shared.types import NS_PER_S, Float64s

SCAN, ODOM, GRID = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "nav_msgs/msg/OccupancyGrid"
TF, PATH = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Path"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
PLANE = np.array((0, 1, 5))  # x, y, yaw in ROS's covariances
MAX_COORDINATE_M = 1e6


@dataclass(frozen=True, slots=True)
class RosFrames:
    """Names of the frames in ROS."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"
    laser: str = "laser"


class RosMessages:
    """Makes messages. types: class by name, of a type store of rosbags.  header_fields: further ones of a header."""

    def __init__(
        self, types: Mapping[str, Any], frames: RosFrames, header_fields: Mapping[str, Any] | None = None
    ) -> None:
        self._types, self.frames, self._header_fields = types, frames, dict(header_fields or {})

    def new(self, type_: str, **fields: Any) -> Any:
        """A message with these fields."""
        return self._types[type_](**fields)

    def time(self, stamp: int) -> Any:
        """builtin_interfaces/Time. stamp: ns."""
        return self.new("builtin_interfaces/msg/Time", sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)

    def header(self, stamp: int, frame: str) -> Any:
        """std_msgs/Header. stamp: ns."""
        return self.new("std_msgs/msg/Header", stamp=self.time(stamp), frame_id=frame, **self._header_fields)

    @property
    def laser_frames(self) -> tuple[str, str]:
        """The frames of the first and of the second laser."""
        return self.frames.laser, f"{self.frames.laser}_2"

    def scan(self, scan: LaserScan, i_laser: int = 0) -> Any:
        """sensor_msgs/LaserScan. i_laser: place of the laser in `robot.lasers`."""
        n = len(scan.ranges)
        return self.new(
            SCAN,
            header=self.header(scan.stamp, self.laser_frames[i_laser]),
            angle_min=scan.angle_min, angle_max=scan.angle_min + scan.angle_increment * (n - 1),
            angle_increment=scan.angle_increment, time_increment=scan.scan_time / (n - 1), scan_time=scan.scan_time,
            range_min=scan.range_min, range_max=scan.range_max,
            ranges=np.where(np.isnan(scan.ranges), np.float32(np.inf), scan.ranges).astype(np.float32),
            intensities=np.ascontiguousarray(scan.intensities),
        )  # fmt: skip

    def odometry(self, odometry: Odometry) -> Any:
        """nav_msgs/Odometry."""
        spread = self.new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=self.twist(odometry.v, odometry.w),
            covariance=np.zeros(36),
        )
        return self.new(
            ODOM,
            header=self.header(odometry.stamp, self.frames.odom),
            child_frame_id=self.frames.base,
            pose=self._pose_with_covariance(odometry.odom_from_base, odometry.covariance),
            twist=spread,
        )

    def pose_estimate(self, estimate: PoseEstimate) -> Any:
        """geometry_msgs/PoseWithCovarianceStamped of the robot in `map`."""
        pose = self._pose_with_covariance(estimate.map_from_base, estimate.covariance)
        return self.new(POSE_COVARIANCE, header=self.header(estimate.stamp, self.frames.map), pose=pose)

    def path(self, path: Path) -> Any:
        """nav_msgs/Path in `map`."""
        poses = (Pose2(*row) for row in zip(path.xs.tolist(), path.ys.tolist(), path.yaws.tolist()))
        return self.path_of(path.stamp, self.frames.map, poses)

    def path_of(self, stamp: int, frame: str, poses: Iterable[Pose2]) -> Any:
        """nav_msgs/Path of poses in a frame. stamp: ns."""
        return self.new(
            PATH, header=self.header(stamp, frame), poses=[self.posed(stamp, pose, frame) for pose in poses]
        )

    def occupancy(self, grid: OccupancyGrid, stamp: int) -> Any:
        """nav_msgs/OccupancyGrid of the whole map. stamp: ns."""
        return self.grid(grid.cells, grid.resolution, (grid.x0, grid.y0), stamp, self.frames.map)

    def grid(self, cells: Any, resolution: float, origin: tuple[float, float], stamp: int, frame: str) -> Any:
        """nav_msgs/OccupancyGrid. cells: (h, w) int8.  resolution: m a cell.  origin: m, lower left.  stamp: ns."""
        height, width = cells.shape
        info = self.new(
            "nav_msgs/msg/MapMetaData", map_load_time=self.time(stamp), resolution=resolution, width=width,
            height=height, origin=self.pose(Pose2(*origin, 0.0)),
        )  # fmt: skip
        return self.new(GRID, header=self.header(stamp, frame), info=info, data=cells.ravel().copy())

    def mount(self, stamp: int, mount: Mount, i_laser: int = 0) -> Any:
        """geometry_msgs/TransformStamped of a laser on the robot. i_laser: its place in `robot.lasers`."""
        pose = Pose2(mount.x, mount.y, mount.yaw)
        return self.transform(stamp, self.frames.base, self.laser_frames[i_laser], pose)

    def transform(self, stamp: int, parent: str, child: str, parent_from_child: Pose2) -> Any:
        """geometry_msgs/TransformStamped. stamp: ns."""
        pose = parent_from_child
        transform = self.new(
            "geometry_msgs/msg/Transform", translation=self.vector(pose.x, pose.y), rotation=self.turn(pose.yaw)
        )
        return self.new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=transform,
        )

    def transforms(self, *stamped: Any) -> Any:
        """tf2_msgs/TFMessage."""
        return self.new(TF, transforms=list(stamped))

    def posed(self, stamp: int, pose: Pose2, frame: str) -> Any:
        """geometry_msgs/PoseStamped. stamp: ns."""
        return self.new(POSE, header=self.header(stamp, frame), pose=self.pose(pose))

    def pose(self, pose: Pose2) -> Any:
        """geometry_msgs/Pose."""
        return self.new("geometry_msgs/msg/Pose", position=self.point(pose.x, pose.y), orientation=self.turn(pose.yaw))

    def point(self, x: float, y: float, z: float = 0.0) -> Any:
        """geometry_msgs/Point, m."""
        return self.new("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))

    def turn(self, yaw: float) -> Any:
        """geometry_msgs/Quaternion. yaw: rad."""
        return self.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sin(yaw / 2), w=cos(yaw / 2))

    def vector(self, x: float, y: float, z: float = 0.0) -> Any:
        """geometry_msgs/Vector3."""
        return self.new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def twist(self, v: float, w: float) -> Any:
        """geometry_msgs/Twist. v: m/s.  w: rad/s."""
        return self.new("geometry_msgs/msg/Twist", linear=self.vector(v, 0.0), angular=self.vector(0.0, 0.0, w))

    def _pose_with_covariance(self, pose: Pose2, covariance: Float64s) -> Any:
        return self.new(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(pose), covariance=covariance_of_six(covariance)
        )


def covariance_of_six(covariance: Float64s) -> Float64s:
    """(36,) of ROS from (9,) of x, y, yaw."""
    out = np.zeros((6, 6))
    out[np.ix_(PLANE, PLANE)] = covariance.reshape(3, 3)
    return out.ravel()


def pose2(pose: Any) -> Pose2:
    """geometry_msgs/Pose in the plane: place and heading of its x axis. Raises ValueError where it is no pose."""
    return _planar(pose.position, pose.orientation)


def pose_of_transform(transform: Any) -> Pose2:
    """geometry_msgs/Transform in the plane, as `pose2`."""
    return _planar(transform.translation, transform.rotation)


def _planar(p: Any, q: Any) -> Pose2:
    x, y, z, w = (float(value) for value in (q.x, q.y, q.z, q.w))
    norm = x * x + y * y + z * z + w * w
    if not (0.25 < norm < 4 and abs(p.x) <= MAX_COORDINATE_M and abs(p.y) <= MAX_COORDINATE_M):
        raise ValueError("a pose that is none")
    return Pose2(float(p.x), float(p.y), atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))
