# SPDX-License-Identifier: Apache-2.0
"""Actions as rclpy's clients see them: goals, feedback, results and cancellation."""

import re
from pathlib import Path
from typing import Any

import pytest

from services.ros2.action_goal import GoalState
from services.ros2.action_server import KEPT_NS, MAX_GOALS, CancelCode
from services.ros2.nav2_errors import CONTROLLER_ERRORS, PLANNER_ERRORS, navigation_error
from services.ros2.ros_types import Distro
from shared.geometry import Pose2
from shared.messages import NavState
from shared.reasons import reason_text
from shared.requests import Cancel, Navigate
from tests.unit.services.ros2.core import GOAL, Core

TO_POSE, TYPE = "/navigate_to_pose", "nav2_msgs/action/NavigateToPose"
WAYPOINTS, THROUGH = (f"nav2_msgs/action/{kind}" for kind in ("FollowWaypoints", "NavigateThroughPoses"))
OTHER = bytes(range(16, 32))


def sent(core: Core, number: int = 1, goal: bytes = GOAL, task_id: int = 7, accepted: bool = True) -> list[Any]:
    """A goal that the navigator accepts, or not."""
    [ask] = core.send_goal(TO_POSE, TYPE, number, goal, pose=core.pose(Pose2(1, 2, 0.5)), behavior_tree="")
    return core.outcome(ask, accepted, task_id)


def states(core: Core, orders: list[Any], action: str = TO_POSE) -> list[int]:
    """The states in the newest message of an action's status topic."""
    [*_, order] = [order for order in orders if order.get("publish") == f"{action}/_action/status"]
    return [row.status for row in core.types.decode(order["data"], "action_msgs/msg/GoalStatusArray").status_list]


def test_a_goal_is_the_navigators_request_and_accepted_when_that_is():
    core = Core()
    [ask] = core.send_goal(TO_POSE, TYPE, 1, pose=core.pose(Pose2(1, 2, 0.5)), behavior_tree="")
    request = core.asked(ask)
    assert isinstance(request, Navigate)
    assert (request.poses[0].x, request.poses[0].y) == (1, 2)
    assert request.poses[0].yaw == pytest.approx(0.5)
    reply, status = core.outcome(ask)
    assert reply["reply"] == 1
    assert core.response(reply, f"{TYPE}_SendGoal").accepted
    assert states(core, [status]) == [GoalState.EXECUTING]


def test_a_goal_that_the_navigator_refuses_is_rejected():
    core = Core()
    [reply] = sent(core, accepted=False)
    assert not core.response(reply, f"{TYPE}_SendGoal").accepted


@pytest.mark.parametrize("frame", ["odom", "base_link"])
def test_a_goal_in_another_frame_is_rejected_and_counted(frame):
    core = Core()
    [reply] = core.send_goal(TO_POSE, TYPE, 1, pose=core.pose(Pose2(), frame), behavior_tree="")
    assert not core.response(reply, f"{TYPE}_SendGoal").accepted
    assert sum(core.service.rejections.counts.values()) == 1
    assert f"'{frame}'" in core.lines[-1]


def test_feedback_has_the_navigators_progress():
    core = Core()
    sent(core)
    [order] = core.status(NavState.NAVIGATING)
    assert order["publish"] == f"{TO_POSE}/_action/feedback"
    message = core.types.decode(order["data"], f"{TYPE}_FeedbackMessage")
    assert bytes(message.goal_id.uuid) == GOAL
    assert message.feedback.distance_remaining == 3.5
    assert message.feedback.estimated_time_remaining.sec == 7
    assert message.feedback.estimated_time_remaining.nanosec == 250_000_000
    assert message.feedback.number_of_recoveries == 1


@pytest.mark.parametrize(
    ("end", "state", "error"),
    [
        (NavState.REACHED, GoalState.SUCCEEDED, False),
        (NavState.FAILED, GoalState.ABORTED, True),
        (NavState.CANCELED, GoalState.ABORTED, True),  # by another user: ROS did not cancel it
    ],
)
def test_the_end_of_the_task_is_the_result_for_all_that_wait(end, state, error):
    core = Core()
    sent(core)
    assert core.get_result(TO_POSE, TYPE, 11) == []
    assert core.get_result(TO_POSE, TYPE, 12) == []
    first, second, status = core.status(end, reason="goal_blocked" if error else "")
    assert (first["reply"], second["reply"]) == (11, 12)
    response = core.response(first, f"{TYPE}_GetResult")
    assert response.status == state
    assert bool(response.result.error_msg) == error
    assert bool(response.result.error_code) == error
    assert states(core, [status]) == [state]
    [later] = core.get_result(TO_POSE, TYPE, 13)
    assert core.response(later, f"{TYPE}_GetResult").status == state


