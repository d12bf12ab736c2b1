# SPDX-License-Identifier: Apache-2.0
"""The page's core: one page drives and only while it sends, STOP is everybody's, and bad frames do nothing."""

import math
from itertools import product

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.dashboard.frames import FRAMES, MAX_FRAME, OPERATIONS, PAGE_KEYS
from services.dashboard.service import FRAME_HANDLERS
from shared.codec import Envelope, decode, encode
from shared.messages import EmergencyStop, GuardState, PortState, Velocity, Zone, ZoneKind
from shared.requests import Navigate, SetZones
from shared.roles import FRAME_ROLES, OPERATION_ROLES, Role
from tests.unit.services.dashboard.pages import ELSEWHERE, MS, ROBOT, START, Pages


@pytest.fixture
def pages() -> Pages:
    opened = Pages()
    for client in (1, 2):
        opened.open(client)
    opened.open(3, ELSEWHERE)
    return opened


def test_each_frame_and_operation_has_its_check_its_handler_and_its_role():
    assert set(FRAMES) == set(FRAME_HANDLERS) == set(FRAME_ROLES)
    assert set(OPERATIONS) == set(OPERATION_ROLES)


# --- opening ----------------------------------------------------------------------------------------------------------


def test_the_first_frame_is_hello_with_the_robot_and_the_role(pages):
    to, hello = pages.frames[0]
    assert (to, hello["t"], hello["client"], hello["name"], hello["role"]) == (1, "hello", 1, "page 1", "admin")
    assert hello["robot"]["name"] == ROBOT.name
    assert len(hello["robot"]["outline"]) == len(ROBOT.corners)
    assert hello["simulated"] is True
    assert hello["reasons"]["estop"][0] == "STOP is pressed"
    assert "pose" in hello["keys"]
    assert not any(key.startswith(("port/", "journal/")) for key in hello["keys"])
    assert "csrf" not in hello, "a token would be in every recording"


def test_only_pages_of_this_computer_may_do_everything(pages):
    (clients,) = pages.sent("clients")[-1:]
    assert [(c["client"], c["role"]) for c in clients["clients"]] == [(1, "admin"), (2, "admin"), (3, "viewer")]


def test_a_page_has_the_name_that_it_gives_itself_until_it_is_gone(pages):
    pages.frame(2, "name", name="  the tablet ")
    assert pages.sent("clients")[-1]["clients"][1]["name"] == "the tablet"
    pages.close(2)
    assert [c["client"] for c in pages.sent("clients")[-1]["clients"]] == [1, 3]


def test_a_page_gets_what_it_wants_and_is_told_of_an_unknown_key(pages):
    pages.frame(1, "want", keys=["pose", "map", "journal/mapper"])
    assert pages.orders == [{"client": 1, "want": ["map", "pose"]}]
    assert "journal/mapper" in pages.sent("note", 1)[0]["text"]


def test_debug_topics_are_asked_for_while_a_page_shows_them(pages):
    pages.frame(1, "want", keys=[], debug=True)
    assert pages.orders[0]["want"] == ["debug/costmap", "debug/graph", "debug/rollouts"]
    assert [order["ask"] for order in pages.orders[1:]] == ["request/watch", "request/watch_graph"]
    pages.run(4000)
    assert len(pages.orders) == 7
    pages.frame(1, "want", keys=[], debug=False)
    pages.run(4000)
    assert len(pages.orders) == 8


# --- driving ----------------------------------------------------------------------------------------------------------


def test_the_command_is_published_at_once_and_zero_200_ms_after_the_last_frame(pages):
    pages.teleop(1, 0.3, -0.1)
    assert pages.messages == [(START, Velocity(START, 0.3, -0.1, ""))]
    pages.run(150)
    assert pages.velocities == [(0.3, -0.1)], "the guard ends it by its age; it is never published again"
    pages.run(100)
    assert set(pages.velocities[1:]) == {(0.0, 0.0)}
    pages.run(2000)
    assert pages.velocities.count((0.0, 0.0)) in (10, 11), "half a second of zero, then nothing"


def test_a_burst_of_frames_is_one_command(pages):
    for i in range(20):
        pages.teleop(1, 0.01 * i)
    assert pages.velocities == [(0.0, 0.0)]
    pages.run(50)
    assert pages.velocities[1] == (0.19, 0.0)


