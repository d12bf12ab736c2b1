# SPDX-License-Identifier: Apache-2.0
"""The bridge's shell on a router: what another node sees, gets and sends, and what is not rmw_zenoh's."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import zenoh
from zenoh.ext import HistoryConfig, declare_advanced_subscriber

from services.ros2 import bridge_device
from services.ros2.action_topics import actions_of
from services.ros2.bridge_device import zenoh_endpoint
from services.ros2.outgoing_markers import MARKERS
from services.ros2.outgoing_topics import OUTGOING
from services.ros2.rmw_names import ATTACHMENT, Entity, Qos, RosName, RosNode, attachment, attachment_of, endpoint_of
from services.ros2.ros_types import Distro
from services.ros2.zenav_command import CommandResult
from shared import requests, sample_messages, topics
from shared.codec import Envelope, encode
from shared.config import UserError, load_robot
from shared.geometry import Pose2
from shared.messages import MapState, Path, Zone, ZoneKind, Zones
from shared.reasons import BUSY
from shared.requests import Cancel
from tests.unit.services.ros2.network import GID, LIMIT_S, Bridge, bridged, free_port, repeated, router

ROBOT = load_robot("x80sv").robot
COMMAND_LIMIT_S = 60.0  # a command is a process, which a busy machine starts slowly
CMD_VEL, TWIST = "/cmd_vel", "geometry_msgs/msg/Twist"


@pytest.fixture(scope="module")
def network():
    with bridged() as parts:
        yield parts


@pytest.fixture
def bridge(network):
    parts = network[0]
    parts.events.clear()
    return parts


@pytest.fixture
def stack(network):
    return network[1]


@pytest.fixture
def peer(network):
    network[2].received.clear()
    return network[2]


def twist(bridge, v):
    vector = bridge.types.types["geometry_msgs/msg/Vector3"]
    return bridge.types.types[TWIST](linear=vector(x=v, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))


def test_another_node_discovers_our_node_and_every_topic_with_its_type(peer, bridge):
    tokens = peer.tokens()
    endpoints = [endpoint for endpoint in map(endpoint_of, tokens) if endpoint is not None]
    found = {endpoint.topic.name: endpoint.topic for endpoint in endpoints}
    for row in OUTGOING:
        assert (found[row.name].type, found[row.name].hash) == (row.type, bridge.types.hash_of(row.type))
    assert {endpoint.node for endpoint in endpoints} == {"/zenav"}
    assert len(tokens) == len(endpoints) + 1
    numbers = [token.split("/")[4] for token in tokens]
    assert len(set(numbers)) == len(numbers)


def test_a_scan_goes_out_to_a_subscriber_with_its_attachment(peer, stack):
    peer.subscribe("/scan", "sensor_msgs/msg/LaserScan")
    ranges = np.linspace(0.5, 3, ROBOT.laser.n_beams)
    ranges[7] = np.nan

    def scan():
        return topics.SCAN(sample_messages.scan(stack.now(), ROBOT.laser, ranges))

    message, sample = repeated(stack, scan, lambda s: peer.wait("sensor_msgs/msg/LaserScan", limit=s))
    assert message.header.frame_id == "laser"
    assert len(message.ranges) == ROBOT.laser.n_beams
    assert message.ranges[7] == np.inf
    assert len(sample.attachment.to_bytes()) == ATTACHMENT.size == 33
    first = attachment_of(sample.attachment.to_bytes())
    peer.received.clear()
    _, sample = repeated(stack, scan, lambda s: peer.wait("sensor_msgs/msg/LaserScan", limit=s))
    second = attachment_of(sample.attachment.to_bytes())
    assert second[0] > first[0]
    assert second[2] == first[2]


def test_the_transforms_have_the_stamp_of_odometry_and_the_last_correction(peer, stack):
    peer.subscribe("/tf", "tf2_msgs/msg/TFMessage")
    estimate = replace(sample_messages.pose_estimate(stack.now()), map_from_odom=Pose2(1, 2, 0.5))
    stamp = stack.now()

    def both(seconds):
        stack.publish(topics.ODOM(sample_messages.odometry(stamp, Pose2(3, 4, 0))))
        return peer.wait("tf2_msgs/msg/TFMessage", lambda message: len(message.transforms) == 2, seconds)

    message, _ = repeated(stack, lambda: topics.POSE(estimate), both)
    first, second = message.transforms
    assert (first.header.frame_id, first.child_frame_id) == ("map", "odom")
    assert (second.header.frame_id, second.child_frame_id) == ("odom", "base_link")
    assert first.header.stamp == second.header.stamp
    assert (first.transform.translation.x, second.transform.translation.y) == (1, 4)


def test_a_map_reaches_early_and_late_subscribers(network, stack, peer):
    cells = np.full((64, 64), -1, np.int8)
    cells[3, 5] = 100
    peer.subscribe("/map", "nav_msgs/msg/OccupancyGrid")
    message, _ = repeated(
        stack,
        lambda: topics.MAP(sample_messages.map_update(stack.now(), cells)),
        lambda s: peer.wait("nav_msgs/msg/OccupancyGrid", limit=s),
    )
    assert (message.info.width, message.info.height, message.header.frame_id) == (64, 64, "map")
    assert message.data.reshape(64, 64)[3, 5] == 100
    late, found = [], threading.Event()

    def file(sample: zenoh.Sample) -> None:
        late.append(sample.payload.to_bytes())
        found.set()

    history = HistoryConfig(detect_late_publishers=True, max_samples=1)
    key = peer.key("/map", "nav_msgs/msg/OccupancyGrid")
    subscriber = declare_advanced_subscriber(peer.session, key, file, history=history)
    assert found.wait(LIMIT_S)
    subscriber.undeclare()
    assert network[0].types.decode(late[0], "nav_msgs/msg/OccupancyGrid").data.tolist() == message.data.tolist()


def test_the_static_frames_that_the_core_sent_are_kept_for_late_subscribers(bridge, peer):
    transforms = bridge.types.types["tf2_msgs/msg/TFMessage"](transforms=[])
    bridge.order(publish="/tf_static", data=bridge.types.encode(transforms))
    found = threading.Event()
    key = peer.key("/tf_static", "tf2_msgs/msg/TFMessage")
    history = HistoryConfig(detect_late_publishers=True, max_samples=1)
    subscriber = declare_advanced_subscriber(peer.session, key, lambda sample: found.set(), history=history)
    assert found.wait(LIMIT_S)
    subscriber.undeclare()


@pytest.mark.parametrize(
    ("name", "type_", "message"),
    [
        ("/plan", "nav_msgs/msg/Path", topics.PLAN(Path(1, 1, 1, "", *[np.zeros(3)] * 3, 0.0, 0.0))),
        (
            "/zones",
            "visualization_msgs/msg/MarkerArray",
            topics.ZONES(Zones(1, (Zone(1, "kitchen", ZoneKind.SLOW, np.arange(3.0), np.array([0, 1.0, 0])),))),
        ),
    ],
    ids=lambda part: part if isinstance(part, str) and part.startswith("/") else "",
)
def test_other_topics_go_out(peer, stack, name, type_, message):
    peer.subscribe(name, type_)
    repeated(stack, lambda: message, lambda s: peer.wait(type_, limit=s))


def test_the_places_of_the_map_go_out_by_their_names(peer, stack, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ZENAV_MAP", raising=False)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "places.yaml").write_text("kitchen: {x: 3.5, y: -1.2, yaw: 90}\n")
    peer.subscribe("/places", MARKERS)

    def has_kitchen(array):
        return "kitchen" in [marker.text for marker in array.markers]

    repeated(
        stack, lambda: topics.MAP_STATE(MapState(stack.now(), 1, "", ())), lambda s: peer.wait(MARKERS, has_kitchen, s)
    )


def test_a_velocity_comes_in_with_its_publisher(bridge, peer):
    peer.publish(CMD_VEL, twist(bridge, 0.25))
    event = bridge.wait_event("message")
    assert (event["name"], event["type"], event["gid"]) == (CMD_VEL, TWIST, GID)
    assert event["sent"] == 5, "as the peer writes it"
    assert bridge.types.decode(event["data"], TWIST).linear.x == 0.25


def test_a_request_is_replied_to_with_its_own_number_and_client(bridge, peer):
    request = bridge.types.new("std_srvs/srv/Trigger_Request", structure_needs_at_least_one_member=0)
    response = bridge.types.new("std_srvs/srv/Trigger_Response", success=True, message="yes")

    def answer() -> None:
        number = bridge.wait_event("request")["id"]
        bridge.order(reply=number, data=bridge.types.encode(response))

    thread = threading.Thread(target=answer)
    thread.start()
    received, data = peer.call("/estop", "std_srvs/srv/Trigger", request)
    thread.join()
    assert (received.success, received.message) == (True, "yes")
    sequence, _, gid = attachment_of(data)
    assert (sequence, gid) == (7, GID)


def test_a_message_without_an_attachment_is_counted_and_not_used(bridge, peer):
    peer.session.put(peer.key(CMD_VEL, TWIST), bridge.types.encode(twist(bridge, 1.0)))
    event = bridge.wait_event("rejected")
    assert (event["name"], event["text"], event["n"]) == (CMD_VEL, "a message without rmw_zenoh's attachment", 1)
    assert not [row for row in bridge.events if row["event"] == "message"]


def test_a_message_with_another_hash_is_counted_and_named(bridge, peer):
    key = peer.key(CMD_VEL, TWIST).rpartition("/")[0] + "/RIHS01_0"
    peer.session.put(key, bridge.types.encode(twist(bridge, 1.0)), attachment=attachment(1, 2, GID))
    assert bridge.wait_event("rejected")["text"] == "a message of type geometry_msgs/msg/Twist RIHS01_0"


def test_a_subscription_of_another_type_is_reported_in_words(bridge, peer):
    node = RosNode(0, "ab", "/", "rviz")
    token = node.endpoint_token(
        1, Entity.SUBSCRIPTION, RosName("/scan", "sensor_msgs/msg/PointCloud2", "RIHS01_0"), Qos()
    )
    with peer.session.liveliness().declare_token(token):
        event = bridge.wait_event("mismatch")
    assert event["text"].startswith("/rviz subscribes to /scan as sensor_msgs/msg/PointCloud2")


def test_a_request_without_an_attachment_ends_without_a_reply(bridge, peer):
    key = peer.key("/estop", "std_srvs/srv/Trigger")
    assert not list(peer.session.get(key, payload=b"\x00\x01\x00\x00\x00", timeout=LIMIT_S))
    assert bridge.wait_event("rejected")["name"] == "/estop"


def test_a_flood_reaches_the_core_thinned_and_the_rest_is_counted(bridge, peer):
    n = 1000
    for i in range(n):
        peer.publish(CMD_VEL, twist(bridge, i / n), i)
    newest = twist(bridge, (n - 1) / n)
    data = bridge.types.encode(newest)
    bridge.wait(lambda: any(row["event"] == "message" and row["data"] == data for row in bridge.events))

    def total() -> int:
        messages = sum(row["event"] == "message" for row in bridge.events)
        return messages + sum(row["n"] for row in bridge.events if row["event"] == "rejected")

    bridge.wait(lambda: total() == n)
    assert sum(row["event"] == "message" for row in bridge.events) < n / 2


def test_stop_is_taken_however_many_requests_of_other_services_wait():
    with bridged() as (bridge, _, peer):

        def ask(name, type_):
            return peer.session.get(peer.key(name, type_), payload=b"\0\1\0\0\0", attachment=attachment(1, 5, GID))

        def n_of(kind, name):
            rows = [event for event in bridge.events if event["event"] == kind and event["name"] == name]
            return sum(row.get("n", 1) for row in rows)

        names = [(action.part("get_result"), f"{action.type}_GetResult") for action in actions_of(Distro.JAZZY)]
        waiting = [ask(*names[0]) for _ in range(65)]
        bridge.wait(lambda: n_of("request", names[0][0]) + n_of("rejected", names[0][0]) == 65)
        waiting += [ask("/cancel", "std_srvs/srv/Trigger")]
        bridge.wait(lambda: n_of("request", "/cancel") == 1)
        for name in names[1:]:  # one by one: each service has a queue of its own
            waiting += [ask(*name) for _ in range(20)]
            bridge.wait(lambda name=name[0]: n_of("request", name) + n_of("rejected", name) == 20)
        assert n_of("rejected", names[-1][0]) == 20
        waiting += [ask("/estop", "std_srvs/srv/Trigger")]
        bridge.wait(lambda: n_of("request", "/estop") == 1)


def test_a_request_to_the_stack_without_a_service_is_a_refusal(bridge):
    payload = encode(Cancel(1), Envelope("ros2", "", 0, 1))
    bridge.order(ask=requests.CANCEL.key, id=4, payload=payload)
    event = bridge.wait_event("outcome")
    assert (event["id"], event["accepted"]) == (4, False)


def test_a_command_that_fails_is_a_refusal_with_its_words(bridge):
    bridge.order(tool=["map", "save", "no_such_stack"], id=5)
    event = bridge.wait_event("outcome", COMMAND_LIMIT_S)
    assert (event["id"], event["accepted"]) == (5, False)
    assert "hint:" in event["detail"]


def test_one_command_of_a_kind_runs_and_others_get_the_answer_busy(bridge, monkeypatch):
    may_end, begun = threading.Event(), []

    def run(*command):
        begun.append(command[:3])
        may_end.wait(LIMIT_S)
        return CommandResult("", "")

    def outcome(number):
        return [event for event in bridge.events if event["event"] == "outcome" and event["id"] == number]

    monkeypatch.setattr(bridge_device, "run_command", run)
    for number in range(1, 33):
        bridge.order(tool=("map", "save", f"m{number}"), id=number)
    bridge.order(tool=("map", "load", "other"), id=33)
    bridge.wait(lambda: outcome(32))
    may_end.set()
    bridge.wait(lambda: outcome(1) and outcome(33))
    assert begun == [("map", "save", "m1"), ("map", "load", "other")]
    assert [outcome(number)[0]["reason"] for number in (1, 33)] == ["", ""]
    assert {outcome(number)[0]["reason"] for number in range(2, 33)} == {BUSY.code}
    bridge.order(tool=("map", "save", "again"), id=34)
    bridge.wait(lambda: outcome(34))
    assert begun[-1] == ("map", "save", "again")


def test_names_are_remapped_and_below_the_namespace_but_for_those_of_tf():
    with bridged(namespace="/robot1", remap=("/scan:=/front/scan",), domain=3) as (_, _, peer):
        names = {endpoint.topic.name for endpoint in map(endpoint_of, peer.tokens()) if endpoint is not None}
    assert {"/front/scan", "/robot1/odom", "/tf", "/robot1/navigate_to_pose/_action/send_goal"} <= names


def test_a_router_that_comes_late_goes_and_comes_back_is_joined_again():
    port = free_port()
    bridge = Bridge(port, None)
    bridge.device.start()
    try:
        bridge.wait(lambda: bridge.states and not bridge.states[-1][0])
        assert "no Zenoh router answers" in bridge.states[-1][1]
        for _ in range(2):
            with router(port):
                bridge.wait_open()
            bridge.wait(lambda: not bridge.states[-1][0])
            assert "is away" in bridge.states[-1][1]
    finally:
        bridge.device.close()


@pytest.mark.parametrize("device", ["", "tcp/host:7447", "zenoh://", "zenoh://host", "zenoh://tcp/host", "web://h"])
def test_an_address_that_is_no_router_is_an_error_with_a_hint(device):
    with pytest.raises(UserError) as error:
        zenoh_endpoint(device)
    assert error.value.hint == "write zenoh://tcp/HOST:7447"
