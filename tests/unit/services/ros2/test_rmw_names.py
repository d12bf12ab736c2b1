# SPDX-License-Identifier: Apache-2.0
"""Keys, tokens and attachments are those of rmw_zenoh: the published examples, byte for byte."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.ros2.rmw_names import (
    Durability,
    Endpoint,
    Entity,
    Qos,
    Reliability,
    RosName,
    RosNode,
    attachment,
    attachment_of,
    dds_type,
    endpoint_of,
    mismatch_text,
    qos_of,
    ros_type,
    topic_key,
)

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = RosName("/chatter", "std_msgs/msg/String", STRING_HASH)
NODE = RosNode(2, "aac3178e146ba6f1fc6e6a4085e77f21", "/", "listener")
# of docs/design.md in ros2/rmw_zenoh
NODE_TOKEN = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
LISTENER_TOKEN = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/::,10:,:,:,,"
)


def test_the_key_of_a_topic_is_that_of_the_design_document():
    assert topic_key(0, CHATTER) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"


def test_the_key_of_a_name_in_a_namespace_keeps_its_slashes():
    name = RosName("/robot1/navigate_to_pose/_action/send_goal", "nav2_msgs/action/NavigateToPose_SendGoal", "RIHS01_0")
    expected = "3/robot1/navigate_to_pose/_action/send_goal/nav2_msgs::action::dds_::NavigateToPose_SendGoal_/RIHS01_0"
    assert topic_key(3, name) == expected


def test_the_token_of_a_node_is_the_published_one():
    assert NODE.token() == NODE_TOKEN


def test_the_token_of_a_subscription_is_the_published_one_with_the_qos_written_out():
    written = NODE.endpoint_token(10, Entity.SUBSCRIPTION, CHATTER, Qos(depth=10))
    assert written == LISTENER_TOKEN.replace("/::,10:,:,:,,", "/1:2:1,10:,:,:,,")


def test_the_published_token_is_read():
    endpoint = endpoint_of(LISTENER_TOKEN)
    assert endpoint is not None
    assert (endpoint.entity, endpoint.node, endpoint.topic) == (Entity.SUBSCRIPTION, "/listener", CHATTER)
    assert endpoint.qos == Qos(Reliability.RELIABLE, Durability.VOLATILE, 10)


def test_the_further_part_of_a_token_of_rolling_is_left_out():
    assert endpoint_of(f"{LISTENER_TOKEN}/cpu") == endpoint_of(LISTENER_TOKEN)


def test_a_namespace_and_a_topic_with_slashes_come_back():
    node = RosNode(0, "ab", "/fleet/robot1", "zenav")
    topic = RosName("/fleet/robot1/local_costmap/costmap", "nav_msgs/msg/OccupancyGrid", "RIHS01_1")
    token = node.endpoint_token(4, Entity.PUBLISHER, topic, Qos(durability=Durability.TRANSIENT_LOCAL, depth=1))
    assert token.count("/") == 12
    endpoint = endpoint_of(token)
    assert endpoint is not None
    assert (endpoint.node, endpoint.topic, endpoint.qos.is_latched) == ("/fleet/robot1/zenav", topic, True)


@pytest.mark.parametrize(
    "token",
    [
        "",
        "@ros2_lv/0/x",
        NODE_TOKEN,
        LISTENER_TOKEN.replace("/MS/", "/XX/"),
        LISTENER_TOKEN.replace("::,10", "a:b:c"),
        LISTENER_TOKEN.replace("@ros2_lv", "@other"),
    ],
)
def test_what_is_no_endpoint_is_none(token):
    assert endpoint_of(token) is None


def test_blank_parts_of_a_qos_are_the_defaults_of_rmw_zenoh():
    assert qos_of("::,:,:,:,,") == Qos(Reliability.RELIABLE, Durability.VOLATILE, 42)
    assert qos_of("2:1:2,7:,:,:,,") == Qos(Reliability.BEST_EFFORT, Durability.TRANSIENT_LOCAL, 7)


@given(st.text(max_size=30))
def test_any_text_is_survived(text):
    qos_of(text)
    endpoint_of(text)


def test_types_are_mangled_and_back():
    for name in ("std_msgs/msg/String", "std_srvs/srv/Trigger", "nav2_msgs/action/Spin_SendGoal"):
        assert ros_type(dds_type(name)) == name
    assert dds_type("sensor_msgs/msg/LaserScan") == "sensor_msgs::msg::dds_::LaserScan_"


def test_an_attachment_has_exactly_33_bytes():
    gid = bytes(range(16))
    data = attachment(7, 1_700_000_000_123_456_789, gid)
    assert data == struct.pack("<qq", 7, 1_700_000_000_123_456_789) + b"\x10" + gid
    assert len(data) == 33
    assert attachment_of(data) == (7, 1_700_000_000_123_456_789, gid)


@pytest.mark.parametrize("data", [b"", bytes(32), bytes(34), bytes(33), struct.pack("<qqB16s", 1, 2, 15, bytes(16))])
def test_other_bytes_are_no_attachment(data):
    assert attachment_of(data) is None


SCAN = RosName("/scan", "sensor_msgs/msg/LaserScan", "RIHS01_1")


@pytest.mark.parametrize(
    ("type_", "type_hash", "qos", "expected"),
    [
        (SCAN.type, SCAN.hash, Qos(Reliability.BEST_EFFORT), ""),
        (SCAN.type, SCAN.hash, Qos(durability=Durability.TRANSIENT_LOCAL), "as transient local, here it is volatile"),
        (SCAN.type, "RIHS01_2", Qos(), "with another definition of sensor_msgs/msg/LaserScan"),
        ("sensor_msgs/msg/PointCloud2", "RIHS01_3", Qos(), "as sensor_msgs/msg/PointCloud2"),
    ],
)
def test_an_endpoint_that_does_not_match_is_explained(type_, type_hash, qos, expected):
    theirs = Endpoint(Entity.SUBSCRIPTION, "/rviz", RosName("/scan", type_, type_hash), qos)
    text = mismatch_text(theirs, SCAN, Qos())
    assert text.startswith("/rviz subscribes to /scan") == bool(expected)
    assert expected in text
