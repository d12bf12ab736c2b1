# SPDX-License-Identifier: Apache-2.0
"""Nav2's actions Spin, BackUp and DriveOnHeading, and its services that clear the costmaps."""

from typing import Any

import pytest

from services.ros2.action_goal import GoalState
from services.ros2.action_topics import NAMES
from services.ros2.incoming_topics import CLEAR_AROUND, CLEAR_COSTMAP, CLEAR_EXCEPT
from services.ros2.ros_types import Distro
from shared import reasons
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus
from shared.requests import ClearCostmaps, DriveStraight, Spin
from tests.unit.services.ros2.core import Core

SPIN, BACK_UP, HEADING = (f"nav2_msgs/action/{kind}" for kind in ("Spin", "BackUp", "DriveOnHeading"))


def sent(core: Core, type_: str, amount: float, y: float = 0.0, **more: Any) -> list[Any]:
    """A goal with its amount, rad or m."""
    allowed = core.make.new("builtin_interfaces/msg/Duration", sec=10, nanosec=500_000_000)
    fields: dict[str, Any] = {"time_allowance": allowed}
    if type_ == SPIN:
        fields["target_yaw"] = amount
    else:
        fields |= {"target": core.make.point(amount, y), "speed": 0.1}
    return core.send_goal(NAMES[type_], type_, 1, **fields | more)


def moving(core: Core, state: NavState, left: float, reason: str = "") -> list[Any]:
    """What follows from a status of the navigator, a second later. left: rad or m."""
    core.service.now += 1_000_000_000
    status = NavStatus(core.service.now, 7, state, "", reason, "", Pose2(), left, 0.0, 0, 0, 0)
    return core.take(core.service.nav_status(status))


@pytest.mark.parametrize(
    ("type_", "given", "amount"), [(SPIN, -1.5, -1.5), (BACK_UP, 0.5, -0.5), (BACK_UP, -0.5, -0.5), (HEADING, 0.5, 0.5)]
)
@pytest.mark.parametrize("distro", Distro)
def test_a_goal_is_a_request_with_its_amount_and_time(type_, given, amount, distro):
    core = Core(distro=distro)
    more = {"disable_collision_checks": False} if distro is Distro.KILTED else {}
    [ask] = sent(core, type_, given, **more)
    request = core.asked(ask)
    assert isinstance(request, Spin if type_ == SPIN else DriveStraight)
    assert (request.angle if type_ == SPIN else request.distance) == pytest.approx(amount)
    assert request.seconds == 10.5


@pytest.mark.parametrize("fault", [{"y": 0.1}, {"speed": -0.1}])
def test_a_drive_that_is_none_is_refused(fault):
    core = Core()
    [reply] = sent(core, HEADING, amount=0.5, **fault)
    assert not core.response(reply, f"{HEADING}_SendGoal").accepted


def test_collision_checks_are_not_disabled():
    core = Core(distro=Distro.KILTED)
    [reply] = sent(core, SPIN, 1.0, disable_collision_checks=True)
    assert not core.response(reply, f"{SPIN}_SendGoal").accepted
    assert "never disabled" in core.lines[-1]


@pytest.mark.parametrize(
    ("type_", "sec", "words"),
    [
        (HEADING, 10, ["speed of 0.1 m/s does not count"]),
        (BACK_UP, 400, ["speed of 0.1 m/s does not count", "300 s, not 400 s"]),
        (SPIN, 0, ["without a time_allowance it may take 30 s"]),
        (SPIN, 10, []),
    ],
)
def test_what_of_a_goal_does_not_count_is_said(type_, sec, words):
    core = Core()
    n_lines = len(core.lines)
    allowed = core.make.new("builtin_interfaces/msg/Duration", sec=sec, nanosec=0)
    [ask] = sent(core, type_, 0.5, time_allowance=allowed)
    assert "ask" in ask
    lines = core.lines[n_lines:]
    assert len(lines) == bool(words)
    assert all(word in lines[0] for word in words)