def test_the_result_of_an_unknown_goal_is_unknown():
    core = Core()
    [reply] = core.get_result(TO_POSE, TYPE, 3)
    assert core.response(reply, f"{TYPE}_GetResult").status == GoalState.UNKNOWN


def test_a_canceled_goal_ends_when_the_navigator_stands():
    core = Core()
    sent(core)
    reply, status, ask = core.cancel(TO_POSE, 5, GOAL)
    response = core.response(reply, "action_msgs/srv/CancelGoal")
    assert response.return_code == CancelCode.NONE
    assert [bytes(info.goal_id.uuid) for info in response.goals_canceling] == [GOAL]
    assert states(core, [status]) == [GoalState.CANCELING]
    assert isinstance(core.asked(ask), Cancel)
    core.outcome(ask)
    assert states(core, core.status(NavState.CANCELED)) == [GoalState.CANCELED]


def test_a_cancel_without_an_answer_is_repeated_each_second_while_the_task_goes_on():
    core = Core()
    sent(core)
    *_, ask = core.cancel(TO_POSE, 5, GOAL)
    core.outcome(ask, accepted=False)
    orders = [order for _ in range(25) for order in core.status(NavState.NAVIGATING) if "ask" in order]
    assert [type(core.asked(order)) for order in orders] == [Cancel, Cancel]
    assert states(core, core.status(NavState.CANCELED)) == [GoalState.CANCELED]
    assert [order for _ in range(25) for order in core.status(NavState.CANCELED)] == []


def test_a_cancel_without_an_id_is_for_all_goals():
    core = Core()
    sent(core)
    reply, *_ = core.cancel(TO_POSE, 5)
    assert len(core.response(reply, "action_msgs/srv/CancelGoal").goals_canceling) == 1


@pytest.mark.parametrize(("goal", "code"), [(OTHER, CancelCode.UNKNOWN_GOAL), (GOAL, CancelCode.TERMINATED)])
def test_a_cancel_of_no_running_goal_is_refused_with_its_code(goal, code):
    core = Core()
    sent(core)
    core.status(NavState.REACHED)
    [reply] = core.cancel(TO_POSE, 5, goal)
    assert core.response(reply, "action_msgs/srv/CancelGoal").return_code == code


def test_a_new_goal_ends_the_former_one():
    core = Core()
    sent(core)
    orders = sent(core, 2, OTHER, task_id=8)
    assert states(core, orders) == [GoalState.ABORTED, GoalState.EXECUTING]
    [feedback] = core.status(NavState.NAVIGATING, task_id=8)
    assert bytes(core.types.decode(feedback["data"], f"{TYPE}_FeedbackMessage").goal_id.uuid) == OTHER


def test_of_two_goals_at_once_the_navigators_later_one_runs_in_whatever_order_its_replies_come():
    core = Core()
    fields = {"pose": core.pose(Pose2()), "behavior_tree": ""}
    [first], [second] = (core.send_goal(TO_POSE, TYPE, i, goal, **fields) for i, goal in enumerate((GOAL, OTHER)))
    core.outcome(second, task_id=8)
    _, status = core.outcome(first, task_id=7)
    assert states(core, [status]) == [GoalState.EXECUTING, GoalState.ABORTED]
    [feedback] = core.status(NavState.NAVIGATING, task_id=8)
    assert bytes(core.types.decode(feedback["data"], f"{TYPE}_FeedbackMessage").goal_id.uuid) == OTHER
    reply, *_ = core.cancel(TO_POSE, 5)
    assert len(core.response(reply, "action_msgs/srv/CancelGoal").goals_canceling) == 1


def test_a_goal_of_a_navigator_that_counts_from_0_again_replaces_the_former_one():
    core = Core()
    sent(core)
    orders = sent(core, 2, OTHER, task_id=1)
    assert states(core, orders) == [GoalState.ABORTED, GoalState.EXECUTING]


