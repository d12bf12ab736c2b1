# SPDX-License-Identifier: Apache-2.0
"""What ROS 2 nodes may send: topics and services, and the content of their messages."""

from dataclasses import dataclass
from math import isfinite
from typing import Any

from services.ros2.rmw_names import Durability, Qos, Reliability
from shared.geometry import Pose2
from shared.ros_messages import POSE, POSE_COVARIANCE, pose2

TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
TRIGGER, GET_STATE = "std_srvs/srv/Trigger", "lifecycle_msgs/srv/GetState"
SAVE_MAP, LOAD_MAP = "nav2_msgs/srv/SaveMap", "nav2_msgs/srv/LoadMap"
MAX_SPEED, MAX_TURN_RATE = 20.0, 50.0  # m/s, rad/s: the bounds of shared/messages.py
GOAL_POSE, INITIAL_POSE, CMD_VEL = "/goal_pose", "/initialpose", "/cmd_vel"
ESTOP, RELEASE = "/estop", "/estop_release"
CLEAR_COSTMAP, CLEAR_AROUND, CLEAR_EXCEPT = (
    f"nav2_msgs/srv/Clear{what}" for what in ("EntireCostmap", "CostmapAroundRobot", "CostmapExceptRegion")
)
SAVE, LOAD = "/map_saver/save_map", "/map_server/load_map"


@dataclass(frozen=True, slots=True)
class IncomingTopic:
    """A topic that our node subscribes to."""

    name: str
    types: tuple[str, ...]
    qos: Qos


INCOMING = (
    IncomingTopic(GOAL_POSE, (POSE,), Qos(depth=10)),
    IncomingTopic(INITIAL_POSE, (POSE_COVARIANCE,), Qos(depth=10)),
    IncomingTopic(CMD_VEL, (TWIST, TWIST_STAMPED), Qos(Reliability.BEST_EFFORT, Durability.VOLATILE, 1)),
)
"""The velocity is best-effort: then publishers of either kind match (Nav2 and teleop_twist_joy are reliable)."""

TRIGGERS = tuple((name, TRIGGER) for name in (ESTOP, RELEASE, "/explore", "/cancel", "/pause", "/resume"))
"""Services, under the names that they have in Foxglove."""

CLEAR_SERVICES = tuple(
    (f"/{part}_costmap/{verb}_{part}_costmap", type_)
    for part in ("local", "global")
    for verb, type_ in (
        ("clear_entirely", CLEAR_COSTMAP),
        ("clear_around", CLEAR_AROUND),
        ("clear_except", CLEAR_EXCEPT),
    )
)
"""Those of the global costmap clear nothing: the planner's is made of the map and the zones."""

MAP_SERVICES = ((SAVE, SAVE_MAP), (LOAD, LOAD_MAP))

STATE_SERVICES = tuple(
    [(f"/{node}/get_state", GET_STATE) for node in ("amcl", "bt_navigator")]
    + [(f"/lifecycle_manager_{part}/is_active", TRIGGER) for part in ("navigation", "localization")]
)
"""Services by which Nav2's Simple Commander and RViz panel ask whether Nav2 is active. Here it is."""


def pose_in_map(header: Any, pose: Any, frame: str) -> Pose2:
    """The pose of a stamped message, which must be in `frame`. An empty frame is the map's, as in ROS tools.

    Raises ValueError where it is not.
    """
    given = str(header.frame_id).strip("/")
    if given not in ("", frame):
        raise ValueError(f"a pose in frame {given!r}: give it in {frame!r}")
    return pose2(pose)


def velocity(message: Any) -> tuple[float, float]:
    """m/s forward and rad/s of a Twist or TwistStamped; raises ValueError for any other motion."""
    twist = getattr(message, "twist", message)
    v, w = float(twist.linear.x), float(twist.angular.z)
    others = (twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y)
    if any(others):
        raise ValueError("this robot drives forward (linear.x) and turns (angular.z), nothing else")
    if not (isfinite(v) and isfinite(w) and abs(v) <= MAX_SPEED and abs(w) <= MAX_TURN_RATE):
        raise ValueError(f"{v:g} m/s, {w:g} rad/s is faster than any robot")
    return v, w