def test_letting_go_and_leaving_are_zero_at_once(pages):
    for leave in (lambda: pages.frame(1, "let_go"), lambda: pages.close(1)):
        pages.messages.clear()
        pages.core.now += 100 * MS
        pages.teleop(1, 0.3)
        leave()
        assert pages.velocities == [(0.3, 0.0), (0.0, 0.0)]
        assert pages.sent("drivers")[-1]["driver"] is None


def test_the_shell_that_cannot_listen_any_more_is_zero_and_no_page(pages):
    pages.teleop(1, 0.3)
    pages._take(pages.core.port_state(PortState(pages.core.now, "page", False, "port 8600 is taken")))
    assert pages.velocities[-1] == (0.0, 0.0)
    assert len(pages.core.pages) == 0
    assert pages.core.state() == "port 8600 is taken"


def test_a_second_driver_is_refused_with_the_name_of_the_first(pages):
    pages.frame(1, "name", name="the tablet")
    pages.teleop(1, 0.3)
    pages.teleop(2, -0.3)
    assert pages.velocities == [(0.3, 0.0)]
    assert "the tablet drives" in pages.sent("note", 2)[-1]["text"]
    assert pages.sent("drivers")[-1]["driver"] == {"client": 1, "name": "the tablet"}


def test_another_tool_that_drives_has_the_robot(pages):
    pages.teleop(1, 0.3)
    pages.event(client=None, event="other_teleop")
    assert pages.sent("drivers")[-1] == {"t": "drivers", "driver": None, "other": True, "source": ""}
    pages.teleop(1, 0.3)
    pages.run(200)
    assert pages.velocities == [(0.3, 0.0)]
    assert "elsewhere" in pages.sent("note", 1)[-1]["text"]
    pages.run(400)
    assert pages.sent("drivers")[-1]["other"] is False


def test_the_guards_source_is_shown_at_changes(pages):
    n = len(pages.sent("drivers"))
    for source in ("nav", "nav", "teleop"):
        pages.guard(source=source)
    assert [f["source"] for f in pages.sent("drivers")[n:]] == ["nav", "teleop"]


def test_a_robot_that_a_page_drives_stands_when_the_service_ends(pages):
    assert list(pages.core.on_shutdown()) == []
    pages.teleop(1, 0.3)
    pages._take(pages.core.on_shutdown())
    assert pages.velocities[-1] == (0.0, 0.0)


steps = st.lists(
    st.tuples(st.integers(1, 3), st.sampled_from(["teleop", "let_go", "close", "open", "tick"]), st.integers(0, 300)),
    max_size=40,
)


@given(steps)
def test_what_goes_out_is_one_pages_command_of_the_last_200_ms_or_zero(steps):
    pages = Pages()
    driver, driven_at, is_open = None, 0, set()  # the model: the page that drives, since when
    for client, what, ms in steps:
        pages.core.now += ms * MS + 1000  # never exactly 200 ms after a frame
        now = pages.core.now
        if driver is not None and now - driven_at > 200 * MS:
            driver = None
        n_before = len(pages.velocities)
        if what == "open":
            pages.open(client)
            is_open.add(client)
        elif what == "close":
            pages.close(client)
            is_open.discard(client)
            driver = None if driver == client else driver
        elif what == "let_go":
            pages.frame(client, "let_go")
            driver = None if driver == client and client in is_open else driver
        elif what == "teleop":
            pages.teleop(client, 0.1 * client)
            if client in is_open and driver in (None, client):
                driver, driven_at = client, now
        else:
            pages._take(pages.core.drive())
        allowed = {(0.0, 0.0)} | ({(0.1 * driver, 0.0)} if driver is not None else set())
        assert set(pages.velocities[n_before:]) <= allowed
        if what == "tick" and driver is None and n_before and pages.velocities[n_before - 1] != (0.0, 0.0):
            assert pages.velocities[-1] == (0.0, 0.0)
    for at, message in pages.messages:
        assert at - message.stamp <= 200 * MS


# --- STOP -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("client", [1, 3])
def test_stop_of_any_page_is_published_until_the_guard_confirms_it(pages, client):
    pages.frame(client, "stop")
    assert pages.stops == [True]
    pages.guard(GuardState.ACTIVE)
    pages.run(500)
    assert len(pages.stops) == 6
    pages.guard(GuardState.STOPPED)
    pages.run(1000)
    assert len(pages.stops) == 6


def test_a_stop_that_the_guard_does_not_confirm_is_told_to_every_page(pages):
    pages.frame(1, "stop")
    pages.run(3100)
    assert [f["text"] for f in pages.sent("note")] == ["the guard does not confirm"]
    n = len(pages.stops)
    pages.run(1000)
    assert len(pages.stops) == n


