# SPDX-License-Identifier: Apache-2.0
"""Messages of both sides of the bridge to ROS 2, for `zenav bench ros2`: the stack's, and a ROS 2 node's."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh

from services.ros2.rmw_names import Entity, Qos, RosName, RosNode
from services.ros2.ros_format import RmwZenohFormat
from services.ros2.ros_types import RosTypes
from shared import sample_messages, topics
from shared.config import Laser, load_robot
from shared.messages import LaserScan, Velocity
from shared.ros_messages import ODOM, SCAN, TF, RosFrames, RosMessages
from shared.topics import Publication
from shared.types import NS_PER_S
from zenav.client import Client

ROBOT, N_BEAMS = "x80sv", 720
TICK_S, TICKS_A_SCAN, TICKS_A_COMMAND = 0.02, 5, 5
TWIST = "geometry_msgs/msg/Twist"
GID = bytes(16)
N_MARKS = 1000


class Latencies:
    """Times of messages between their sending and their arrival: `ms`. A message is known by its mark."""

    def __init__(self) -> None:
        self.ms: list[float] = []
        self._sent: dict[Hashable, float] = {}

    def send(self, mark: Hashable) -> None:
        """The message is sent now."""
        self._sent[mark] = time.perf_counter()

    def arrive(self, mark: Hashable, at: float) -> None:
        """It came at `at` (s, of perf_counter). Marks that were not sent do not count."""
        if (sent := self._sent.pop(mark, None)) is not None:
            self.ms.append((at - sent) * 1e3)


class BridgeTraffic(ABC):
    """What both directions have in common: its publishers, and a tick 50 times a second."""

    def __init__(self, stack: Client, node: zenoh.Session, types: RosTypes) -> None:
        self.stack, self.node, self.types = stack, node, types
        self.make = RosMessages(types.types, RosFrames())
        self.scans, self.commands = Latencies(), Latencies()
        laser = load_robot(ROBOT).robot.laser
        self._laser: Laser = laser.model_copy(
            update={"n_beams": N_BEAMS, "angle_increment": 2 * np.pi / N_BEAMS, "angle_min": -np.pi}
        )
        self._format = RmwZenohFormat(0, "", "bench")
        self._n = 0

    def run(self, seconds: float) -> None:
        """Publishes for so long."""
        due = time.monotonic()
        for i in range(round(seconds / TICK_S)):
            self.tick(i)
            due += TICK_S
            threading.Event().wait(max(0.0, due - time.monotonic()))

    @abstractmethod
    def tick(self, i: int) -> None:
        """Publishes what is due."""

    def clear(self) -> None:
        """Forgets what was measured so far."""
        self.scans.ms.clear()
        self.commands.ms.clear()

    def say(self, publication: Publication) -> None:
        """Publishes in the place of the service that does so in the stack."""
        self.stack.publish(publication, publication.topic.publishers[0])

    def scan(self, stamp: int) -> LaserScan:
        """A scan. stamp: ns."""
        return replace(sample_messages.scan(stamp, self._laser), stamp=stamp)

    def next_mark(self) -> float:
        """A number between 0 and 1 that float32 keeps apart from the 1000 before it."""
        self._n += 1
        return 0.001 * (self._n % N_MARKS)

    def ros_name(self, name: str, type_: str) -> RosName:
        """A topic of ROS."""
        return RosName(name, type_, self.types.hash_of(type_))

    def subscribe(self, name: str, type_: str, hear: Any) -> Any:
        """A subscriber of the node. Keep it."""
        return self.node.declare_subscriber(self._format.key(self.ros_name(name, type_)), hear)

    def put(self, name: str, type_: str, message: Any) -> None:
        """Publishes as the node."""
        attachment = self._format.attachment(self._n + 1, time.time_ns(), GID)
        self.node.put(self._format.key(self.ros_name(name, type_)), self.types.encode(message), attachment=attachment)


class OutgoingTraffic(BridgeTraffic):
    """ROS 2 sees the robot: /scan, /odom and /tf go out 10 and 50 times a second, /cmd_vel comes in."""

    def __init__(self, stack: Client, node: zenoh.Session, types: RosTypes) -> None:
        super().__init__(stack, node, types)
        self._subscribers = [
            self.subscribe("/scan", SCAN, self._hear_scan),
            *(self.subscribe(name, type_, lambda sample: None) for name, type_ in (("/odom", ODOM), ("/tf", TF))),
        ]
        stack.listen(topics.TELEOP, lambda command, _: self.commands.arrive(_mark(command.w), time.perf_counter()))

    def tick(self, i: int) -> None:
        stamp = self.stack.now()
        self.say(topics.ODOM(sample_messages.odometry(stamp)))
        if i % TICKS_A_SCAN == 0:
            self.say(topics.POSE(sample_messages.pose_estimate(stamp)))
            self.scans.send(stamp)
            self.say(topics.SCAN(self.scan(stamp)))
        elif i % TICKS_A_COMMAND == 1:
            w = self.next_mark()
            twist = self.make.twist(0.0, w)
            self.commands.send(_mark(w))
            self.put("/cmd_vel", TWIST, twist)

    def _hear_scan(self, sample: zenoh.Sample) -> None:
        at = time.perf_counter()
        stamp = self.types.decode(sample.payload.to_bytes(), SCAN).header.stamp
        self.scans.arrive(stamp.sec * NS_PER_S + stamp.nanosec, at)


class DrivenTraffic(BridgeTraffic):
    """The robot is one with ROS 2: its /scan and /odom come in 10 and 50 times a second, /cmd_vel goes out 50 times."""

    def __init__(self, stack: Client, node: zenoh.Session, types: RosTypes) -> None:
        super().__init__(stack, node, types)
        self._subscriber = self.subscribe("/cmd_vel", TWIST, self._hear_command)
        robot = RosNode(0, str(node.info.zid()), "/", "robot")
        token = robot.endpoint_token(1, Entity.SUBSCRIPTION, self.ros_name("/cmd_vel", TWIST), Qos())
        self._token = node.liveliness().declare_token(token)
        stack.listen(topics.SCAN, lambda scan, _: self.scans.arrive(_mark(scan.ranges[0]), time.perf_counter()))

    def tick(self, i: int) -> None:
        now = time.time_ns()
        self.put("/odom", ODOM, self.make.odometry(sample_messages.odometry(now)))
        if i % TICKS_A_SCAN == 0:
            scan = self.scan(now)
            scan.ranges[0] = 1.0 + self.next_mark()
            message = self.make.scan(scan)
            self.scans.send(_mark(scan.ranges[0]))
            self.put("/scan", SCAN, message)
        w = 1e-3 + self.next_mark()  # never zero: a bridge need not repeat that
        self.commands.send(_mark(w))
        self.say(topics.VELOCITY(Velocity(self.stack.now(), 0.0, w, "")))

    def _hear_command(self, sample: zenoh.Sample) -> None:
        at = time.perf_counter()
        self.commands.arrive(_mark(self.types.decode(sample.payload.to_bytes(), TWIST).angular.z), at)


def _mark(value: float) -> int:
    """The mark of a number that passed through float32."""
    return round(float(value) * N_MARKS)
