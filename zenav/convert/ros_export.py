# SPDX-License-Identifier: Apache-2.0
"""The stack's messages as a ROS bag, by the `rosbags` package. Frames are REP 105's: map, odom, base_link; laser.

A beam without an echo is +inf (REP 117). The laser's mount goes into /tf_static, odometry and the map's correction into
/tf, as they do on a robot with ROS.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Literal

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

from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, MapUpdate, Message, Odometry, Path, PoseEstimate, Truth
from shared.ros_messages import GRID, ODOM, PATH, POSE, POSE_COVARIANCE, SCAN, TF, RosFrames, RosMessages
from zenav.convert.conversion import Conversion
from zenav.convert.ros_messages import typestore

FRAMES = RosFrames()
TYPES = {
    "/scan": SCAN, "/odom": ODOM, "/pose": POSE_COVARIANCE, "/map": GRID, "/plan": PATH, "/ground_truth": POSE,
    "/tf": TF, "/tf_static": TF,
}  # fmt: skip
LATCHED = "/map", "/tf_static"
MAP_EVERY = 5_000_000_000  # ns between whole maps, as slam_toolbox has it
VERSION: Literal[8] = 8  # of rosbag2's metadata: what ROS 2 Humble to Kilted read
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
    """Makes the messages of a bag of one ROS: ROS 1's headers have a number more."""

    def __init__(self, ros1: bool) -> None:
        self.store = typestore(ros1)
        self._make = RosMessages(self.store.types, FRAMES, {"seq": 0} if ros1 else {})
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
                yield "/tf_static", stamp, self._make.transforms(self._make.mount(stamp, content.mount))
                first = False
            yield from ((topic, stamp, converted) for topic, converted in self._of(key, message))
        if self._map_waits is not None:
            yield "/map", stamp, self._make.occupancy(self._grid, self._map_waits.stamp)

    def _of(self, key: str, message: Message) -> Iterator[tuple[str, Any]]:
        make = self._make
        if isinstance(message, LaserScan):
            yield "/scan", make.scan(message)
        elif isinstance(message, Odometry):
            yield "/odom", make.odometry(message)
            yield "/tf", self._tf(message.stamp, FRAMES.odom, FRAMES.base, message.odom_from_base)
        elif isinstance(message, PoseEstimate):
            yield "/pose", make.pose_estimate(message)
            yield "/tf", self._tf(message.stamp, FRAMES.map, FRAMES.odom, message.map_from_odom)
        elif isinstance(message, Truth):
            map_from_base = message.start.inverse() @ message.world_from_base
            yield "/ground_truth", make.posed(message.stamp, map_from_base, FRAMES.map)
        elif isinstance(message, Path):
            yield "/plan", make.path(message)
        elif isinstance(message, MapUpdate):
            self._grid.apply(message)
            self._map_waits = message
            if message.stamp >= self._map_due:
                self._map_due, self._map_waits = message.stamp + MAP_EVERY, None
                yield "/map", make.occupancy(self._grid, message.stamp)

    def _tf(self, stamp: int, parent: str, child: str, pose: Pose2) -> Any:
        return self._make.transforms(self._make.transform(stamp, parent, child, pose))
