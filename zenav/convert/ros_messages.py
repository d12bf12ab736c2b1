# SPDX-License-Identifier: Apache-2.0
"""ROS messages as the stack's: LaserScan, Odometry, poses, transforms. Layouts are those of the `rosbags` package.

Each raises ValueError where a message does not make sense.
"""

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shared.grid import update_of_cells
from shared.messages import MapUpdate, Odometry
from shared.ros_messages import GRID, ODOM, POSE, POSE_COVARIANCE, SCAN, TF, pose2
from shared.ros_readings import covariance
from zenav.convert.ros_files import RawMessage
from zenav.maps.rotated_map import axis_aligned

ECHOES, OLD_TF = "sensor_msgs/msg/MultiEchoLaserScan", "tf/msg/tfMessage"
WANTED = frozenset({SCAN, ECHOES, ODOM, TF, OLD_TF, POSE, POSE_COVARIANCE, GRID})

MAX_MAP_COORDINATE_M = 1e4


@cache
def typestore(ros1: bool) -> Any:
    """rosbags' knowledge of the standard messages; their layouts are the same in every ROS 2."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return store


def read(raw: RawMessage) -> Any:
    """A message of a bag, with the attributes that ROS gives it. Raises ValueError where the bytes are none."""
    store = typestore(raw.ros1)
    type_ = TF if raw.type == OLD_TF else raw.type
    try:
        return store.deserialize_ros1(raw.data, type_) if raw.ros1 else store.deserialize_cdr(raw.data, type_)
    except Exception as error:  # rosbags' generated code raises whatever damaged bytes make it
        raise ValueError(f"no {raw.type}: {error}") from None


def odometry(message: Any, stamp: int) -> Odometry:
    """Dead reckoning in the plane."""
    twist = message.twist.twist
    v, w = float(twist.linear.x), float(twist.angular.z)
    if not (abs(v) <= 20 and abs(w) <= 50):
        v = w = 0.0  # the pose counts; speeds are often not filled in
    return Odometry(stamp, pose2(message.pose.pose), v, w, covariance(message.pose.covariance))


def occupancy(message: Any, stamp: int) -> MapUpdate:
    """A whole map; one that is turned is turned back."""
    info, origin = message.info, pose2(message.info.origin)
    height, width, resolution = int(info.height), int(info.width), float(info.resolution)
    cells = np.asarray(message.data, np.int8)
    if not 0.005 <= resolution <= 1 or height * width != len(cells) or not len(cells):
        raise ValueError("a map of no cells")
    cells = np.where((cells < 0) | (cells > 100), -1, cells).astype(np.int8).reshape(height, width)
    x0, y0 = origin.x, origin.y
    if abs(origin.yaw) > 1e-6:
        cells, x0, y0 = axis_aligned(cells, resolution, x0, y0, origin.yaw)
    if max(abs(x0), abs(y0), resolution * max(cells.shape)) > MAX_MAP_COORDINATE_M:
        raise ValueError("a map that is too far away")
    update = update_of_cells(cells, round(resolution, 9), x0, y0, stamp)
    if (problem := update.problem()) is not None:
        raise ValueError(problem)
    return update
