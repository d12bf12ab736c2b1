# SPDX-License-Identifier: Apache-2.0
"""The core of the bridge, with the events of a shell and what it answers to them."""

from typing import Any

import msgpack
import numpy as np

from services.ros2.config import Ros2Config
from services.ros2.ros_types import RosTypes, ros_types
from services.ros2.service import Ros2Service
from shared import topics
from shared.codec import decode
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Message, NavState, NavStatus, PortState, SerialData
from shared.requests import REQUESTS
from shared.robot import ImuMount
from shared.ros_messages import RosMessages
from shared.service import Log, Out
from shared.topics import Publication

START = 1_000_000_000_000
GOAL = bytes(range(16))


class Core:
    """A bridge whose router is there. `now` (ns) advances by a tenth of a second with each event."""

    def __init__(self, robot: str = "x80sv", imu_mount: ImuMount | None = None, **section: Any) -> None:
        self.config = Ros2Config(**section)
        self.service = Ros2Service(self.config, load_robot(robot).robot.model_copy(update={"imu": imu_mount}))
        self.service.name = "ros2"
        self.service.now = START
        self.types: RosTypes = ros_types(self.config.distro)
        self.make = RosMessages(self.types.types, self.config.ros_frames)
        self.lines: list[str] = []
        self.opening = self.take(self.service.port_state(PortState(START, "ros", True, "")))

    def take(self, out: Out) -> list[Any]:
        """The stack's messages, and the orders to the shell as maps. Lines of the log are kept in `lines`."""
        found: list[Any] = []
        for item in out:
            if isinstance(item, Log):
                self.lines.append(item.text)
            elif isinstance(item, Publication) and item.topic is topics.TX:
                found.append(msgpack.unpackb(item.message.data))
            elif isinstance(item, Publication):
                found.append(item.message)
        return found

    def event(self, **fields: Any) -> list[Any]:
        self.service.now += 100_000_000
        return self.take(self.service.receive(SerialData(self.service.now, "ros", msgpack.packb(fields))))

    def message(self, name: str, message: Any, gid: bytes = GOAL, delay: float = 0.0) -> list[Any]:
        """delay: s from its publisher to here. The publisher's clock is an hour behind."""
        data, came = self.types.encode(message), self.service.now + 100_000_000
        times = {"sent": came - round((3600 + delay) * 1e9), "came": came}
        return self.event(event="message", name=name, type=message.__msgtype__, data=data, gid=gid, **times)

    def request(self, name: str, number: int, request: Any) -> list[Any]:
        return self.event(event="request", name=name, id=number, data=self.types.encode(request))

    def outcome(self, order: dict[str, Any], accepted: bool = True, task_id: int = 7) -> list[Any]:
        fields = {"accepted": accepted, "reason": "" if accepted else "goal_blocked", "detail": "", "hint": ""}
        return self.event(event="outcome", id=order["id"], data={"task_id": task_id}, **fields)

    def status(self, state: NavState, task_id: int = 7, reason: str = "", waypoint: int = 0) -> list[Any]:
        self.service.now += 100_000_000
        status = NavStatus(self.service.now, task_id, state, "", reason, "", Pose2(1, 2, 0), 3.5, 7.25, waypoint, 3, 1)
        return self.take(self.service.nav_status(status))

    def tick(self, seconds: float) -> list[Any]:
        self.service.now += round(seconds * 1e9)
        return self.take(self.service.drive())

    def asked(self, order: dict[str, Any]) -> Message:
        """The request to the stack in an order."""
        row = next(row for row in REQUESTS if row.key == order["ask"])
        return decode(row.request, order["payload"])[0]

    def response(self, order: dict[str, Any], type_: str) -> Any:
        return self.types.decode(order["data"], f"{type_}_Response")

    def pose(self, pose: Pose2, frame: str = "map") -> Any:
        return self.make.posed(0, pose, frame)

    def trigger(self) -> Any:
        return self.make.new("std_srvs/srv/Trigger_Request", structure_needs_at_least_one_member=0)

    def uuid(self, goal: bytes = GOAL) -> Any:
        return self.make.new("unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(goal, np.uint8))

    def send_goal(self, action: str, type_: str, number: int = 1, goal: bytes = GOAL, **fields: Any) -> list[Any]:
        part = self.make.new(f"{type_}_Goal", **fields)
        request = self.make.new(f"{type_}_SendGoal_Request", goal_id=self.uuid(goal), goal=part)
        return self.request(f"{action}/_action/send_goal", number, request)

    def get_result(self, action: str, type_: str, number: int, goal: bytes = GOAL) -> list[Any]:
        request = self.make.new(f"{type_}_GetResult_Request", goal_id=self.uuid(goal))
        return self.request(f"{action}/_action/get_result", number, request)

    def cancel(self, action: str, number: int, goal: bytes = bytes(16), sec: int = 0) -> list[Any]:
        stamp = self.make.time(sec * 10**9)
        info = self.make.new("action_msgs/msg/GoalInfo", goal_id=self.uuid(goal), stamp=stamp)
        request = self.make.new("action_msgs/srv/CancelGoal_Request", goal_info=info)
        return self.request(f"{action}/_action/cancel_goal", number, request)
