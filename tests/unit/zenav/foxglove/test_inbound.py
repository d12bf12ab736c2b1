# SPDX-License-Identifier: Apache-2.0
"""What the app may send, and that nothing else gets through whatever the bytes."""

import json
from math import cos, pi, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.geometry import wrapped
from tests.stack.foxglove_app import stamped, twist
from zenav.foxglove.inbound import SCHEMAS, TOPICS, Inlet, InvalidMessageError, inlet_of, pose_from, velocity_from

GOAL = inlet_of("/goal", "json", "geometry_msgs/PoseStamped")
TELEOP = inlet_of("/teleop", "json", "geometry_msgs/Twist")
places, angles = st.floats(-1e5, 1e5), st.floats(-pi, pi)
json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
    lambda inner: (
        st.lists(inner) | st.dictionaries(st.sampled_from(["x", "y", "z", "w", "pose", "linear", "frame_id"]), inner)
    ),
)


@pytest.mark.parametrize("schema", SCHEMAS["pose"])
@given(places, places, angles, st.sampled_from([1, -1]))
def test_a_pose_comes_through_in_every_shape_that_panels_send(schema, x, y, yaw, sign):
    content = stamped(x, y, z=sign * sin(yaw / 2), w=sign * cos(yaw / 2))
    if "Covariance" in schema:
        content["pose"] = {"pose": content["pose"], "covariance": [0] * 36}
    if "foxglove" in schema:
        content["frame_id"] = content.pop("header")["frame_id"]
    inlet = inlet_of("/initialpose", "json", schema.replace("/", "/msg/"))
    pose = pose_from(inlet, json.dumps(content).encode())
    assert (pose.x, pose.y) == (x, y)
    assert abs(wrapped(pose.yaw - yaw)) < 1e-9


@given(st.floats(-20, 20), st.floats(-50, 50))
def test_a_velocity_comes_through(v, w):
    assert velocity_from(TELEOP, json.dumps(twist(v, w)).encode()) == (v, w)
    stamp = inlet_of("/cmd_vel", "json", "geometry_msgs/msg/TwistStamped")
    assert velocity_from(stamp, json.dumps({"header": {}, "twist": twist(v, w)}).encode()) == (v, w)


def mutated(content: dict, data: st.DataObject) -> dict:  # type: ignore[type-arg]
    """The content with one of its parts replaced by anything."""
    tree = json.loads(json.dumps(content))
    at = tree
    while True:
        key = data.draw(st.sampled_from(sorted(at)))
        if isinstance(at[key], dict) and at[key] and data.draw(st.booleans()):
            at = at[key]
            continue
        at[key] = data.draw(json_values)
        return dict(tree)


@given(st.data())
def test_anything_else_is_refused_or_finite(data):
    pose = json.dumps(mutated(stamped(1.0, 2.0), data)).encode()
    velocity = json.dumps(mutated(twist(0.1, 0.2), data)).encode()
    try:
        found = pose_from(GOAL, pose)
        assert abs(found.x) <= 1e6
        assert abs(found.y) <= 1e6
        assert abs(found.yaw) <= pi
    except InvalidMessageError:
        pass
    try:
        v, w = velocity_from(TELEOP, velocity)
        assert abs(v) <= 20
        assert abs(w) <= 50
    except InvalidMessageError:
        pass


@given(st.binary() | st.sampled_from([b"[" * 50_000, b"{" + b" " * 70_000 + b"}", b"null", b"1e999", b'{"pose": 1}']))
def test_any_bytes_are_refused(data):
    for read in (lambda: pose_from(GOAL, data), lambda: velocity_from(TELEOP, data)):
        with pytest.raises(InvalidMessageError):
            read()


@given(st.text(), st.text(), st.text())
def test_a_channel_of_anything_else_is_refused(topic, encoding, schema):
    with pytest.raises(InvalidMessageError):
        inlet_of(topic, "json", schema)
    for known in TOPICS:
        with pytest.raises(InvalidMessageError):
            inlet_of(known, "json", schema)
        if encoding != "json":
            with pytest.raises(InvalidMessageError):
                inlet_of(known, encoding, SCHEMAS[TOPICS[known]][0])


@pytest.mark.parametrize("frame", ["odom", "base_link", "", None, 3])
def test_a_pose_in_another_frame_is_refused(frame):
    content = stamped(1.0, 2.0)
    content["header"]["frame_id"] = frame
    with pytest.raises(InvalidMessageError, match="give it in 'map'"):
        pose_from(GOAL, json.dumps(content).encode())


def test_a_tilted_pose_is_refused():
    content = stamped(1.0, 2.0, w=cos(0.5))
    content["pose"]["orientation"]["x"] = sin(0.5)
    with pytest.raises(InvalidMessageError, match="vertical"):
        pose_from(GOAL, json.dumps(content).encode())


def test_what_is_announced_is_remembered():
    assert Inlet("/goal", "goal", "geometry_msgs/PoseStamped") == GOAL
