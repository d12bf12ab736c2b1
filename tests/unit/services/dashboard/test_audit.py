# SPDX-License-Identifier: Apache-2.0
"""The core's roles and audit: a line for each command, refusal and login, and what a recording without them does."""

from math import pi

import pytest

from services.dashboard.audit import REFUSALS_EVERY_NS
from services.dashboard.login_reports import DAY_NS, SHOWN_FOR_NS
from shared.messages import GuardState
from shared.roles import FRAME_ROLES, OPERATION_ROLES, REQUEST_ROLES, Role, may
from tests.unit.services.dashboard.pages import ELSEWHERE, MS, START, Pages

ANNA = f"audit: anna (operator, {ELSEWHERE}): "


@pytest.fixture
def pages() -> Pages:
    opened = Pages()
    opened.open(1, ELSEWHERE, name="anna", role="operator")
    opened.open(2, ELSEWHERE, name="ben", role="viewer")
    return opened


def audited(pages: Pages) -> list[str]:
    return [text.removeprefix(ANNA) for text in pages.logs if text.startswith("audit: ")]


def test_the_open_event_gives_name_and_role(pages):
    hello = pages.sent("hello", 1)[0]
    assert (hello["name"], hello["role"], hello["login"]) == ("anna", "operator", True)
    assert [(c["name"], c["role"]) for c in pages.sent("clients")[-1]["clients"]] == [
        ("anna", "operator"),
        ("ben", "viewer"),
    ]


def test_an_open_event_of_a_recording_without_logins_has_the_role_of_its_address():
    pages = Pages()
    pages.open(1)
    pages.open(2, ELSEWHERE)
    assert [pages.sent("hello", client)[0]["role"] for client in (1, 2)] == ["admin", "viewer"]