def test_feedback_has_what_was_driven_and_the_result_the_time():
    core = Core()
    [ask] = sent(core, SPIN, -2.0)
    core.outcome(ask)
    [feedback] = moving(core, NavState.NAVIGATING, 1.5)
    message = core.types.decode(feedback["data"], f"{SPIN}_FeedbackMessage")
    assert message.feedback.angular_distance_traveled == pytest.approx(0.5)
    assert core.get_result("/spin", SPIN, 2) == []
    reply, _ = moving(core, NavState.REACHED, 0.0)
    response = core.response(reply, f"{SPIN}_GetResult")
    assert (response.status, response.result.error_code) == (GoalState.SUCCEEDED, 0)
    assert response.result.total_elapsed_time.sec >= 2


@pytest.mark.parametrize(
    ("reason", "code"), [(reasons.MOTION_BLOCKED, 714), (reasons.MOTION_TOO_LONG, 711), (reasons.SCAN_OLD, 710)]
)
def test_a_failure_has_nav2s_code_and_the_stacks_reason(reason, code):
    core = Core()
    [ask] = sent(core, BACK_UP, 0.5)
    core.outcome(ask)
    core.get_result("/backup", BACK_UP, 2)
    reply, _ = moving(core, NavState.FAILED, 0.3, reason.code)
    response = core.response(reply, f"{BACK_UP}_GetResult")
    assert (response.status, response.result.error_code) == (GoalState.ABORTED, code)
    assert reason.text in response.result.error_msg


LOCAL, GLOBAL = (f"/{part}_costmap/{{0}}_{part}_costmap" for part in ("local", "global"))


def clear(core: Core, name: str, type_: str = CLEAR_COSTMAP, side: float | None = None) -> list[Any]:
    """What follows from a request. side: m, of a square."""
    empty = {"request": core.make.new("std_msgs/msg/Empty")}
    request = core.make.new(f"{type_}_Request", **(empty if side is None else {"reset_distance": side}))
    return core.request(name, 4, request)


@pytest.mark.parametrize("distro", Distro)
@pytest.mark.parametrize(
    ("verb", "type_", "side", "asked"),
    [
        ("clear_entirely", CLEAR_COSTMAP, None, (0.0, False)),
        ("clear_around", CLEAR_AROUND, 2.5, (2.5, False)),
        ("clear_except", CLEAR_EXCEPT, 2.5, (2.5, True)),
    ],
)
def test_the_local_costmap_is_cleared_and_the_reply_comes_when_it_is(distro, verb, type_, side, asked):
    core = Core(distro=distro)
    [ask] = clear(core, LOCAL.format(verb), type_, side)
    request = core.asked(ask)
    assert isinstance(request, ClearCostmaps)
    assert (request.side, request.outside) == asked
    [reply] = core.outcome(ask)
    assert core.response(reply, type_).__msgtype__ == f"{type_}_Response"


@pytest.mark.parametrize(
    ("verb", "type_", "side"),
    [("clear_entirely", CLEAR_COSTMAP, None), ("clear_around", CLEAR_AROUND, 2.5), ("clear_except", CLEAR_EXCEPT, 2.5)],
)
def test_the_global_costmap_has_nothing_to_clear_and_the_log_says_so(verb, type_, side):
    core = Core()
    [reply] = clear(core, GLOBAL.format(verb), type_, side)
    assert core.response(reply, type_).__msgtype__ == f"{type_}_Response"
    assert "nothing to clear" in core.lines[-1]


@pytest.mark.parametrize("side", [0.0, -1.0, float("nan"), float("inf")])
def test_a_square_that_is_none_is_refused_in_words(side):
    core = Core()
    [reply] = clear(core, LOCAL.format("clear_around"), CLEAR_AROUND, side)
    assert reply["data"] == b""
    assert "reset_distance" in core.lines[-1]


def test_a_costmap_that_is_not_cleared_gets_no_reply_and_a_log_line():
    core = Core()
    [ask] = clear(core, LOCAL.format("clear_entirely"))
    [reply] = core.outcome(ask, accepted=False)
    assert reply["data"] == b""
    assert "clear_entirely" in core.lines[-1]
