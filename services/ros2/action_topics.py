# SPDX-License-Identifier: Apache-2.0
"""The actions that our node has, and the topics and services that each consists of.

Source: rcl_action, rcl_action/src/names.c, default_qos.h; design.ros2.org/articles/actions.html.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from services.ros2.rmw_names import Durability, Qos
from services.ros2.ros_types import ACTIONS, Distro

STATUS_TYPE, CANCEL_TYPE = "action_msgs/msg/GoalStatusArray", "action_msgs/srv/CancelGoal"
STATUS_QOS = Qos(durability=Durability.TRANSIENT_LOCAL, depth=1)
FEEDBACK_QOS = Qos(depth=10)
SEND_GOAL, GET_RESULT, CANCEL_GOAL = "send_goal", "get_result", "cancel_goal"


@dataclass(frozen=True, slots=True)
class Action:
    """An action. name: as /navigate_to_pose.  type: as nav2_msgs/action/NavigateToPose."""

    name: str
    type: str

    @property
    def kind(self) -> str:
        """As NavigateToPose."""
        return self.type.rpartition("/")[2]

    def part(self, part: str) -> str:
        """The name of one of its topics and services."""
        return f"{self.name}/_action/{part}"


NAMES = {
    "nav2_msgs/action/NavigateToPose": "/navigate_to_pose",
    "nav2_msgs/action/NavigateThroughPoses": "/navigate_through_poses",
    "nav2_msgs/action/FollowWaypoints": "/follow_waypoints",
    "nav2_msgs/action/Spin": "/spin",
    "nav2_msgs/action/BackUp": "/backup",
    "nav2_msgs/action/DriveOnHeading": "/drive_on_heading",
}
"""The names in Nav2."""


def actions_of(distro: Distro) -> tuple[Action, ...]:
    """The actions of a distribution."""
    return tuple(Action(NAMES[type_], type_) for type_ in ACTIONS[distro])


def action_topics(distro: Distro) -> "Iterator[ActionTopic]":
    """The topics that our node publishes for its actions."""
    for action in actions_of(distro):
        yield ActionTopic(action.part("feedback"), f"{action.type}_FeedbackMessage", FEEDBACK_QOS)
        yield ActionTopic(action.part("status"), STATUS_TYPE, STATUS_QOS)


def action_services(distro: Distro) -> Iterator[tuple[str, str]]:
    """Name and type of the services of its actions."""
    for action in actions_of(distro):
        yield action.part(SEND_GOAL), f"{action.type}_SendGoal"
        yield action.part(GET_RESULT), f"{action.type}_GetResult"
        yield action.part(CANCEL_GOAL), CANCEL_TYPE


@dataclass(frozen=True, slots=True)
class ActionTopic:
    """A topic of an action."""

    name: str
    type: str
    qos: Qos
