# SPDX-License-Identifier: Apache-2.0
"""Nav2's actions Spin, BackUp and DriveOnHeading, and its services that clear the costmaps."""

from typing import Any

import pytest

from services.ros2.action_goal import GoalState
from services.ros2.action_topics import NAMES
from services.ros2.incoming_topics import CLEAR_COSTMAP
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


def clear(core: Core, name: str) -> Any:
    """The order of the request to the stack."""
    request = core.make.new(f"{CLEAR_COSTMAP}_Request", request=core.make.new("std_msgs/msg/Empty"))
    [ask] = core.request(name, 4, request)
    return ask


@pytest.mark.parametrize("part", ["local", "global"])
def test_a_costmap_is_cleared_and_the_reply_comes_when_it_is(part):
    core = Core()
    ask = clear(core, f"/{part}_costmap/clear_entirely_{part}_costmap")
    assert isinstance(core.asked(ask), ClearCostmaps)
    [reply] = core.outcome(ask)
    assert core.response(reply, CLEAR_COSTMAP).__msgtype__ == f"{CLEAR_COSTMAP}_Response"


def test_a_costmap_that_is_not_cleared_gets_no_reply_and_a_log_line():
    core = Core()
    [reply] = core.outcome(clear(core, "/local_costmap/clear_entirely_local_costmap"), accepted=False)
    assert reply["data"] == b""
    assert "clear_entirely" in core.lines[-1]
