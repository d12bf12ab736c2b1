# SPDX-License-Identifier: Apache-2.0
"""What the app may send: JSON in the shapes of its Publish, 3D and Teleop panels, checked to the last number."""

import json
from dataclasses import dataclass
from math import atan2, hypot, isfinite
from typing import Any, Literal

from shared.geometry import Pose2
from zenav.foxglove.scene import MAP

InboundKind = Literal["goal", "pose", "teleop"]

TOPICS: dict[str, InboundKind] = {
    "/goal": "goal",
    "/goal_pose": "goal",
    "/move_base_simple/goal": "goal",
    "/initialpose": "pose",
    "/teleop": "teleop",
    "/cmd_vel": "teleop",
}
"""The names that the 3D panel, its like in ROS 1 and ROS 2, and the Teleop panel propose."""
SCHEMAS: dict[InboundKind, tuple[str, ...]] = {
    "goal": ("geometry_msgs/PoseStamped", "foxglove.PoseInFrame"),
    "pose": ("geometry_msgs/PoseWithCovarianceStamped", "geometry_msgs/PoseStamped", "foxglove.PoseInFrame"),
    "teleop": ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"),
}
MAX_MESSAGE_BYTES = 64 * 1024  # of a message: a pose with its covariance is 1 kB
MAX_COORDINATE_M = 1e6  # farther out than any map
MAX_SPEED, MAX_TURN_RATE = 20.0, 50.0  # m/s, rad/s: shared/messages.py
TILTED = 0.1  # of a quaternion's x and y, and of its length off 1: about 11 degrees


class InvalidMessageError(ValueError):
    """What was sent cannot be taken; the text says why, for people."""


@dataclass(frozen=True, slots=True)
class Inlet:
    """A channel that a client has announced."""

    topic: str
    what: InboundKind
    schema: str


def inlet_of(topic: str, encoding: str, schema_name: str) -> Inlet:
    """What a client's channel is for. Raises RefusedError where it is for nothing here."""
    what = TOPICS.get(topic)
    if what is None:
        raise InvalidMessageError(f"nothing listens on {topic}: send to one of {', '.join(TOPICS)}")
    if encoding != "json":
        raise InvalidMessageError(f"{topic} takes json, not {encoding}")
    name = schema_name.replace("/msg/", "/")
    if name not in SCHEMAS[what]:
        raise InvalidMessageError(
            f"{topic} takes {' or '.join(SCHEMAS[what])}, not {schema_name or 'a message without schema'}"
        )
    return Inlet(topic, what, name)


def pose_from(inlet: Inlet, data: bytes) -> Pose2:
    """The pose in `map`. Raises RefusedError."""
    tree = _tree(inlet, data)
    frame = (
        tree.get("frame_id") if inlet.schema.startswith("foxglove.") else _part(inlet, tree, "header").get("frame_id")
    )
    if frame != MAP:
        raise InvalidMessageError(
            f"{inlet.topic}: a pose in frame {frame!r}: give it in {MAP!r} (the 3D panel's display frame)"
        )
    pose = _part(inlet, tree, "pose")
    if "Covariance" in inlet.schema:
        pose = _part(inlet, pose, "pose")
    position, turn = _part(inlet, pose, "position"), _part(inlet, pose, "orientation")
    x, y = (_number(inlet, position, axis) for axis in "xy")
    if max(abs(x), abs(y)) > MAX_COORDINATE_M:
        raise InvalidMessageError(f"{inlet.topic}: ({x:g}, {y:g}) is farther out than any map")
    qx, qy, qz, qw = (_number(inlet, turn, axis) for axis in "xyzw")
    if hypot(qx, qy) > TILTED or abs(hypot(qx, qy, qz, qw) - 1) > TILTED:
        raise InvalidMessageError(f"{inlet.topic}: its orientation is no turn about the vertical")
    return Pose2(x, y, 2 * atan2(qz, qw) if qw >= 0 else 2 * atan2(-qz, -qw))


def velocity_from(inlet: Inlet, data: bytes) -> tuple[float, float]:
    """m/s forward and rad/s. Raises RefusedError."""
    tree = _tree(inlet, data)
    if inlet.schema.endswith("Stamped"):
        tree = _part(inlet, tree, "twist")
    linear, angular = _part(inlet, tree, "linear"), _part(inlet, tree, "angular")
    v, w = _number(inlet, linear, "x"), _number(inlet, angular, "z")
    if any(_number(inlet, part, axis, 0.0) for part, axes in ((linear, "yz"), (angular, "xy")) for axis in axes):
        raise InvalidMessageError(
            f"{inlet.topic}: this robot drives forward (linear.x) and turns (angular.z), nothing else"
        )
    if abs(v) > MAX_SPEED or abs(w) > MAX_TURN_RATE:
        raise InvalidMessageError(f"{inlet.topic}: {v:g} m/s, {w:g} rad/s is faster than any robot")
    return v, w


def _tree(inlet: Inlet, data: bytes) -> dict[str, Any]:
    if len(data) > MAX_MESSAGE_BYTES:
        raise InvalidMessageError(f"{inlet.topic}: a message of {len(data)} bytes")
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        raise InvalidMessageError(f"{inlet.topic}: not JSON") from None
    if not isinstance(tree, dict):
        raise InvalidMessageError(f"{inlet.topic}: not a JSON object")
    return tree


def _part(inlet: Inlet, tree: dict[str, Any], name: str) -> dict[str, Any]:
    part = tree.get(name)
    if not isinstance(part, dict):
        raise InvalidMessageError(f"{inlet.topic}: no {name!r}: that is no {inlet.schema}")
    return part


def _number(inlet: Inlet, tree: dict[str, Any], name: str, missing: float | None = None) -> float:
    value: Any = tree.get(name, missing)
    if type(value) not in (int, float):
        raise InvalidMessageError(f"{inlet.topic}: {name} is no number")
    try:
        number = float(value)
    except OverflowError:
        number = float("inf")
    if not isfinite(number):
        raise InvalidMessageError(f"{inlet.topic}: {name} is not finite")
    return number
