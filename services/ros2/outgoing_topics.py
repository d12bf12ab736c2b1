# SPDX-License-Identifier: Apache-2.0
"""The topics that ROS 2 nodes see: name, type, quality of service, and the stack's topics that each is made from.

Sensor data is reliable, so that any subscription matches; maps are latched (REP 2003). Others are as Nav2's.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from services.ros2 import outgoing_markers as markers
from services.ros2 import outgoing_messages as outgoing
from services.ros2.outgoing_map import GRID_UPDATE, OutgoingMap
from services.ros2.rmw_names import Durability, Qos, Reliability
from shared import messages as m
from shared import requests, topics
from shared.geometry import Pose2
from shared.requests import Reply, Request, Watch
from shared.ros_messages import GRID, ODOM, PATH, POSE_COVARIANCE, SCAN, TF, RosMessages
from shared.topics import Topic

DEFAULT, SENSOR = Qos(depth=10), Qos(depth=5)
LATCHED = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)
LOG_QOS = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1000)  # rcl's of /rosout
TF_QOS = Qos(depth=100)  # tf2_ros' DynamicBroadcasterQoS
CLOCK_QOS = Qos(Reliability.BEST_EFFORT, depth=1)  # rclcpp's ClockQoS
MAX_ROBOT_POSES = 50  # of which one is the stack's odometry's, which comes a little later
MAP_NAME, PLACES_NAME = "/map", "/places"
WatchRequest = Request[Watch, Reply]
WATCHED: dict[str, WatchRequest] = {
    topics.COSTMAP.key: requests.WATCH,
    topics.ROLLOUTS.key: requests.WATCH,
    topics.MOVING.key: requests.WATCH,
    topics.GLOBAL_COSTMAP.key: requests.WATCH_GLOBAL_COSTMAP,
}
"""Keys of debug topics, which are published only while they are asked for, and the request of each."""


class OutgoingState:
    """What the messages of ROS need of earlier ones of the stack. map_interval: ns between two whole maps.

    robot_odom: the frame of a robot that publishes `odom -> base_link` itself; empty for others. That of `make` is the
    stack's then, and has another name.
    """

    def __init__(self, make: RosMessages, map_interval: int, robot_odom: str = "") -> None:
        self.make, self.robot_odom = make, robot_odom
        self.map = OutgoingMap(make, map_interval)
        self.map_from_odom: Pose2 | None = None
        self.odometry: m.Odometry | None = None  # the newest
        self.robot_poses: dict[int, Pose2] = {}  # the newest ones of the base in `robot_odom`, by stamp, ns
        self.map_name: str | None = None  # of the saved map in use; empty: it is not saved; None: not known yet


Make = Callable[[OutgoingState, Any, str], Any]
"""A message of ROS, or None, from the state, a message of the stack and its publisher."""


@dataclass(frozen=True, slots=True)
class OutgoingTopic:
    """One row. sources: topics of the stack."""

    name: str
    type: str
    qos: Qos
    sources: tuple[Topic[Any], ...]
    make: Make


def _transforms(state: OutgoingState, message: m.Odometry | m.PoseEstimate | m.BaseOdometry, _: str) -> Any:
    """All moving transforms at the rate and with the stamp of odometry: tf2 finds `map` at any time of `odom`."""
    make, frames = state.make, state.make.frames
    if isinstance(message, m.PoseEstimate):
        state.map_from_odom = message.map_from_odom
        return None
    if state.robot_odom:
        return _transforms_beside_robot(state, message)
    if isinstance(message, m.BaseOdometry):
        return None
    stamped = [make.transform(message.stamp, frames.odom, frames.base, message.odom_from_base)]
    if state.map_from_odom is not None:
        stamped.insert(0, make.transform(message.stamp, frames.map, frames.odom, state.map_from_odom))
    return make.transforms(*stamped)


def _transforms_beside_robot(state: OutgoingState, message: m.Odometry | m.BaseOdometry) -> Any:
    """From `map` to the robot's own `odom` and to the stack's, where both have a pose of the same stamp.

    They differ: the stack's has a scale and the gyro's heading, and goes on where the robot's counts from 0 again.
    """
    if isinstance(message, m.BaseOdometry):
        state.robot_poses[message.stamp] = message.odom_from_base
        if len(state.robot_poses) > MAX_ROBOT_POSES:
            del state.robot_poses[next(iter(state.robot_poses))]
    else:
        state.odometry = message
    odometry, map_from_odom = state.odometry, state.map_from_odom
    if odometry is None or map_from_odom is None:
        return None
    robot_pose = state.robot_poses.get(odometry.stamp)
    if robot_pose is None or message.stamp != odometry.stamp:
        return None
    make, stamp = state.make, odometry.stamp
    map_from_robot_odom = map_from_odom @ odometry.odom_from_base @ robot_pose.inverse()
    return make.transforms(
        make.transform(stamp, make.frames.map, state.robot_odom, map_from_robot_odom),
        make.transform(stamp, make.frames.map, make.frames.odom, map_from_odom),
    )


def _whole_map(state: OutgoingState, update: m.MapUpdate, _: str) -> Any:
    """The map is sent when it is due, not with each of its tiles."""
    return None


def _map_change(state: OutgoingState, update: m.MapUpdate, _: str) -> Any:
    return state.map.change()


def _map_name(state: OutgoingState, map_state: m.MapState, _: str) -> Any:
    """The places are those of the saved map: they are read from its files, and sent then."""
    state.map_name = map_state.name


def _costmap(make: RosMessages, costmap: m.Costmap, frame: str) -> Any:
    return make.grid(costmap.cells, costmap.resolution, (costmap.x, costmap.y), costmap.stamp, frame)


def _simply(make: Callable[[RosMessages, Any], Any]) -> Make:
    return lambda state, message, publisher: make(state.make, message)


# fmt: off
OUTGOING = (
    OutgoingTopic("/scan", SCAN, SENSOR, (topics.SCAN,), _simply(RosMessages.scan)),
    OutgoingTopic("/scan_2", SCAN, SENSOR, (topics.SCAN_2,), lambda state, scan, _: state.make.scan(scan, 1)),
    OutgoingTopic("/odom", ODOM, DEFAULT, (topics.ODOM,), _simply(RosMessages.odometry)),
    OutgoingTopic("/tf", TF, TF_QOS, (topics.POSE, topics.ODOM, topics.BASE_MOTION), _transforms),
    OutgoingTopic("/map", GRID, LATCHED, (topics.MAP,), _whole_map),
    OutgoingTopic("/map_updates", GRID_UPDATE, DEFAULT, (topics.MAP,), _map_change),
    OutgoingTopic("/amcl_pose", POSE_COVARIANCE, LATCHED, (topics.POSE,), _simply(RosMessages.pose_estimate)),
    OutgoingTopic("/plan", PATH, DEFAULT, (topics.PLAN,), _simply(RosMessages.path)),
    OutgoingTopic("/local_plan", PATH, DEFAULT, (topics.ROLLOUTS,), _simply(outgoing.local_plan)),
    OutgoingTopic("/local_costmap/costmap", GRID, LATCHED, (topics.COSTMAP,), _simply(lambda make, costmap: _costmap(make, costmap, make.frames.odom))),  # noqa: E501
    OutgoingTopic("/global_costmap/costmap", GRID, LATCHED, (topics.GLOBAL_COSTMAP,), _simply(lambda make, costmap: _costmap(make, costmap, make.frames.map))),  # noqa: E501
    OutgoingTopic("/battery_state", "sensor_msgs/msg/BatteryState", DEFAULT, (topics.BASE_STATUS,), _simply(outgoing.battery)),  # noqa: E501  # a table
    OutgoingTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", DEFAULT, (topics.GUARD, topics.NAV_STATUS, topics.BASE_STATUS, topics.HEALTH), _simply(outgoing.diagnostics)),  # noqa: E501
    OutgoingTopic("/rosout", "rcl_interfaces/msg/Log", LOG_QOS, (topics.LOG,), lambda state, line, publisher: outgoing.log_line(state.make, line, publisher)),  # noqa: E501
    OutgoingTopic("/clock", "rosgraph_msgs/msg/Clock", CLOCK_QOS, (topics.CLOCK,), lambda state, tick, _: outgoing.clock(state.make, tick.stamp)),  # noqa: E501
    OutgoingTopic("/zones", markers.MARKERS, LATCHED, (topics.ZONES,), _simply(markers.zone_markers)),
    OutgoingTopic(PLACES_NAME, markers.MARKERS, LATCHED, (topics.MAP_STATE,), _map_name),
    OutgoingTopic("/dynamic_obstacles", markers.MARKERS, DEFAULT, (topics.MOVING,), _simply(markers.obstacle_markers)),
)
# fmt: on
STATIC_TF = OutgoingTopic("/tf_static", TF, LATCHED, (), lambda state, message, publisher: None)
"""The core sends it once: it is of the robot's configuration."""


def keys_of(names: frozenset[str]) -> frozenset[str]:
    """The stack's keys (without the robot's name) that these topics need; of families each publisher's."""
    return frozenset(
        key for row in OUTGOING if row.name in names for topic in row.sources for key in source_keys(topic)
    )


def source_keys(topic: Topic[Any]) -> tuple[str, ...]:
    """The keys of a topic of the stack."""
    return tuple(f"{topic.key}/{name}" for name in topic.publishers) if topic.by == "*" else (topic.key,)


def converted(
    state: OutgoingState, names: frozenset[str], topic: Topic[Any], message: m.Message, publisher: str
) -> Iterator[tuple[str, Any]]:
    """Name and message of ROS, for each of these topics that a message of the stack changes."""
    if isinstance(message, m.MapUpdate):
        state.map.add(message)
    for row in OUTGOING:
        if row.name in names and topic in row.sources:
            made = row.make(state, message, publisher)
            if made is not None:
                yield row.name, made