def test_the_status_of_an_earlier_task_is_not_the_goals():
    core = Core()
    core.status(NavState.REACHED, task_id=6)
    sent(core)
    assert core.status(NavState.REACHED, task_id=6) == []


def test_a_navigator_that_counts_from_0_again_ends_the_goal_as_interrupted():
    core = Core()
    sent(core)
    core.get_result(TO_POSE, TYPE, 11)
    core.status(NavState.NAVIGATING)
    orders = [order for _ in range(25) for order in core.status(NavState.IDLE, task_id=0)]
    result, status = orders
    assert states(core, [status]) == [GoalState.ABORTED]
    response = core.response(result, f"{TYPE}_GetResult")
    assert response.result.error_msg == reason_text("interrupted")
    assert core.status(NavState.REACHED) == []  # another user's seventh task


def test_a_short_time_with_an_earlier_task_does_not_end_the_goal():
    core = Core()
    sent(core)
    for _ in range(3):
        assert [order for _ in range(15) for order in core.status(NavState.IDLE, task_id=0)] == []
        core.status(NavState.NAVIGATING)
    assert states(core, core.status(NavState.REACHED)) == [GoalState.SUCCEEDED]


def test_a_task_of_another_user_ends_the_goal():
    core = Core()
    sent(core)
    assert states(core, core.status(NavState.NAVIGATING, task_id=8)) == [GoalState.ABORTED]


def test_one_goal_id_is_accepted_once():
    core = Core()
    sent(core)
    [reply] = core.send_goal(TO_POSE, TYPE, 2, pose=core.pose(Pose2()), behavior_tree="")
    assert not core.response(reply, f"{TYPE}_SendGoal").accepted


def test_old_results_are_forgotten():
    core = Core()
    for i in range(MAX_GOALS + 5):
        sent(core, i, bytes([i] * 16), task_id=7 + i)
        orders = core.status(NavState.REACHED, task_id=7 + i)
    assert len(states(core, orders)) == MAX_GOALS
    core.service.now += KEPT_NS
    assert len(states(core, sent(core, 99, bytes([99] * 16), task_id=99))) == 1


def test_the_result_of_a_long_task_is_kept_from_its_end_on():
    core = Core()
    sent(core)
    core.service.now += 2 * KEPT_NS
    core.status(NavState.REACHED)
    assert states(core, sent(core, 2, OTHER, task_id=8)) == [GoalState.SUCCEEDED, GoalState.EXECUTING]


def follow_waypoints(core: Core, n_poses: int = 3, **fields: Any) -> list[Any]:
    poses = [core.pose(Pose2(x, 0, 0)) for x in range(n_poses)]
    return core.send_goal("/follow_waypoints", WAYPOINTS, 1, poses=poses, **fields)


def current_waypoint(core: Core, waypoint: int) -> int:
    """In the feedback, where the navigator is at this pose of its route."""
    [order] = core.status(NavState.NAVIGATING, waypoint=waypoint)
    return core.types.decode(order["data"], f"{WAYPOINTS}_FeedbackMessage").feedback.current_waypoint


@pytest.mark.parametrize(
    ("index", "loops", "xs", "rounds"),
    [(0, 2, [0, 1, 2], 3), (1, 0, [1, 2], 1), (1, 2, [1, 2, 0, 1, 2, 0, 1, 2], 1), (2, 0, [2], 1)],
)
def test_waypoints_are_a_route_with_its_loops(index, loops, xs, rounds):
    """As in Nav2, the loops after the first one begin with the first pose, and the feedback has the pose's number."""
    core = Core()
    [ask] = follow_waypoints(core, number_of_loops=loops, goal_index=index)
    request = core.asked(ask)
    assert isinstance(request, Navigate)
    assert ([pose.x for pose in request.poses], request.loops) == (xs, rounds)
    core.outcome(ask)
    assert [current_waypoint(core, i) for i in range(len(xs))] == xs


@pytest.mark.parametrize(("index", "loops"), [(3, 0), (1, 2**32 - 1), (0, 2**32 - 1), (1, 9999)])
def test_waypoints_from_a_pose_that_is_none_or_for_too_long_are_refused(index, loops):
    core = Core()
    [reply] = follow_waypoints(core, number_of_loops=loops, goal_index=index)
    assert not core.response(reply, f"{WAYPOINTS}_SendGoal").accepted


