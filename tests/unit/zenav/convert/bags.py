# SPDX-License-Identifier: Apache-2.0
"""Bags that tests write, by the `rosbags` package: messages are given as numbers, one call a message."""

from math import cos, sin

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from shared.ros_messages import GRID, ODOM, POSE, SCAN, TF
from shared.types import NS_PER_S
from zenav.convert.ros_messages import ECHOES, typestore

KINDS = "ros1", "ros1-lz4", "ros1-bz2", "mcap", "mcap-zstd", "mcap-file", "sqlite", "sqlite-messages"


class BagOf:
    """Collects messages for one ROS; `write` makes a file or folder of them."""

    def __init__(self, kind="mcap"):
        self.kind, self.rows = kind, []
        self.store = typestore(kind.startswith("ros1"))

    def new(self, type_, **fields):
        return self.store.types[type_](**fields)

    def header(self, stamp, frame):
        more = {"seq": 0} if self.kind.startswith("ros1") else {}
        time = self.new("builtin_interfaces/msg/Time", sec=stamp // NS_PER_S, nanosec=stamp % NS_PER_S)
        return self.new("std_msgs/msg/Header", stamp=time, frame_id=frame, **more)

    def add(self, topic, type_, message, received):
        self.rows.append((topic, type_, message, received))

    def scan(self, stamp, ranges, topic="/scan", frame="laser", received=None, angles=(-1.5, 0.1), **more):
        n = len(ranges)
        fields = {
            "angle_min": angles[0], "angle_increment": angles[1], "angle_max": angles[0] + (n - 1) * angles[1],
            "time_increment": 0.0, "scan_time": 0.0, "range_min": 0.05, "range_max": 30.0,
            "intensities": np.empty(0, np.float32),
        } | more  # fmt: skip
        message = self.new(SCAN, header=self.header(stamp, frame), ranges=np.asarray(ranges, np.float32), **fields)
        self.add(topic, SCAN, message, stamp if received is None else received)

    def echoes(self, stamp, beams, topic="/horizontal_laser"):
        """A sweep of which each beam came back some times, or never."""
        told = [self.new("sensor_msgs/msg/LaserEcho", echoes=np.array(beam, np.float32)) for beam in beams]
        message = self.new(
            ECHOES, header=self.header(stamp, "laser"), angle_min=0.0, angle_max=1.0, angle_increment=0.1,
            time_increment=0.0, scan_time=0.0, range_min=0.1, range_max=30.0, ranges=told, intensities=[],
        )  # fmt: skip
        self.add(topic, ECHOES, message, stamp)

    def grid(self, stamp, cells, origin, topic="/map"):
        """An occupancy grid of 0.05 m a cell; origin: x, y, yaw of its lower left corner."""
        height, width = cells.shape
        header = self.header(stamp, "map")
        info = self.new(
            "nav_msgs/msg/MapMetaData", map_load_time=header.stamp, resolution=0.05, width=width, height=height,
            origin=self.pose(*origin),
        )  # fmt: skip
        self.add(topic, GRID, self.new(GRID, header=header, info=info, data=cells.ravel().astype(np.int8)), stamp)

    def pose(self, x, y, yaw):
        place = self.new("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0)
        turn = self.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sin(yaw / 2), w=cos(yaw / 2))
        return self.new("geometry_msgs/msg/Pose", position=place, orientation=turn)

    def odom(self, stamp, x, y, yaw, topic="/odom", frames=("odom", "base_link"), received=None):
        vector = self.new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.new("geometry_msgs/msg/Twist", linear=vector, angular=vector)
        message = self.new(
            ODOM,
            header=self.header(stamp, frames[0]),
            child_frame_id=frames[1],
            pose=self.new("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(x, y, yaw), covariance=np.zeros(36)),
            twist=self.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self.add(topic, ODOM, message, stamp if received is None else received)

    def goal(self, stamp, x, y, topic):
        self.add(topic, POSE, self.new(POSE, header=self.header(stamp, "map"), pose=self.pose(x, y, 0)), stamp)

    def tf(self, stamp, parent, child, place=(0, 0, 0), quaternion=(0, 0, 0, 1), static=False, received=None):
        t = self.new("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, place))))
        q = self.new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, quaternion))))
        stamped = self.new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self.new("geometry_msgs/msg/Transform", translation=t, rotation=q),
        )
        topic = "/tf_static" if static else "/tf"
        self.add(topic, TF, self.new(TF, transforms=[stamped]), stamp if received is None else received)

    def write(self, path):
        """Returns the path: a file for ROS 1, a rosbag2 folder else."""
        if self.kind.startswith("ros1"):
            writer = Writer1(path)
            if "-" in self.kind:
                writer.set_compression(Writer1.CompressionFormat[self.kind[5:].upper()])
            serialize = self.store.serialize_ros1
        else:
            storage = StoragePlugin.MCAP if self.kind.startswith("mcap") else StoragePlugin.SQLITE3
            writer = Writer2(path, version=8, storage_plugin=storage)
            if self.kind == "mcap-zstd":
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            if self.kind == "mcap-file":
                writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
            if self.kind == "sqlite-messages":
                writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
            serialize = self.store.serialize_cdr
        with writer:
            connections = {}
            for topic, type_, message, received in self.rows:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, type_, typestore=self.store)
                writer.write(connections[topic], received, serialize(message, type_))
        return path


def file_of(path):
    """The bag's one file with messages in it."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.name != "metadata.yaml")


def small(kind="mcap", n=8, first=1_700_000_000 * NS_PER_S):
    """n scans of 16 beams, odometry at and between them, the laser 0.2 m ahead."""
    bag = BagOf(kind)
    bag.tf(first, "base_link", "laser", (0.2, 0, 0.3), static=True)
    for k in range(n):
        stamp = first + k * NS_PER_S // 5
        bag.odom(stamp, 0.1 * k, 0.01 * k, 0.02 * k)
        bag.tf(stamp, "odom", "base_link", (0.1 * k, 0.01 * k, 0), (0, 0, sin(0.01 * k), cos(0.01 * k)))
        bag.scan(stamp, 2 + 0.1 * np.arange(16) + 0.01 * k)
    return bag
