# SPDX-License-Identifier: Apache-2.0
"""The small parts of the tools: the stack's clock, keys, text of messages, saved maps, seeds."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.codec import Envelope
from shared.config import UserError
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import GuardState, GuardStatus, Health, LaserScan, NavState, NavStatus
from shared.runners.client import CLOCK_AGE, Client, Timekeeper, request_error
from shared.runners.transport import StackAddress
from shared.task_state import stop_reason
from shared.topics import NAV_STATUS, TOPICS
from tests.strategies import messages
from zenav.bench.seeds import seeds_from
from zenav.client.navigation_client import ArrivalTolerance, navigate, poses_from, target_text, task_result
from zenav.client.teleop import KEY_HOLD_S, TeleopKeys
from zenav.client.topic import rates
from zenav.console.message_text import json_value, message_text
from zenav.maps.map_files import coarse_cells, update_of, write_map
from zenav.scenario.live_table import service_row

NAV = NavStatus(1, 4, NavState.NAVIGATING, "", "", "", Pose2(1, 2, 0), 3.0, 4.0, 0, 1, 0)
GUARD = GuardStatus(1, GuardState.ACTIVE, "nav", "", "", 0.5)


@given(st.floats(0.1, 20), st.floats(1, 100), st.floats(0, CLOCK_AGE / 2))
def test_the_stack_s_clock_runs_on_at_the_simulator_s_rate(rate, heard_for, later):
    keeper = Timekeeper()
    for i in range(11):
        at = heard_for * i / 10
        keeper.add_clock(10**18 + round(at * rate * 1e9), at)
    told = keeper.now(0, heard_for + later)
    assert abs(told - (10**18 + round((heard_for + later) * rate * 1e9))) < 1e9 * 1e-6 * (1 + rate * heard_for)


def test_without_a_simulator_the_clock_is_the_wall_s():
    keeper = Timekeeper()
    assert keeper.now(5, 100.0) == 5
    keeper.add_clock(10**18, 100.0)
    assert keeper.now(5, 100.1) > 5
    assert keeper.now(5, 100.0 + 2 * CLOCK_AGE) == 5


def test_a_clock_that_was_set_back_is_followed():
    keeper = Timekeeper()
    keeper.add_clock(10**18, 0.0)
    keeper.add_clock(5 * 10**17, 1.0)
    assert keeper.now(0, 1.0) == 5 * 10**17


def test_a_tool_follows_a_publisher_whose_clock_is_set_back(monkeypatch):
    client, heard = Client("red", StackAddress(0)), []
    monkeypatch.setattr(client, "listen", lambda _, callback: heard.append(callback))
    client.follow(NAV_STATUS)
    (hear,) = heard
    for sequence, (sent, state) in enumerate([(5000, NavState.NAVIGATING), (1400, NavState.REACHED)]):
        hear(replace(NAV, state=state), Envelope("navigator", "n", sequence, sent))
    hear(NAV, Envelope("navigator", "n", 0, 5000))  # the kept value, late
    assert client.latest(NAV_STATUS).state is NavState.REACHED


@pytest.mark.parametrize(
    ("sent", "way"),
    [
        ("w", (1, 0)), ("s", (-1, 0)), ("a", (0, 1)), ("d", (0, -1)), ("wa", (1, 1)), ("\x1b[A", (1, 0)),
        ("\x1b[D", (0, 1)), ("w ", (0, 0)), ("wx", (0, 0)), ("ws", (-1, 0)), ("", (0, 0)),
    ],
)  # fmt: skip
def test_keys_point_the_way(sent, way):
    keys = TeleopKeys()
    keys.press(sent, 10.0)
    assert keys.direction(10.0 + KEY_HOLD_S / 2) == way
    assert keys.direction(10.0 + 2 * KEY_HOLD_S) == (0, 0)


@pytest.mark.parametrize("sent", ["q", "\x03", "wwq"])
def test_q_ends(sent):
    keys = TeleopKeys()
    keys.press(sent, 0.0)
    assert keys.ended


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
@settings(deadline=None, max_examples=10)
@given(data=st.data())
def test_every_message_is_text_and_json(topic, data):
    message = data.draw(messages(topic.type))
    text = message_text(message, Envelope("p", "s", 1, 2))
    assert len(text.splitlines()) >= 2
    json.loads(json.dumps(json_value(message), allow_nan=False))


def test_long_arrays_are_cut_for_people_and_whole_in_json():
    ranges = np.full(360, np.nan, np.float32)
    ranges[:2] = 1.5, 2.25
    scan = LaserScan(1, 0.0, 0.01, 0.1, 0.1, 5.0, ranges)
    assert json_value(scan)["ranges"][:3] == [1.5, 2.25, None]
    assert len(json_value(scan)["ranges"]) == 360
    assert "[1.5, 2.25, -" in message_text(scan, Envelope("p", "s", 1, 2))


def test_rates_of_a_steady_stream():
    figures = rates(np.arange(11) * 0.1, np.full(11, 0.004), np.full(11, 100))
    assert figures["hz"] == pytest.approx(10)
    assert figures["jitter_ms"] == pytest.approx(0, abs=1e-6)
    assert figures["age_ms"] == pytest.approx(4)


@settings(deadline=None, max_examples=30)
@given(st.integers(-200, 200), st.integers(-200, 200), st.integers(1, 150), st.integers(1, 150), st.integers(0, 99))
def test_a_saved_map_comes_back_cell_by_cell(tmp_path_factory, row0, column0, h, w, seed):
    cells = np.random.default_rng(seed).choice(np.array([-1, 0, 100], np.int8), (h, w))
    cells[0, 0] = cells[-1, -1] = 100  # tiles of unknown cells alone are left out
    folder = tmp_path_factory.mktemp("map")
    from shared.ros_map import write_ros_map

    path = write_ros_map(folder, cells, 0.05, column0 * 0.05, row0 * 0.05)
    grid = OccupancyGrid(0.05)
    grid.apply(update_of(path))
    r, c = row0 - grid.first_row * 64, column0 - grid.first_column * 64
    assert np.array_equal(grid.cells[r : r + h, c : c + w], cells)
    assert (grid.cells >= 0).sum() == (cells >= 0).sum()


def test_a_map_is_written_with_its_picture(tmp_path):
    grid = OccupancyGrid(0.05)
    cells = np.full((4, 4), 0, np.int8)
    from shared.ros_map import write_ros_map

    grid.apply(update_of(write_ros_map(tmp_path / "a", cells, 0.05, 0.0, 0.0)))
    write_map(grid, tmp_path / "b")
    assert {p.name for p in (tmp_path / "b").iterdir()} == {"map.pgm", "map.yaml", "map.png"}


def test_coarse_cells_keep_walls():
    cells = np.zeros((5, 7), np.int8)
    cells[3, 4] = 100
    assert coarse_cells(cells, 3).tolist() == [[0, 0, 0], [0, 100, 0]]


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", [3]), ("0-2", [0, 1, 2]), ("0,4,7-9", [0, 4, 7, 8, 9]), ("1,1", [1])]
)
def test_seeds(text, seeds):
    assert seeds_from(text) == seeds


@pytest.mark.parametrize("text", ["", "-1", "1-", "a", "3-1", "1;2"])
def test_what_are_no_seeds(text):
    with pytest.raises(UserError):
        seeds_from(text)


def test_poses_may_carry_a_heading():
    assert poses_from(["1,2", " -3,4,-90"]) == [(1.0, 2.0, None), (-3.0, 4.0, -90.0)]


def test_a_pose_is_told_as_it_was_given():
    assert [target_text(target) for target in poses_from(["1,2", "-3,4,-90"])] == [
        "(1.00, 2.00)",
        "(-3.00, 4.00, -90 degrees)",
    ]


def test_a_request_without_a_reply_says_whether_the_service_runs():
    for noise in (b"", b"\xc1"):
        assert "does not run" in request_error("mapper", noise).what
    assert "in time" in request_error("mapper", b"Timeout").what


def test_a_task_ends_as_its_status_says():
    assert task_result(NAV, 4) is None
    assert task_result(replace(NAV, state=NavState.REACHED), 4).good
    failed = task_result(replace(NAV, state=NavState.FAILED, reason="unreachable"), 4)
    assert not failed.good
    assert failed.text == "no way leads to the goal"
    repeated = "no way leads to the goal: choose another"
    assert task_result(replace(NAV, state=NavState.FAILED, reason="unreachable", detail=repeated), 4) == failed
    detailed = task_result(replace(NAV, state=NavState.FAILED, reason="unreachable", detail="0.4 m short"), 4)
    assert detailed.text == "no way leads to the goal (0.4 m short)"
    assert "another task" in task_result(NAV, 3).text
    assert "started again" in task_result(NAV, 5).text


def test_why_the_robot_stands_is_the_guard_s_word_before_the_navigator_s():
    assert stop_reason(NAV, GUARD) == ""
    assert stop_reason(replace(NAV, reason="no_plan"), GUARD) == "there is no plan yet"
    told = stop_reason(replace(NAV, reason="no_plan"), replace(GUARD, reason="obstacle", detail="0.1 m ahead"))
    assert told == "something is inside the protective field (0.1 m ahead)"


def test_a_row_says_when_a_service_is_dead_silent_or_in_trouble():
    health = Health(0, "sim", 1, "running", 10, 2, 0, 1, "", 0.25, 50.0, 3.21, (("odom", 50.0, 0.004),))
    assert service_row(health, 0.5, True, 0) == ("running", "50", "4", "3.2", "25", "50", "2 bad, 1 intruders")
    assert service_row(None, 1e9, True, 0)[0] == "starting"
    assert service_row(health, 9.0, True, 3)[0] == "silent for 9 s"
    assert service_row(health, 9.0, False, 3)[0] == "dead"
    assert "3 restarts" in service_row(health, 9.0, False, 3)[-1]


def test_a_goal_s_tolerances_and_any_heading_are_in_the_request():
    target = (1.0, 2.0, 90.0)
    request = navigate([target], 0.0, 1, (), ArrivalTolerance(0.05, 3.0))
    assert (request.tolerance, request.any_heading) == (0.05, False)
    assert request.yaw_tolerance == pytest.approx(0.05236, abs=1e-5)
    assert navigate([target], 0.0, 1, (), ArrivalTolerance(any_heading=True)).any_heading
    assert navigate([target], 0.0, 1) == navigate([target], 0.0, 1, (), ArrivalTolerance())


def test_of_a_route_that_passes_through_only_the_last_heading_counts():
    arrival = ArrivalTolerance(pass_through=True)
    request = navigate([(1.0, 2.0, None), (3.0, 4.0, 90.0)], 0.0, 1, (), arrival)
    assert request.pass_through
    assert not request.any_heading
    assert request.poses[1].yaw == pytest.approx(np.pi / 2)
    assert navigate([(1.0, 2.0, 90.0), (3.0, 4.0, None)], 0.0, 1, (), arrival).any_heading
    with pytest.raises(UserError, match="has no stay"):
        navigate([(1.0, 2.0, None)], 5.0, 1, (), arrival)


@pytest.mark.parametrize(
    ("yaw", "arrival", "words"),
    [
        (90.0, ArrivalTolerance(0.001), "a tolerance under"),
        (90.0, ArrivalTolerance(heading_tolerance=5, any_heading=True), "any heading"),
        (None, ArrivalTolerance(heading_tolerance=5), "without a heading"),
    ],
)
def test_tolerances_that_mean_nothing_are_told(yaw, arrival, words):
    with pytest.raises(UserError, match=words):
        navigate([(1.0, 2.0, yaw)], 0.0, 1, (), arrival)
