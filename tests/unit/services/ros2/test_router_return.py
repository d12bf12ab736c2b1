# SPDX-License-Identifier: Apache-2.0
"""The router of the ROS 2 nodes goes and comes back: subscribers, publishers, services and latched values are back."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from zenoh.ext import HistoryConfig, declare_advanced_subscriber

from services.ros2.rmw_names import endpoint_of
from shared import sample_messages, topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Message
from shared.runners.client import Client
from tests.unit.services.ros2.network import LIMIT_S, ROBOT, Bridge, RosPeer, free_port, repeated, router, session
from zenav.stack.launch import free_stack

LASER = load_robot(ROBOT).robot.laser
SCAN, POSE, TF = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
AGAIN = {"connect/retry": {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1}}


class Network:
    """A bridge, the stack that a test plays, and a node. The router between them can be restarted.

    The stack is a service in the bridge's eyes: the sessions of two tools have no link to each other.
    """

    def __init__(self, bridge: Bridge, stack: Client, peer: RosPeer, restart: Callable[[], None]) -> None:
        self.bridge, self.stack, self.peer, self.restart = bridge, stack, peer, restart

    def assert_scan_goes_out(self) -> None:
        self.peer.received.clear()

        def scan():
            return topics.SCAN(sample_messages.scan(self.stack.now(), LASER))

        repeated(self.stack, scan, lambda s: self.peer.wait(SCAN, limit=s))

    def assert_comes_in(self, name: str, message: Message) -> None:
        self.bridge.events.clear()
        for number in range(100):
            self.peer.publish(name, message, number)
            try:
                self.bridge.wait(lambda: any(row.get("name") == name for row in self.bridge.events), 0.1)
            except AssertionError:
                continue
            return
        pytest.fail(f"no {name}")


@contextmanager
def network() -> Iterator[Network]:
    port = free_port()
    current = router(port)
    current.__enter__()

    def restart() -> None:
        nonlocal current
        current.__exit__(None, None, None)
        bridge.wait(lambda: not bridge.states[-1][0])
        current = router(port)
        current.__enter__()
        bridge.wait_open()

    try:
        with free_stack() as claim, Client(ROBOT, claim.where, instead_of="mapper") as stack:
            bridge = Bridge(port, claim.where)
            bridge.device.start()
            try:
                bridge.wait_open()
                with session("client", port, **AGAIN) as opened:
                    yield Network(bridge, stack, RosPeer(opened, bridge.types), restart)
            finally:
                bridge.device.close()
    finally:
        current.__exit__(None, None, None)


def test_after_each_restart_messages_go_out_and_come_in_again():
    with network() as net:
        make = net.bridge.make
        net.peer.subscribe("/scan", SCAN)
        for n_restarts in range(3):
            if n_restarts:
                net.restart()
            net.assert_scan_goes_out()
            net.assert_comes_in("/cmd_vel", make.twist(0.25, 0.0))
            net.assert_comes_in("/goal_pose", make.posed(0, Pose2(1.0, 2.0, 0.0), "map"))


def test_after_a_restart_a_new_node_finds_everything_and_gets_what_was_latched_before():
    with network() as net:
        types = net.bridge.types
        before = net.peer.tokens()
        net.bridge.order(publish="/tf_static", data=types.encode(net.bridge.make.transforms()))
        net.restart()
        net.bridge.wait(lambda: net.peer.tokens() == before)
        assert "/scan" in {endpoint.topic.name for endpoint in map(endpoint_of, before) if endpoint is not None}
        found = threading.Event()
        history = HistoryConfig(detect_late_publishers=True, max_samples=1)
        key = net.peer.key("/tf_static", TF)
        subscriber = declare_advanced_subscriber(net.peer.session, key, lambda sample: found.set(), history=history)
        assert found.wait(LIMIT_S)
        subscriber.undeclare()


def test_after_a_restart_a_service_replies():
    with network() as net:
        types = net.bridge.types
        net.restart()
        request = types.new("std_srvs/srv/Trigger_Request", structure_needs_at_least_one_member=0)
        response = types.new("std_srvs/srv/Trigger_Response", success=True, message="yes")

        def answer() -> None:
            number = net.bridge.wait_event("request")["id"]
            net.bridge.order(reply=number, data=types.encode(response))

        thread = threading.Thread(target=answer)
        thread.start()
        received, _ = net.peer.call("/estop", "std_srvs/srv/Trigger", request)
        thread.join()
        assert received.message == "yes"