@pytest.mark.parametrize("distro", Distro)
def test_the_waypoint_at_which_a_route_fails_is_missed(distro):
    core = Core(distro=distro)
    [ask] = follow_waypoints(core, **({} if distro is Distro.HUMBLE else {"number_of_loops": 0, "goal_index": 1}))
    core.outcome(ask)
    core.status(NavState.NAVIGATING, waypoint=1)
    core.get_result("/follow_waypoints", WAYPOINTS, 4)
    reply, _ = core.status(NavState.FAILED, reason="unreachable")
    result = core.response(reply, f"{WAYPOINTS}_GetResult").result
    [missed] = result.missed_waypoints
    if distro is Distro.HUMBLE:
        assert missed == 1
    elif distro is Distro.JAZZY:
        assert (missed.index, missed.error_code, missed.goal.pose.position.x) == (2, 208, 2)
        assert result.error_code == 600
    else:
        assert (missed.waypoint_index, missed.waypoint_status, missed.error_code) == (2, 3, 208)
        assert missed.waypoint_pose.pose.position.x == 2
        assert result.error_code == 603
        assert missed.error_msg == result.error_msg != ""


@pytest.mark.parametrize(("end", "error"), [(NavState.REACHED, False), (NavState.CANCELED, True)])
def test_no_waypoint_is_missed_where_the_route_ends_or_another_user_ends_it(end, error):
    core = Core()
    [ask] = follow_waypoints(core, number_of_loops=0, goal_index=0)
    core.outcome(ask)
    core.get_result("/follow_waypoints", WAYPOINTS, 4)
    reply, _ = core.status(end)
    result = core.response(reply, f"{WAYPOINTS}_GetResult").result
    assert (result.missed_waypoints, bool(result.error_code)) == ([], error)


def test_a_route_through_no_poses_is_rejected():
    core = Core()
    [reply] = core.send_goal("/navigate_through_poses", THROUGH, 1, poses=[], behavior_tree="")
    assert not core.response(reply, f"{THROUGH}_SendGoal").accepted


def goals(core: Core, poses: list[Any], frame: str) -> Any:
    return core.make.new("nav_msgs/msg/Goals", header=core.make.header(0, frame), goals=poses)


def through_poses(core: Core) -> list[Any]:
    poses = [core.pose(Pose2(x, 0, 0), "") for x in range(3)]
    return core.send_goal("/navigate_through_poses", THROUGH, 1, poses=goals(core, poses, "map"), behavior_tree="")


def test_poses_without_a_frame_have_that_of_their_goals():
    core = Core(distro=Distro.KILTED)
    poses = [core.pose(Pose2(), "")]
    fields = {"poses": goals(core, poses, "odom"), "behavior_tree": ""}
    [reply] = core.send_goal("/navigate_through_poses", THROUGH, 1, **fields)
    assert not core.response(reply, f"{THROUGH}_SendGoal").accepted
    assert "'odom'" in core.lines[-1]


@pytest.mark.parametrize(
    ("end", "reason", "ending"),
    [
        (NavState.REACHED, "", [1, 1, 1]),
        (NavState.FAILED, "goal_blocked", [1, 3, 0]),
        (NavState.CANCELED, "", [1, 0, 0]),
    ],
)
def test_kilted_has_the_state_of_each_pose_in_feedback_and_result(end, reason, ending):
    core = Core(distro=Distro.KILTED)
    [ask] = through_poses(core)
    request = core.asked(ask)
    assert isinstance(request, Navigate)
    assert [pose.x for pose in request.poses] == [0, 1, 2]
    core.outcome(ask)
    [order] = core.status(NavState.NAVIGATING, waypoint=1)
    feedback = core.types.decode(order["data"], f"{THROUGH}_FeedbackMessage").feedback
    assert [row.waypoint_status for row in feedback.waypoint_statuses] == [1, 0, 0]
    assert [row.waypoint_pose.pose.position.x for row in feedback.waypoint_statuses] == [0, 1, 2]
    assert feedback.number_of_poses_remaining == 2
    core.get_result("/navigate_through_poses", THROUGH, 4)
    reply, _ = core.status(end, reason=reason)
    result = core.response(reply, f"{THROUGH}_GetResult").result
    assert [row.waypoint_status for row in result.waypoint_statuses] == ending
    assert max(row.error_code for row in result.waypoint_statuses) == (306 if reason else 0)