def test_a_release_is_repeated_with_its_first_stamp_so_that_a_newer_stop_of_another_tool_holds(pages):
    pages.guard(GuardState.STOPPED)
    pages.frame(1, "release")
    pages.run(500)
    releases = [message for _, message in pages.messages if isinstance(message, EmergencyStop)]
    assert len(releases) > 3
    assert len({message.stamp for message in releases}) == 1


def test_a_stop_holds_against_a_release_that_was_not_confirmed(pages):
    pages.frame(1, "release")
    pages.frame(3, "stop")
    pages.run(500)
    assert pages.stops[0] is False
    assert set(pages.stops[1:]) == {True}


# --- roles, limits, malformed frames ----------------------------------------------------------------------------------


def test_a_viewer_commands_nothing(pages):
    pages.frame(3, "teleop", v=0.1, w=0.0, n=1)
    pages.frame(3, "release")
    for op, fields in OPERATIONS.items():
        values = {"name": "a", "to": "b", "mode": "map", "pose": [0.0, 0.0, 0.0], "text": "x", "value": "1", "t": 0}
        args = {key: values[key] for key in fields.required}
        args |= {"name": "a.mcap"} if op.startswith(("recording_d", "replay_")) else {}
        pages.frame(3, "do", id=op, op=op, args=args)
    for request in ("navigate", "explore", "cancel", "pause", "override", "start_map", "fault", "watch", "set_zones"):
        pages.frame(3, "ask", id=request, request=f"request/{request}", args={})
    pages.run(500)
    assert pages.messages == []
    allowed = {op for op, role in OPERATION_ROLES.items() if role is Role.VIEWER}
    assert {order["id"] for order in pages.orders} == allowed
    refused = {f["id"]: f["reason"] for f in pages.sent("reply", 3)}
    assert set(refused.values()) == {"role"}
    assert len(refused) == 9 + len(OPERATIONS) - len(allowed)


def test_an_operator_tunes_settings_but_sets_no_limit(pages):
    pages.core.pages.get(2).role = Role.OPERATOR
    for client, name in product((1, 2), ("planner.cost.margin", "robot.drive.max_speed", "local_ctrl.max_speed")):
        pages.frame(client, "do", id=name, op="setting_set", args={"name": name, "value": "0.1"})
    assert [order["client"] for order in pages.orders] == [1, 1, 1, 2]
    assert [reply["reason"] for reply in pages.sent("reply", 2)] == ["role", "role"]


def test_a_request_is_stamped_checked_and_passed_on(pages):
    pages.frame(1, "ask", id=7, request="request/navigate", args=ROUTE)
    (order,) = pages.orders
    request, _ = decode(Navigate, order["payload"])
    assert (order["client"], order["id"], order["ask"]) == (1, 7, "request/navigate")
    assert (request.stamp, request.poses[0].x) == (START, 1.0)


def test_a_request_with_messages_and_arrays_in_it_passes_as_on_the_wire(pages):
    corners = [np.array(values, float) for values in ([0, 1, 1], [0, 0, 1])]
    zones = (Zone(0, "ramp", ZoneKind.SLOW, *corners, speed=0.2),)
    args = msgpack.unpackb(encode(SetZones(0, zones), Envelope("x", "x", 0, 0)))
    pages.frame(1, "ask", id=1, request="request/set_zones", args={"zones": args["zones"]})
    request, _ = decode(SetZones, pages.orders[0]["payload"])
    assert (request.stamp, request.zones[0].name, request.zones[0].xs.tolist()) == (START, "ramp", [0.0, 1.0, 1.0])


ROUTE = {"poses": [[1.0, 2.0, 0.5]], "dwell": 0.0, "loops": 1, "any_heading": False}


@pytest.mark.parametrize(
    ("request_", "args", "words"),
    [
        ("request/navigate", {**ROUTE, "poses": []}, "no poses"),
        ("request/navigate", {**ROUTE, "poses": [[1e9, 0.0, 0.0]]}, "poses"),
        ("request/navigate", {**ROUTE, "stamp": 1}, "stamp"),
        ("request/navigate", {**ROUTE, "speed": 1}, "unknown field"),
        ("request/navigate", {}, "missing"),
        ("request/load_map", {}, "no request of a page"),
        ("pose", {}, "no request of a page"),
    ],
)
def test_a_wrong_request_is_refused_with_its_fault(pages, request_, args, words):
    pages.frame(1, "ask", id="a", request=request_, args=args)
    (reply,) = pages.sent("reply", 1)
    assert (reply["id"], reply["accepted"], reply["reason"]) == ("a", False, "bad_request")
    assert words in reply["detail"]
    assert pages.orders == []


