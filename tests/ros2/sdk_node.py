# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node by zenoh-ros2-sdk, in an environment of its own: PORT X Y. It writes what it sees as JSON.

It knows nothing of our bridge. It sends the robot to (X, Y) in `map`, m.
"""

import json
import os
import sys
import threading

import numpy as np
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_service_names_and_types, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

STORE = get_typestore(Stores.ROS2_JAZZY)
LIMIT_S, DRIVE_LIMIT_S, NEAR_M = 20.0, 60.0, 0.35
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)


def definition(type_: str) -> dict[str, str]:
    """The options that give the SDK a definition without a network."""
    text, _ = STORE.generate_msgdef(type_, ros_version=2)
    return {"msg_definition": text, "type_hash": STORE.hash_rihs01(type_)}


class Listener:
    """The newest message of a topic."""

    def __init__(self, where: dict, name: str, type_: str, **options: object) -> None:
        self.message, self._came = None, threading.Event()
        self._subscriber = ROS2Subscriber(name, type_, self._hear, **definition(type_), **where, **options)

    def wait(self) -> object:
        assert self._came.wait(LIMIT_S), "no message"
        return self.message

    def _hear(self, message: object) -> None:
        self.message = message
        self._came.set()


def main() -> None:
    where = {"router_ip": "127.0.0.1", "router_port": int(sys.argv[1]), "domain_id": 0}
    seen = {"topics": dict(get_topic_names_and_types(**where, timeout=2.0))}
    seen["services"] = dict(get_service_names_and_types(**where, timeout=2.0))
    scan = Listener(where, "/scan", "sensor_msgs/msg/LaserScan").wait()
    seen["scan"] = {"frame": scan.header.frame_id, "beams": len(scan.ranges)}
    grid = Listener(where, "/map", "nav_msgs/msg/OccupancyGrid", qos=LATCHED).wait()
    late = Listener(where, "/map", "nav_msgs/msg/OccupancyGrid", qos=LATCHED).wait()
    cells = np.asarray(grid.data)
    seen["map"] = {"known": int((cells >= 0).sum()), "size": [grid.info.width, grid.info.height]}
    seen["late_map"] = [late.info.width, late.info.height]
    static = Listener(where, "/tf_static", "tf2_msgs/msg/TFMessage", qos=LATCHED).wait()
    seen["laser_parent"] = static.transforms[0].header.frame_id
    client = ROS2ServiceClient(
        "/pause", "std_srvs/srv/Trigger", request_definition="uint8 structure_needs_at_least_one_member",
        response_definition="bool success\nstring message", type_hash=TRIGGER_HASH, **where,
    )  # fmt: skip
    response = client.call(structure_needs_at_least_one_member=0)
    seen["pause"] = None if response is None else [bool(response.success), response.message]
    x, y = float(sys.argv[2]), float(sys.argv[3])
    send_goal(where, x, y)
    seen["distance"] = distance_after(where, x, y)
    sys.stdout.write("\nSEEN " + json.dumps(seen) + "\n")
    sys.stdout.flush()
    os._exit(0)  # Zenoh's threads are not daemons


def send_goal(where: dict, x: float, y: float) -> None:
    type_ = "geometry_msgs/msg/PoseStamped"
    publisher = ROS2Publisher("/goal_pose", type_, **definition(type_), **where)
    types = publisher.session_mgr.store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    point = types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    publisher.publish(
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="map"),
        pose=types["geometry_msgs/msg/Pose"](position=point, orientation=turn),
    )


def distance_after(where: dict, x: float, y: float) -> float:
    """m between the robot and the goal, once it is there or the time is over."""
    near, distance = threading.Event(), float("inf")

    def hear(message: object) -> None:
        nonlocal distance
        place = message.pose.pose.position
        distance = float(np.hypot(place.x - x, place.y - y))
        if distance < NEAR_M:
            near.set()

    type_ = "geometry_msgs/msg/PoseWithCovarianceStamped"
    ROS2Subscriber("/amcl_pose", type_, hear, **definition(type_), **where, qos=LATCHED)
    near.wait(DRIVE_LIMIT_S)
    return distance


main()
