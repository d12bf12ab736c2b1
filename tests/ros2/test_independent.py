# SPDX-License-Identifier: Apache-2.0
"""Others judge the bridge: the decoder of ROS itself, its packages' hashes, and an independent rmw_zenoh node."""

import json
import os
import platform
import subprocess
from pathlib import Path

import pytest

from services.ros2.action_topics import action_services, action_topics
from services.ros2.incoming_topics import INCOMING, TRIGGER
from services.ros2.interface_definitions import MESSAGES, SERVICES
from services.ros2.outgoing_map import GRID_UPDATE
from services.ros2.outgoing_topics import OUTGOING, STATIC_TF, converted
from services.ros2.ros_types import ACTIONS, Distro, ros_types
from shared.ros_messages import TF
from tests.stack.processes import ALL, running
from tests.unit.services.ros2.network import free_port, router
from tests.unit.services.ros2.test_outgoing_topics import SAMPLES, rows_with_sources, state

FOLDER = Path(__file__).parent
ENVIRONMENT = FOLDER.parents[1] / ".venv-ros2"
PYTHON = ENVIRONMENT / "bin" / "python"
TYPES = ros_types(Distro.JAZZY)
GOAL = 0.6, 0.2
NOT_IN_PIP = {"tf2_msgs/msg/TFMessage", GRID_UPDATE}
"""Types of ours whose ROS package is not in the environment, beside those of nav2_msgs."""
TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"  # tf2_msgs/TFMessage
ROS_VARIABLES = {"LD_LIBRARY_PATH": str(ENVIRONMENT / "lib"), "AMENT_PREFIX_PATH": str(ENVIRONMENT)}

pytestmark = [
    pytest.mark.skipif(not PYTHON.exists(), reason=f"no ROS 2 environment in {ENVIRONMENT.name}"),
    pytest.mark.skipif(platform.machine() != "x86_64", reason="the packages of ROS are for x86-64"),
    pytest.mark.timeout(240),
]


def encoded_samples() -> list[tuple[str, bytes]]:
    """Type and CDR of a message of each topic that goes out."""
    samples = []
    for row, topic in rows_with_sources():
        for _, message in converted(state(), frozenset((row.name,)), topic, SAMPLES[topic.key], "mapper"):
            samples.append((row.type, TYPES.encode(message)))
    trigger = TYPES.new(f"{TRIGGER}_Response", success=True, message="yes")
    return [*samples, (f"{TRIGGER}_Response", TYPES.encode(trigger))]


@pytest.fixture(scope="module")
def judged() -> tuple[dict[str, str], list[str]]:
    """The hashes of ROS's packages, and each sample as rclpy encodes it again."""
    lines = "".join(f"{type_} {data.hex()}\n" for type_, data in encoded_samples())
    first, *rest = judgement("ros_decoder.py", lines).splitlines()
    return json.loads(first), rest


def judgement(script: str, text: str) -> str:
    """What a script of this folder writes with ROS's packages."""
    environment = dict(os.environ, **ROS_VARIABLES)  # noqa: TID251  # of a child
    done = subprocess.run(
        [PYTHON, FOLDER / script], input=text, capture_output=True, text=True, env=environment, timeout=100
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_ros_reads_every_message_as_it_was_written(judged):
    """What rclpy read and wrote again is the message. Its own bytes differ in padding, which it does not set."""
    compared = set()
    for (type_, data), again in zip(encoded_samples(), judged[1], strict=True):
        if again:
            assert len(again) == 2 * len(data)
            assert TYPES.encode(TYPES.decode(bytes.fromhex(again), type_)) == data, type_
            compared.add(type_)
    ours = {row.type for row in OUTGOING} | {f"{TRIGGER}_Response"}
    assert ours - compared <= NOT_IN_PIP


def test_the_hashes_of_all_types_are_those_of_ros(judged):
    names = {row.type for row in (*OUTGOING, STATIC_TF, *action_topics(Distro.JAZZY))}
    names |= {type_ for row in INCOMING for type_ in row.types} | {TRIGGER}
    names |= {type_ for _, type_ in action_services(Distro.JAZZY)}
    known = {name for name in names if name in judged[0]}
    assert {name: TYPES.hash_of(name) for name in known} == {name: judged[0][name] for name in known}
    assert {name.split("/")[0] for name in names - known} <= {"nav2_msgs", "tf2_msgs", "map_msgs"}


@pytest.mark.parametrize("distro", [Distro.JAZZY, Distro.KILTED])
def test_the_hashes_of_interfaces_without_a_package_are_those_of_ros_generator(distro):
    """Of messages, services and actions, with all that rosidl makes of an action."""
    types = ros_types(distro)
    definitions = [[name, [text]] for name, text in {**MESSAGES, TF: TF_DEFINITION}.items()]
    definitions += [[name, list(parts)] for name, parts in SERVICES.items() if name.startswith("nav2_msgs/")]
    definitions += [[name, list(parts)] for name, parts in ACTIONS[distro].items()]
    hashes = json.loads(judgement("rosidl_hashes.py", json.dumps(definitions)))
    ours = {name: types.hash_of(name) for name in hashes if name in types.types or f"{name}_Request" in types.types}
    assert ours == {name: hashes[name] for name in ours}
    used = {type_ for _, type_ in action_services(distro)} | {row.type for row in action_topics(distro)}
    assert {name for name in used if name.startswith("nav2_msgs/")} <= ours.keys()
    assert {name for name, _ in definitions if "/action/" not in name} <= ours.keys()


def test_a_node_of_others_discovers_subscribes_calls_and_sends_the_robot_to_a_goal(tmp_path):
    port = free_port()
    settings = (f"ros2.port.device=zenoh://tcp/127.0.0.1:{port}",)
    with router(port), running(tmp_path, (*ALL, "ros2"), settings=settings) as stack:
        stack.until(lambda: stack.healths["ros2"].state == "in domain 0")
        arguments = [PYTHON, FOLDER / "sdk_node.py", str(port), *map(str, GOAL)]
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=150)
    lines = [line for line in done.stdout.splitlines() if line.startswith("SEEN ")]
    assert lines, done.stdout + done.stderr
    seen = json.loads(lines[0].removeprefix("SEEN "))
    for row in OUTGOING:
        assert seen["topics"][row.name] == [row.type]
    assert seen["services"]["/navigate_to_pose/_action/send_goal"] == ["nav2_msgs/action/NavigateToPose_SendGoal"]
    assert seen["scan"]["frame"] == "laser"
    assert seen["map"]["known"] > 100
    assert seen["late_map"] == seen["map"]["size"]
    assert seen["laser_parent"] == "base_link"
    assert seen["pause"][0] is False  # there is nothing to pause
    assert seen["distance"] < 0.35