BAD = [
    b"",
    b"\xc1",
    b"\x93\x01\x02\x03",
    msgpack.packb({"keys": []}),
    msgpack.packb({"t": 3}),
    msgpack.packb({"t": "fly"}),
    msgpack.packb({"t": "teleop", "v": 0.1, "w": 0.0}),
    msgpack.packb({"t": "teleop", "v": math.nan, "w": 0.0, "n": 1}),
    msgpack.packb({"t": "teleop", "v": math.inf, "w": 0.0, "n": 1}),
    msgpack.packb({"t": "teleop", "v": 20.1, "w": 0.0, "n": 1}),
    msgpack.packb({"t": "teleop", "v": 0.1, "w": -50.1, "n": 1}),
    msgpack.packb({"t": "teleop", "v": True, "w": 0.0, "n": 1}),
    msgpack.packb({"t": "teleop", "v": 0.1, "w": 0.0, "n": -1}),
    msgpack.packb({"t": "teleop", "v": 0.1, "w": 0.0, "n": 1, "x": 1}),
    msgpack.packb({"t": "want", "keys": "pose"}),
    msgpack.packb({"t": "want", "keys": ["pose"] * (len(PAGE_KEYS) + 1)}),
    msgpack.packb({"t": "want", "keys": ["x" * 65]}),
    msgpack.packb({"t": "name", "name": "x" * 41}),
    msgpack.packb({"t": "name", "name": "a\nb"}),
    msgpack.packb({"t": "ping", "id": 2**53 + 1}),
    msgpack.packb({"t": "ping", "id": None}),
    msgpack.packb({"t": "stop", "why": "x"}),
    b"\x81\xa1t\xa4stop" + bytes(MAX_FRAME),
]


@pytest.mark.parametrize("data", BAD)
def test_a_bad_frame_is_told_to_its_page_and_does_nothing(pages, data):
    n = len(pages.frames)
    pages.raw(1, data)
    pages.run(300)
    assert [(to, f["t"], f["level"]) for to, f in pages.frames[n:]] == [(1, "note", "error")]
    assert pages.messages == []
    assert pages.orders == []


@pytest.mark.parametrize(
    ("op", "args"),
    [
        ("map_delete", {"name": "../maps"}),
        ("map_delete", {"name": "a/b"}),
        ("map_delete", {"name": ""}),
        ("map_delete", {"name": ".."}),
        ("map_save", {"name": "x" * 65}),
        ("map_load", {"name": "a", "mode": "fly"}),
        ("map_load", {"name": "a", "mode": "map", "pose": [0, 0]}),
        ("place_set", {"name": "a", "pose": [0, 0, math.nan]}),
        ("place_set", {"name": "a", "pose": [0, 0, 0], "map": "../x"}),
        ("recording_delete", {"name": "../a.mcap"}),
        ("recording_delete", {"name": "a.yaml"}),
        ("recording_mark", {"text": "x" * 201}),
        ("rm", {}),
    ],
)
def test_a_wrong_operation_is_refused_with_its_fault(pages, op, args):
    pages.frame(1, "do", id=1, op=op, args=args)
    assert [f["reason"] for f in pages.sent("reply", 1)] == ["bad_request"]
    assert pages.orders == []


def test_a_mark_is_in_the_log_which_is_recorded(pages):
    pages.frame(1, "do", id=1, op="recording_mark", args={"text": "the door stuck"})
    assert pages.logs == ["mark by page 1: the door stuck"]
    assert pages.sent("reply", 1)[0]["accepted"]


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)
near_frames = st.fixed_dictionaries(
    {"t": st.sampled_from(sorted(FRAMES))},
    optional={name: values for fields in FRAMES.values() for name in {**fields.required, **fields.optional}},
)


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=40) | near_frames.map(msgpack.packb) | values.map(msgpack.packb), max_size=6))
def test_no_frame_and_no_event_raises(all_data):
    pages = Pages()
    pages.open(1)
    for data in all_data:
        pages.raw(1, data)
        pages.bytes(data)
        pages.run(50)
    assert len(pages.core.pages) >= 1