def failed(core: Core, action: str, type_: str, ask: dict[str, Any], *causes: str) -> Any:
    """The result of a goal whose recoveries have all causes but the last one, for which it fails."""
    core.outcome(ask)
    for cause in causes[:-1]:
        core.status(NavState.RECOVERING, reason=cause)
    core.get_result(action, type_, 4)
    reply, _ = core.status(NavState.FAILED, reason=causes[-1])
    return core.response(reply, f"{type_}_GetResult").result


@pytest.mark.parametrize(
    ("causes", "to_pose", "through"),
    [
        (("goal_outside",), 204, 304),
        (("start_outside",), 203, 303),
        (("start_blocked",), 205, 305),
        (("goal_blocked",), 206, 306),
        (("goal_keep_out",), 206, 306),
        (("no_map",), 207, 307),
        (("unreachable",), 208, 308),
        (("pose_lost",), 202, 302),
        (("odom_old",), 102, 102),
        (("no_progress",), 105, 105),
        (("recoveries_used",), 105, 105),
        (("blocked", "recoveries_used"), 106, 106),
        (("blocked", "unreachable", "recoveries_used"), 208, 308),
        (("scan_old",), 107, 107),
        (("other_map",), 9000, 9100),
    ],
)
@pytest.mark.parametrize("distro", [Distro.JAZZY, Distro.KILTED])
def test_a_failure_has_the_code_of_nav2s_planner_or_controller(distro, causes, to_pose, through):
    core = Core(distro=distro)
    [ask] = core.send_goal(TO_POSE, TYPE, 1, pose=core.pose(Pose2(1, 2, 0.5)), behavior_tree="")
    result = failed(core, TO_POSE, TYPE, ask, *causes)
    assert result.error_code == to_pose
    assert reason_text(causes[-1]) in result.error_msg
    core = Core(distro=distro)
    poses = [core.pose(Pose2(x, 0, 0)) for x in range(3)]
    given = goals(core, poses, "map") if distro is Distro.KILTED else poses
    [ask] = core.send_goal("/navigate_through_poses", THROUGH, 1, poses=given, behavior_tree="")
    assert failed(core, "/navigate_through_poses", THROUGH, ask, *causes).error_code == through


@pytest.mark.parametrize("distro", Distro)
def test_the_result_has_the_shape_of_the_distribution(distro):
    core = Core(distro=distro)
    sent(core)
    core.get_result(TO_POSE, TYPE, 4)
    reply, _ = core.status(NavState.REACHED)
    assert core.response(reply, f"{TYPE}_GetResult").status == GoalState.SUCCEEDED


def test_a_damaged_request_is_ended_and_counted():
    core = Core()
    [order] = core.event(event="request", name=f"{TO_POSE}/_action/send_goal", id=9, data=b"\x00\x01\x00\x00\xff")
    assert order == {"reply": 9, "data": b""}
    assert sum(core.service.rejections.counts.values()) == 1


def test_a_goal_with_a_behavior_tree_is_refused_in_words():
    core = Core()
    [reply] = core.send_goal(TO_POSE, TYPE, 1, pose=core.pose(Pose2()), behavior_tree="/my_tree.xml")
    assert not core.response(reply, f"{TYPE}_SendGoal").accepted
    assert "there are no behavior trees here" in core.lines[-1]


def test_the_table_of_the_docs_has_these_codes_and_every_reason_that_has_one():
    text = (Path(__file__).parents[4] / "docs" / "ros2.md").read_text()
    rows = re.findall(r"^\| (`.*`) \| (\d+) \| (\d+) \|", text, re.MULTILINE)
    codes = {code: (int(a), int(b)) for cell, a, b in rows for code in re.findall(r"`(\w+)`", cell)}
    kinds = "NavigateToPose", "NavigateThroughPoses"
    known = {code: tuple(navigation_error(kind, code) for kind in kinds) for code in codes}
    assert known == codes
    assert codes.keys() == (PLANNER_ERRORS.keys() | CONTROLLER_ERRORS.keys()) - {"recoveries_used"}
