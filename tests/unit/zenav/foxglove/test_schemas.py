# SPDX-License-Identifier: Apache-2.0
"""What Foxglove is shown of a message: places, angles, frames and times, decoded by the schema that goes with it."""

import json
from dataclasses import replace
from math import cos, isnan, pi, sin
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared import messages as m
from shared import topics
from shared.config import Mount, load_robot
from shared.geometry import Pose2, wrapped
from shared.topics import SERVICES, TOPICS, key_of
from tests.protobuf import schema_of
from tests.strategies import messages
from zenav.foxglove.schemas import MAP_ROW, MapPicture, MessageContext, SchemaRow, encode_message, encoding_of, rows_of

ROBOT = load_robot("x80sv").robot
SEEN = MessageContext("mapper", ROBOT)
S = 1_000_000_000
EYE = np.eye(3).ravel()
poses = st.builds(Pose2, st.floats(-50, 50), st.floats(-50, 50), st.floats(-pi, pi))
stamps = st.integers(0, 2**32 * S - 1)


def told(row: SchemaRow, value: Any) -> dict[str, Any]:
    """A value as a reader of the channel has it."""
    encoding, schema = encoding_of(row.type)
    if encoding == "json":
        return dict(json.loads(encode_message(value)))
    return schema_of(schema.data).decode(schema.name, encode_message(value))


def shown(key: str, message: m.Message, seen: MessageContext = SEEN) -> dict[str, dict[str, Any]]:
    """What a message shows, by Foxglove's topics."""
    values = [(row, row.make(message, seen)) for row in rows_of(key)]
    return {row.topic: told(row, value) for row, value in values if value is not None}


def ns(stamp: dict[str, int] | None) -> int:
    return stamp["seconds"] * S + stamp["nanos"] if stamp else 0


def pose2(pose: dict[str, Any]) -> Pose2:
    at, q = pose.get("position") or pose["translation"], pose.get("orientation") or pose["rotation"]
    assert (at["z"], q["x"], q["y"]) == (0, 0, 0)
    return Pose2(at["x"], at["y"], 2 * np.arctan2(q["z"], q["w"]))


def same(a: Pose2, b: Pose2) -> bool:
    return a.distance(b) < 1e-9 and abs(wrapped(a.yaw - b.yaw)) < 1e-9


def odometry(stamp: int, pose: Pose2) -> m.Odometry:
    return m.Odometry(stamp, pose, 0.4, -0.2, np.arange(9.0))


def estimate(stamp: int, base: Pose2, odom: Pose2) -> m.PoseEstimate:
    return m.PoseEstimate(stamp, base, odom, EYE, 0.9, m.Localization.GOOD)


@given(stamps, poses, poses)
def test_the_chain_of_frames_leads_to_the_robot_on_the_map(stamp, map_from_odom, odom_from_base):
    scan = m.LaserScan(stamp, -1.0, 0.5, 0.1, 0.1, 12.0, np.ones(5, np.float32))
    at = map_from_odom @ odom_from_base
    links = [
        *shown("pose", estimate(stamp, at, map_from_odom))["/tf"]["transforms"],
        *shown("odom", odometry(stamp, odom_from_base))["/tf"]["transforms"],
        *shown("scan", scan)["/tf"]["transforms"],
    ]
    names = [(link["parent_frame_id"], link["child_frame_id"]) for link in links]
    assert names == [("map", "odom"), ("odom", "base_link"), ("base_link", "laser")]
    assert {ns(link["timestamp"]) for link in links} == {stamp}
    assert same(pose2(links[0]) @ pose2(links[1]), at)
    mount = ROBOT.laser.mount
    assert same(pose2(links[2]), Pose2(mount.x, mount.y, mount.yaw))


