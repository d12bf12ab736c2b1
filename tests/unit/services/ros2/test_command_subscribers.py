# SPDX-License-Identifier: Apache-2.0
"""Of both types of velocity the robot's own goes out, as its tokens say, whenever they come and go."""

import threading
from contextlib import suppress

import pytest
import zenoh

from services.ros2.rmw_names import Entity, Qos, RosName, RosNode, endpoint_of
from services.ros2.robot_input import COMMAND, COMMAND_TYPES, STAMPED_COMMAND
from services.ros2.ros_types import Distro, ros_types
from shared.ros_messages import RosFrames, RosMessages
from tests.unit.services.ros2.network import LIMIT_S, Bridge, RosPeer, bridged, free_port, router, session
from zenav.stack.launch import free_stack

TYPES = ros_types(Distro.JAZZY)
MAKE = RosMessages(TYPES.types, RosFrames())
TWIST, TWIST_STAMPED = COMMAND_TYPES.values()
MARK = "nav_msgs/msg/Path"


class Robot:
    """A node with subscriptions of /cmd_vel, by their tokens, that hears every message of that name."""

    def __init__(self, bridge, peer, namespace=""):
        self.bridge, self.peer, self.name = bridge, peer, f"{namespace}/cmd_vel"
        self.node, self.n, self.heard = RosNode(0, str(peer.session.info.zid()), "/", "robot"), 0, []
        peer.session.declare_subscriber(f"0{self.name}/*/*", lambda sample: self.heard.append(str(sample.key_expr)))
        peer.subscribe(f"{namespace}/plan", MARK)
        self._changed, self._advertised = threading.Condition(), set()
        peer.session.liveliness().declare_subscriber("@ros2_lv/0/**", self._hear_token, history=True)

    def token(self, type_, hash_=""):
        self.n += 1
        topic = RosName(self.name, type_, hash_ or TYPES.hash_of(type_))
        return self.peer.session.liveliness().declare_token(
            self.node.endpoint_token(self.n, Entity.SUBSCRIPTION, topic, Qos())
        )

    def assert_out(self, types):
        """Exactly these types arrive, of both that the core orders. A message of another topic marks their end."""
        twist = MAKE.twist(0.1, 0.2)
        stamped = MAKE.new(TWIST_STAMPED, header=MAKE.header(0, ""), twist=twist)
        mark = MAKE.path_of(0, "map", [])
        self.heard.clear()
        for _ in range(100):  # a new publisher and its subscription find each other after a moment
            self.peer.received.clear()
            for name, message in ((COMMAND, twist), (STAMPED_COMMAND, stamped), ("/plan", mark)):
                self.bridge.order(publish=name, data=TYPES.encode(message))
            with suppress(AssertionError):
                self.peer.wait(MARK, limit=0.1)
                if self.types_heard() >= types:
                    break
        assert self.types_heard() == types

    def types_heard(self):
        return {type_ for type_ in (TWIST, TWIST_STAMPED) if any(f"::{type_[18:]}_/" in key for key in self.heard)}

    def until(self, types):
        """Waits until the bridge has publishers of these types."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.advertised() == types, LIMIT_S), self._advertised

    def advertised(self):
        found = map(endpoint_of, self._advertised)
        return {e.topic.type for e in found if e and e.entity is Entity.PUBLISHER and e.topic.name == self.name}

    def _hear_token(self, sample):
        with self._changed:
            change = self._advertised.add if sample.kind == zenoh.SampleKind.PUT else self._advertised.discard
            change(str(sample.key_expr))
            self._changed.notify_all()


@pytest.fixture
def robot():
    with bridged(drives=True) as (bridge, _, peer):
        yield Robot(bridge, peer)


def test_nothing_goes_out_while_nobody_subscribes(robot):
    robot.assert_out(set())
    assert robot.advertised() == set()


@pytest.mark.parametrize("type_", [TWIST, TWIST_STAMPED])
def test_a_subscriber_that_comes_late_gets_its_type_alone_until_it_goes(robot, type_):
    with robot.token(type_):
        robot.until({type_})
        robot.assert_out({type_})
    robot.until(set())
    robot.assert_out(set())


def test_two_subscribers_of_different_types_get_both_and_each_may_go(robot):
    with robot.token(TWIST_STAMPED):
        with robot.token(TWIST):
            with robot.token(TWIST):
                robot.until({TWIST, TWIST_STAMPED})
                robot.assert_out({TWIST, TWIST_STAMPED})
            robot.assert_out({TWIST, TWIST_STAMPED})
        robot.until({TWIST_STAMPED})
        robot.assert_out({TWIST_STAMPED})
    assert not [event for event in robot.bridge.events if event["event"] == "mismatch"]


def test_a_subscriber_that_changes_its_type_gets_the_new_one(robot):
    with robot.token(TWIST):
        robot.until({TWIST})
    with robot.token(TWIST_STAMPED):
        robot.until({TWIST_STAMPED})
        robot.assert_out({TWIST_STAMPED})


def test_a_subscriber_of_neither_type_or_with_another_hash_is_reported_and_gets_nothing(robot):
    with robot.token("std_msgs/msg/String"), robot.token(TWIST, "RIHS01_0"):
        robot.bridge.wait(lambda: len([e for e in robot.bridge.events if e["event"] == "mismatch"]) == 2)
        robot.assert_out(set())


def test_a_subscriber_that_was_there_before_the_bridge_and_in_a_namespace_gets_its_type():
    port = free_port()
    with router(port), session("client", port) as opened, free_stack() as claim:
        bridge = Bridge(port, claim.where, drives=True, namespace="/robot1")
        robot = Robot(bridge, RosPeer(opened, TYPES), "/robot1")
        with robot.token(TWIST_STAMPED):
            bridge.device.start()
            try:
                robot.until({TWIST_STAMPED})
                robot.assert_out({TWIST_STAMPED})
            finally:
                bridge.device.close()


def test_after_the_router_was_away_the_velocity_goes_out_again():
    port = free_port()
    with free_stack() as claim:
        bridge = Bridge(port, claim.where, drives=True)
        bridge.device.start()
        try:
            for _ in range(2):
                with router(port), session("client", port) as opened:
                    bridge.wait_open()
                    robot = Robot(bridge, RosPeer(opened, TYPES))
                    with robot.token(TWIST):
                        robot.until({TWIST})
                        robot.assert_out({TWIST})
                bridge.wait(lambda: not bridge.states[-1][0])
        finally:
            bridge.device.close()