def test_a_role_that_is_none_gives_no_more_than_the_address():
    pages = Pages()
    pages.open(1, ELSEWHERE, name="anna", role="root")
    assert pages.sent("hello", 1)[0]["role"] == "viewer"


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        ({"t": "stop"}, "STOP"),
        ({"t": "release"}, "release of STOP"),
        (
            {"t": "ask", "id": 1, "request": "request/navigate", "args": {"poses": [[3, 4, pi / 2]]}},
            "goal 3.0 4.0 90°",
        ),
        (
            {"t": "ask", "id": 1, "request": "request/navigate", "args": {"poses": [[3, 4, 0], [1, 2, 0]]}},
            "route of 2 poses",
        ),
        ({"t": "ask", "id": 1, "request": "request/cancel"}, "cancel"),
        ({"t": "ask", "id": 1, "request": "request/pause", "args": {"paused": True}}, "pause paused=True"),
        ({"t": "do", "id": 1, "op": "set_pose", "args": {"pose": [1.0, 2.0, -pi / 2]}}, "set_pose pose=1.0 2.0 270°"),
        (
            {"t": "do", "id": 1, "op": "map_load", "args": {"name": "office", "mode": "localize"}},
            "map_load name=office mode=localize",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_command_is_one_line_with_name_role_and_address(pages, frame, line):
    defaults = {"poses": [], "dwell": 0.0, "loops": 1, "any_heading": False}
    if frame.get("request") == "request/navigate":
        frame = {**frame, "args": {**defaults, **frame["args"]}}
    pages.frame(1, **frame)
    assert audited(pages) == [line]
    assert pages.logs[-1] == ANNA + line


def test_a_repeated_stop_is_one_line_until_the_guard_confirms_it(pages):
    for _ in range(5):
        pages.core.now += 50 * MS
        pages.frame(1, "stop")
    assert audited(pages) == ["STOP"]
    pages.guard(GuardState.STOPPED)
    pages.frame(1, "stop")
    assert audited(pages) == ["STOP", "STOP"]


def test_teleop_is_a_line_when_it_begins_and_when_it_ends(pages):
    for _ in range(20):
        pages.core.now += 50 * MS
        pages.teleop(1, 0.2)
    assert audited(pages) == ["teleop begins"]
    pages.run(500)
    assert audited(pages) == ["teleop begins", "teleop ends"]
    pages.teleop(1, 0.2)
    pages.close(1)
    assert audited(pages)[2:] == ["teleop begins", "teleop ends"]


def test_reading_is_no_line(pages):
    pages.frame(1, "want", keys=["pose"], debug=True)
    for op, role in OPERATION_ROLES.items():
        if role is Role.VIEWER:
            pages.frame(1, "do", id=1, op=op)
    pages.frame(1, "ping", id=1)
    pages.frame(1, "ask", id=1, request="request/watch", args={"seconds": 1.0})
    assert audited(pages) == []


def test_a_refused_command_is_a_line_and_of_many_one_in_a_while(pages):
    for _ in range(20):
        pages.core.now += 50 * MS
        pages.teleop(2, 0.2)
    pages.frame(2, "ask", id=1, request="request/cancel")
    pages.frame(2, "do", id=1, op="map_delete", args={"name": "office"})
    who = f"audit: ben (viewer, {ELSEWHERE}): refused: "
    assert pages.logs == [who + "teleop", who + "request/cancel", who + "map_delete"]
    pages.core.now += REFUSALS_EVERY_NS
    pages.teleop(2, 0.2)
    assert pages.logs[3:] == [who + "teleop"]
    assert pages.messages == []
    assert pages.orders == []


@pytest.mark.parametrize("role", Role)
def test_each_role_may_what_the_tables_say(role):
    pages = Pages()
    pages.open(1, ELSEWHERE, name="anna", role=role.value)
    for request in REQUEST_ROLES:
        pages.frame(1, "ask", id=request, request=request)
    for op in OPERATION_ROLES:
        pages.frame(1, "do", id=op, op=op)
    refused = {reply["id"] for reply in pages.sent("reply") if reply["reason"] == "role"}
    needs = {**REQUEST_ROLES, **OPERATION_ROLES}
    assert refused == {name for name, needed in needs.items() if not may(role, needed)}
    pages.frame(1, "teleop", v=0.1, w=0.0, n=1)
    assert bool(pages.velocities) == may(role, FRAME_ROLES["teleop"])


# --- reports of the shell ---------------------------------------------------------------------------------------------


def test_logins_and_their_end_are_lines():
    pages = Pages()
    user = {"client": None, "host": ELSEWHERE, "name": "anna", "role": "operator"}
    for event, what in (
        ("login", ""),
        ("upload", "office"),
        ("download", "a.mcap"),
        ("logout", ""),
        ("session_end", ""),
    ):
        pages.event(**user, event=event, what=what)
    assert audited(pages) == [
        "login",
        "map_upload office",
        "recording_download a.mcap",
        "logout",
        "the session is revoked or has expired",
    ]


def test_failed_logins_are_counted_in_the_health_for_a_while():
    pages = Pages()
    pages.core.is_open = True
    for n in (1, 2):
        pages.event(client=None, event="login_failed", host=ELSEWHERE, what="next attempt after 1 s")
        assert pages.logs[-1] == f"audit: failed login {n} from {ELSEWHERE}: next attempt after 1 s"
    assert pages.core.state() == f"0 pages open; 2 failed logins, the last from {ELSEWHERE}"
    pages.core.now += SHOWN_FOR_NS
    assert pages.core.state() == "0 pages open"


def test_the_end_of_the_certificate_is_in_the_health_and_a_note_of_each_new_page():
    pages = Pages()
    pages.core.is_open = True
    pages.event(client=None, event="certificate", until=START + 31 * DAY_NS)
    pages.open(1)
    assert pages.sent("note") == []
    pages.core.now += 19 * DAY_NS
    pages.open(2)
    assert "ends in 12 days" in pages.sent("note", 2)[0]["text"]
    assert pages.core.state() == "2 pages open; the page's certificate ends in 12 days"


def test_what_a_stranger_sends_makes_no_second_line():
    pages = Pages()
    pages.event(client=None, event="refused", host="1.2.3.4\nERROR", what="x\n" * 100, n=3)
    (line,) = pages.logs
    assert "\n" not in line
    assert len(line) < 300
