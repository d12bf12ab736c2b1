# SPDX-License-Identifier: Apache-2.0
"""The stack's messages as a ROS bag, by the `rosbags` package. Frames are REP 105's: map, odom, base_link; laser.

A beam without an echo is +inf (REP 117). The laser's mount goes into /tf_static, odometry and the map's correction into
/tf, as they do on a robot with ROS.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from math import cos, sin
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from shared.config import Mount
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, MapUpdate, Message, Odometry, Path, PoseEstimate, Truth
from shared.types import Float64s
from zenav.convert.conversion import Conversion
from zenav.convert.ros_messages import GRID, ODOM, POSE, POSE_COVARIANCE, SCAN, TF, typestore

MAP, ODOM_FRAME, BASE, LASER = "map", "odom", "base_link", "laser"
PATH = "nav_msgs/msg/Path"
TYPES = {
    "/scan": SCAN, "/odom": ODOM, "/pose": POSE_COVARIANCE, "/map": GRID, "/plan": PATH, "/ground_truth": POSE,
    "/tf": TF, "/tf_static": TF,
}  # fmt: skip
LATCHED = "/map", "/tf_static"
MAP_EVERY = 5_000_000_000  # ns between whole maps, as slam_toolbox has it
VERSION: Literal[8] = 8  # of rosbag2's metadata: what ROS 2 Humble to Kilted read
SIX = np.array((0, 1, 5))  # x, y, yaw in ROS's covariances
FOREVER = QosTime(2147483647, 4294967295)


def write_ros2(task: Conversion) -> Counter[str]:
    """A rosbag2 folder with MCAP storage, chunks compressed with zstd."""
    writer = Writer2(task.out, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        return _written(task, writer, ros1=False)


def write_ros2_sqlite(task: Conversion) -> Counter[str]:
    """A rosbag2 folder with sqlite3 storage, which ROS 2 reads since Dashing."""
    with Writer2(task.out, version=VERSION, storage_plugin=StoragePlugin.SQLITE3) as writer:
        return _written(task, writer, ros1=False)


def write_ros1(task: Conversion) -> Counter[str]:
    """A ROS 1 bag."""
    writer = Writer1(task.out)
    writer.set_compression(Writer1.CompressionFormat.LZ4)
    with writer:
        return _written(task, writer, ros1=True)


def _written(task: Conversion, writer: Any, ros1: bool) -> Counter[str]:
    ros = Ros(ros1)
    serialize: Callable[[Any, str], Any] = ros.store.serialize_ros1 if ros1 else ros.store.serialize_cdr
    connections: dict[str, Any] = {}
    counts: Counter[str] = Counter()
    for topic, stamp, message in ros.messages(task):
        if topic not in connections:
            extra: dict[str, Any] = (
                {"latching": int(topic in LATCHED)} if ros1 else {"offered_qos_profiles": [_qos(topic)]}
            )
            connections[topic] = writer.add_connection(topic, TYPES[topic], typestore=ros.store, **extra)
        writer.write(connections[topic], stamp, serialize(message, TYPES[topic]))
        counts[topic] += 1
    return counts


def _qos(topic: str) -> Qos:
    """The quality of service that subscribers expect: a late subscriber still gets the map and the static frames."""
    latched = topic in LATCHED
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=FOREVER,
        lifespan=FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=FOREVER,
        avoid_ros_namespace_conventions=False,
    )


class Ros:
    """Makes ROS messages of one ROS: ROS 1's headers have a number more."""

    def __init__(self, ros1: bool) -> None:
        self.store = typestore(ros1)
        self._more = {"seq": 0} if ros1 else {}
        self._grid = OccupancyGrid()
        self._map_due = -1  # ns, when the next whole map may be written
        self._map_waits: MapUpdate | None = None

    def messages(self, task: Conversion) -> Iterator[tuple[str, int, Any]]:
        """Topic, ns, message: the static frames first, the last map last."""
        content = task.content
        stamp, first = 0, True
        for key, message in task.messages():
            stamp = message.stamp
            if first:
                yield "/tf_static", stamp, self._static(stamp, content.mount)
                first = False
            yield from ((topic, stamp, converted) for topic, converted in self._of(key, message))
        if self._map_waits is not None:
            yield "/map", stamp, self._occupancy(self._map_waits.stamp)

    def _of(self, key: str, message: Message) -> Iterator[tuple[str, Any]]:
        if isinstance(message, LaserScan):
            yield "/scan", self._scan(message)
        elif isinstance(message, Odometry):
            yield "/odom", self._odometry(message)
            yield "/tf", self._tf(message.stamp, ODOM_FRAME, BASE, message.odom_from_base)
        elif isinstance(message, PoseEstimate):
            pose = self._new(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(message.map_from_base),
                covariance=_six(message.covariance),
            )
            yield "/pose", self._new(POSE_COVARIANCE, header=self._header(message.stamp, MAP), pose=pose)
            yield "/tf", self._tf(message.stamp, MAP, ODOM_FRAME, message.map_from_odom)
        elif isinstance(message, Truth):
            map_from_base = message.start.inverse() @ message.world_from_base
            yield "/ground_truth", self._posed(message.stamp, map_from_base)
        elif isinstance(message, Path):
            poses = [self._posed(message.stamp, Pose2(*row)) for row in zip(message.xs, message.ys, message.yaws)]
            yield "/plan", self._new(PATH, header=self._header(message.stamp, MAP), poses=poses)
        elif isinstance(message, MapUpdate):
            self._grid.apply(message)
            self._map_waits = message
            if message.stamp >= self._map_due:
                self._map_due, self._map_waits = message.stamp + MAP_EVERY, None
                yield "/map", self._occupancy(message.stamp)

    def _new(self, type_: str, **fields: Any) -> Any:
        return self.store.types[type_](**fields)

    def _time(self, stamp: int) -> Any:
        return self._new("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)

    def _header(self, stamp: int, frame: str) -> Any:
        return self._new("std_msgs/msg/Header", stamp=self._time(stamp), frame_id=frame, **self._more)

    def _scan(self, scan: LaserScan) -> Any:
        n = len(scan.ranges)
        return self._new(
            SCAN,
            header=self._header(scan.stamp, LASER),
            angle_min=scan.angle_min, angle_max=scan.angle_min + scan.angle_increment * (n - 1),
            angle_increment=scan.angle_increment, time_increment=scan.scan_time / (n - 1), scan_time=scan.scan_time,
            range_min=scan.range_min, range_max=scan.range_max,
            ranges=np.where(np.isnan(scan.ranges), np.float32(np.inf), scan.ranges).astype(np.float32),
            intensities=np.ascontiguousarray(scan.intensities),
        )  # fmt: skip

    def _odometry(self, odometry: Odometry) -> Any:
        pose = self._new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=self._pose(odometry.odom_from_base),
            covariance=_six(odometry.covariance),
        )
        twist = self._new(
            "geometry_msgs/msg/Twist", linear=self._vector(odometry.v, 0.0), angular=self._vector(0.0, 0.0, odometry.w)
        )
        spread = self._new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        header = self._header(odometry.stamp, ODOM_FRAME)
        return self._new(ODOM, header=header, child_frame_id=BASE, pose=pose, twist=spread)

    def _occupancy(self, stamp: int) -> Any:
        grid = self._grid
        height, width = grid.cells.shape
        info = self._new(
            "nav_msgs/msg/MapMetaData", map_load_time=self._time(stamp), resolution=grid.resolution, width=width,
            height=height, origin=self._pose(Pose2(grid.x0, grid.y0, 0.0)),
        )  # fmt: skip
        return self._new(GRID, header=self._header(stamp, MAP), info=info, data=grid.cells.ravel().copy())

    def _static(self, stamp: int, mount: Mount) -> Any:
        return self._tf(stamp, BASE, LASER, Pose2(mount.x, mount.y, mount.yaw))

    def _tf(self, stamp: int, parent: str, child: str, pose: Pose2) -> Any:
        transform = self._new(
            "geometry_msgs/msg/Transform", translation=self._vector(pose.x, pose.y), rotation=self._turn(pose.yaw)
        )
        stamped = self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp, parent),
            child_frame_id=child,
            transform=transform,
        )
        return self._new(TF, transforms=[stamped])

    def _posed(self, stamp: int, pose: Pose2) -> Any:
        return self._new(POSE, header=self._header(stamp, MAP), pose=self._pose(pose))

    def _pose(self, pose: Pose2) -> Any:
        place = self._new("geometry_msgs/msg/Point", x=pose.x, y=pose.y, z=0.0)
        return self._new("geometry_msgs/msg/Pose", position=place, orientation=self._turn(pose.yaw))

    def _turn(self, yaw: float) -> Any:
        return self._new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sin(yaw / 2), w=cos(yaw / 2))

    def _vector(self, x: float, y: float, z: float = 0.0) -> Any:
        return self._new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))


def _six(covariance: Float64s) -> Float64s:
    """(36,) of ROS from (9,) of x, y, yaw."""
    out = np.zeros((6, 6))
    out[np.ix_(SIX, SIX)] = covariance.reshape(3, 3)
    return out.ravel()