@given(stamps, poses)
def test_a_pose_is_where_it_is_in_its_frame(stamp, pose):
    found = shown("pose", estimate(stamp, pose, Pose2()))
    assert found["/pose"]["frame_id"] == "map"
    assert ns(found["/pose"]["timestamp"]) == stamp
    assert same(pose2(found["/pose"]["pose"]), pose)
    whole = found["/zenav/pose"]
    assert (whole["quality"], whole["state"]) == (0.9, "good")
    assert whole["stamp"] == {"sec": stamp // S, "nsec": stamp % S}


@given(poses)
def test_odometry_keeps_speeds_and_covariance(pose):
    found = shown("odom", odometry(5, pose))["/odom"]
    assert (found["frame_id"], found["body_frame_id"]) == ("odom", "base_link")
    assert (found["linear_velocity"]["x"], found["angular_velocity"]["z"]) == (0.4, -0.2)
    covariance = np.reshape(found["pose_covariance"], (6, 6))
    assert covariance[np.ix_([0, 1, 5], [0, 1, 5])].ravel().tolist() == np.arange(9.0).tolist()
    assert np.count_nonzero(covariance) == 8


@given(st.floats(-pi, pi), st.integers(2, 40), st.booleans(), st.data())
def test_a_beam_lies_where_the_scan_says(first, n, clockwise, data):
    increment = (-1 if clockwise else 1) * 2 * pi / 40
    ranges = np.array(data.draw(st.lists(st.floats(0, 20, width=32), min_size=n, max_size=n)), np.float32)
    scan = m.LaserScan(7, first, increment, 0.1, 0.15, 12.0, ranges)
    found = shown("scan", scan)["/scan"]
    assert found["frame_id"] == "laser"
    assert same(pose2(found["pose"]), Pose2())
    angles = np.linspace(found["start_angle"], found["end_angle"], n)  # as the panels draw it
    for i, (angle, reach) in enumerate(zip(angles, found["ranges"], strict=True)):
        if scan.range_min <= ranges[i] <= scan.range_max:
            there = reach * cos(angle), reach * sin(angle)
            wanted = ranges[i] * cos(first + i * increment), ranges[i] * sin(first + i * increment)
            assert there == pytest.approx(wanted, abs=1e-6)
        else:
            assert isnan(reach)


def test_a_turned_laser_is_turned_in_the_frames_and_not_in_the_scan():
    laser = ROBOT.laser.model_copy(update={"mount": Mount(x=0.1, y=-0.05, yaw=pi / 2)})
    seen = MessageContext("sim", ROBOT.model_copy(update={"laser": laser}))
    scan = m.LaserScan(7, 0.0, 0.1, 0.1, 0.1, 12.0, np.ones(3, np.float32))
    found = shown("scan", scan, seen)
    base_from_laser = pose2(found["/tf"]["transforms"][0])
    in_base = base_from_laser @ np.array([[1.0, 0.0]])
    assert in_base[0] == pytest.approx((0.1, 0.95))
    assert found["/scan"]["start_angle"] == 0


def test_without_a_robot_the_laser_has_no_place():
    scan = m.LaserScan(7, 0.0, 0.1, 0.1, 0.1, 12.0, np.ones(3, np.float32))
    assert "/tf" not in shown("scan", scan, MessageContext("sim", None))


def cell_at(grid: dict[str, Any], x: float, y: float) -> tuple[tuple[int, ...], int] | None:
    """(red, green, blue, alpha) and value of the grid's cell at a place of its frame, read by the grid's own fields."""
    corner = grid["pose"]["position"]
    assert same(pose2({**grid["pose"], "position": {"x": 0, "y": 0, "z": 0}}), Pose2())
    column = int((x - corner["x"]) // grid["cell_size"]["x"])
    row = int((y - corner["y"]) // grid["cell_size"]["y"])
    n_rows = len(grid["data"]) // grid["row_stride"]
    if not (0 <= column < grid["column_count"] and 0 <= row < n_rows):
        return None
    at = row * grid["row_stride"] + column * grid["cell_stride"]
    values = {f["name"]: grid["data"][at + f["offset"]] for f in grid["fields"]}
    cell = values["cell"]
    return tuple(values[name] for name in ("red", "green", "blue", "alpha")), cell - 256 if cell > 127 else cell


tiles = st.tuples(st.integers(-3, 3), st.integers(-3, 3))


@given(st.dictionaries(tiles, st.sampled_from([0, 40, 100]), min_size=1, max_size=4), st.data())
def test_a_cell_of_any_tile_lands_where_it_is_on_the_map(values, data):
    picture = MapPicture()
    for version, ((row, column), value) in enumerate(values.items()):
        cells = np.full((1, 4096), -1, np.int8)
        cells[0, 64 * 5 + 9] = value  # row 5, column 9
        place = np.array([row], np.int32), np.array([column], np.int32)
        picture.add(m.MapUpdate(S, 1, version, 0.05, *place, cells))
    grid = told(MAP_ROW, picture.due(S))
    assert grid["frame_id"] == "map"
    assert ns(grid["timestamp"]) == S
    for (row, column), value in values.items():
        x, y = (64 * column + 9.5) * 0.05, (64 * row + 5.5) * 0.05
        colours, cell = cell_at(grid, x, y) or ((), None)
        assert cell == value
        assert colours == (*3 * (int(254 - 2.54 * value),), 255)
    x, y = data.draw(st.floats(-8, 8)), data.draw(st.floats(-8, 8))
    near = any(abs(x - (64 * c + 9.5) * 0.05) < 0.03 and abs(y - (64 * r + 5.5) * 0.05) < 0.03 for r, c in values)
    assert near or cell_at(grid, x, y) in (None, ((0, 0, 0, 0), -1))


def update(version: int, value: int, map_id: int = 1) -> m.MapUpdate:
    place = np.zeros(1, np.int32)
    return m.MapUpdate(version * S, map_id, version, 0.05, place, place, np.full((1, 4096), value, np.int8))


def test_the_map_is_shown_when_it_changed_and_not_more_than_once_a_second():
    picture = MapPicture()
    assert picture.due(100 * S) is None
    picture.add(update(1, 0))
    assert picture.due(100 * S) is not None
    assert picture.due(200 * S) is None
    picture.add(update(2, 0))
    assert picture.due(200 * S) is None, "nothing in it changed"
    picture.add(update(3, 100))
    assert picture.due(200 * S) is not None
    picture.add(update(4, 0))
    assert picture.due(200 * S + S // 2) is None
    assert picture.last() is not None
    assert picture.due(201 * S) is not None
    assert picture.last() is None


def test_a_new_map_takes_the_old_one_off_the_screen():
    picture = MapPicture()
    picture.add(update(1, 100))
    picture.due(S)
    picture.add(update(1, -1, map_id=2))
    grid = told(MAP_ROW, picture.due(9 * S))
    assert cell_at(grid, 0.01, 0.01) == ((0, 0, 0, 0), -1)


def test_a_costmap_lands_where_it_is_in_odom():
    cells = np.zeros((4, 6), np.int8)
    cells[1, 4] = 100
    grid = shown("debug/costmap", m.Costmap(5, -2.0, 3.0, 0.1, cells))["/debug/costmap"]
    assert grid["frame_id"] == "odom"
    (red, _, _, alpha), cell = cell_at(grid, -2.0 + 0.45, 3.0 + 0.15) or ((0, 0, 0, 0), None)
    assert (cell, alpha > 100, red > 100) == (100, True, True)
    assert cell_at(grid, -2.0 + 0.15, 3.0 + 0.15) == ((0, 0, 0, 0), 0)


def test_a_path_is_its_poses_and_no_path_is_none():
    path = m.Path(3, 1, 1, "", np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([0.5, -0.5]), 1.4, 2.0)
    found = shown("plan", path)
    assert [same(pose2(pose), at) for pose, at in zip(found["/plan"]["poses"], [Pose2(1, 3, 0.5), Pose2(2, 4, -0.5)])]
    assert found["/plan"]["frame_id"] == "map"
    nothing = replace(path, reason="unreachable", xs=np.empty(0), ys=np.empty(0), yaws=np.empty(0))
    assert shown("plan", nothing)["/plan"]["poses"] == []
    assert shown("plan", nothing)["/zenav/plan"]["reason"] == "unreachable"


@given(poses, poses)
def test_the_true_pose_is_told_on_the_map(start, world_from_base):
    people = np.array([start.x], np.float32), np.array([start.y], np.float32)
    truth = m.Truth(5, world_from_base, start, 0.0, 0.0, False, 0, 0.0, *people)
    found = shown("sim/truth", truth)
    assert same(start @ pose2(found["/sim/pose"]["pose"]), world_from_base)
    (entity,) = found["/sim/people"]["entities"]
    at = entity["cylinders"][0]["pose"]["position"]
    assert (at["x"], at["y"]) == pytest.approx((0, 0), abs=1e-4)


@pytest.mark.parametrize(("level", "number"), [("DEBUG", 1), ("INFO", 2), ("WARNING", 3), ("ERROR", 4), ("odd", 0)])
def test_a_line_of_the_log_keeps_its_level_and_speaker(level, number):
    found = shown("log/mapper", m.LogLine(5, level, "lost"))["/log"]
    assert (found["level"], found["message"], found["name"]) == (number, "lost", "mapper")


def test_the_outline_moves_with_the_robot():
    found = shown("guard/status", m.GuardStatus(5, m.GuardState.HOLD, "nav", "obstacle", "", 0.3))
    (entity,) = found["/robot"]["entities"]
    assert (entity["frame_id"], entity["frame_locked"]) == ("base_link", 1)
    corners = [(p["x"], p["y"]) for p in entity["lines"][0]["points"]]
    assert corners == [pytest.approx(corner) for corner in ROBOT.footprint]
    (status,) = found["/diagnostics"]["status"]
    assert (status["name"], status["level"]) == ("guard", 1)
    assert "something is inside the protective field" in status["message"]


def test_a_stop_and_a_failure_are_errors():
    stopped = m.GuardStatus(5, m.GuardState.STOPPED, "", "estop", "", 0.0)
    assert shown("guard/status", stopped)["/diagnostics"]["status"][0]["level"] == 2
    failed = m.NavStatus(5, 1, m.NavState.FAILED, "", "unreachable", "", Pose2(), 1.0, 2.0, 0, 1, 0)
    assert shown("nav/status", failed)["/diagnostics"]["status"][0]["level"] == 2


def test_the_way_that_was_taken_is_drawn_broad():
    ways = m.Rollouts(5, np.array([[0, 1], [0, 2]], np.float32), np.zeros((2, 2), np.float32), np.ones(2, np.float32))
    (entity,) = shown("debug/rollouts", ways)["/debug/rollouts"]["entities"]
    assert entity["frame_id"] == "odom"
    broad = max(entity["lines"], key=lambda line: line["thickness"])
    assert [p["x"] for p in broad["points"]] == [0, 1]


def keys() -> list[str]:
    return [key for t in TOPICS for key in ([t.key] if t.by != "*" else [key_of(t, SERVICES[1])])]


@pytest.mark.parametrize("key", keys())
@settings(max_examples=30)
@given(data=st.data())
def test_any_valid_message_is_shown_and_fits_its_schema(key, data):
    topic = topics.topic_of(key)
    message = data.draw(messages(topic.type))
    found = shown(key, message)
    assert found or topic in (topics.MAP, topics.JOURNAL)
    for row in rows_of(key):
        encoding, schema = encoding_of(row.type)
        if encoding == "json" and row.topic in found:
            fits(found[row.topic], json.loads(schema.data))


def fits(value: Any, schema: dict[str, Any]) -> None:
    """The value is of the schema's type, all the way down; null stands for nothing measured in an array of numbers."""
    kind = schema["type"]
    if kind == "object":
        assert set(value) <= set(schema["properties"])
        for name, part in value.items():
            fits(part, schema["properties"][name])
    elif kind == "array":
        assert schema["items"]["type"] != "array", "Foxglove reads no arrays in arrays"
        for part in value:
            if part is not None or schema["items"]["type"] != "number":
                fits(part, schema["items"])
    else:
        python = {"integer": int, "number": (int, float), "string": str, "boolean": bool}[kind]
        assert isinstance(value, python)
