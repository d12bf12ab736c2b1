# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2: their hashes are those of ROS itself, and damaged bytes are an error in words."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.ros2.ros_types import NO_HASH, Distro, ros_types

# of share/PACKAGE/*.json in ROS 2 Jazzy's packages
JAZZY = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "sensor_msgs/msg/LaserScan": "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "std_srvs/srv/Trigger_Request": "d010825374ce8918e72bfd826c82603e60f45419e932ea976f807b74a863a199",
    "std_srvs/srv/Trigger_Response": "2d946c21e2fc3f1e9ca6986a8191d85fcc70097a8bb7771a053564bc47009cdf",
    "std_srvs/srv/Trigger_Event": "ec4a1d26b0575e61906890342aba9523a2360e9845857c5590fa6e23bc39e1c2",
    "service_msgs/msg/ServiceEventInfo": "41bcbbe07a75c9b52bc96bfd5c24d7f0fc0a08c0cb7921b3373c5732345a6f45",
}


@pytest.mark.parametrize("name", JAZZY)
def test_a_hash_is_that_of_ros(name):
    assert ros_types(Distro.JAZZY).hash_of(name) == f"RIHS01_{JAZZY[name]}"


def test_humble_has_no_hashes():
    assert ros_types(Distro.HUMBLE).hash_of("std_msgs/msg/String") == NO_HASH


def test_a_structure_without_members_is_one_byte():
    types = ros_types(Distro.JAZZY)
    request = types.new("std_srvs/srv/Trigger_Request", structure_needs_at_least_one_member=0)
    assert types.encode(request) == b"\x00\x01\x00\x00\x00"


@pytest.mark.parametrize("distro", Distro)
def test_an_action_has_its_services_and_its_feedback(distro):
    types = ros_types(distro).types
    for part in ("SendGoal_Request", "SendGoal_Response", "GetResult_Request", "GetResult_Response", "FeedbackMessage"):
        assert f"nav2_msgs/action/NavigateToPose_{part}" in types


@given(st.binary(max_size=200))
def test_damaged_bytes_are_a_value_error(data):
    types = ros_types(Distro.JAZZY)
    for name in ("geometry_msgs/msg/PoseStamped", "nav2_msgs/action/NavigateThroughPoses_SendGoal_Request"):
        with suppress(ValueError):
            types.decode(data, name)


def test_the_error_names_the_type():
    with pytest.raises(ValueError, match="no geometry_msgs/msg/PoseStamped"):
        ros_types(Distro.JAZZY).decode(b"\x00\x01\x00\x00", "geometry_msgs/msg/PoseStamped")
