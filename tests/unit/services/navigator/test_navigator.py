# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.navigator.config import NavigatorConfig
from services.navigator.goal_attempt import AttemptAction, GoalAttempt, GoalAttemptConfig
from services.navigator.recovery import RecoveryConfig, recovery_steps
from services.navigator.service import NavigatorService
from shared import reasons
from shared.geometry import Pose2
from shared.messages import FollowState, FollowStatus, GuardState, Localization, NavState, Path, RecoveryKind
from shared.requests import Navigate
from shared.service import Job, Log
from tests.strategies import faults, publications
from tests.unit.services.navigator.bench import X80, NavigatorBench, S, stopped

ENDS = {NavState.REACHED, NavState.FAILED, NavState.CANCELED}
FAR, NEAR = Pose2(5.0, 1.0, 1.0), Pose2(1.0, 0.0)
LADDER = ["replan", "clear_costmap", "back_up", "turn_left", "turn_right", "wait"]


def names(bench):
    """The recoveries in the order in which they were seen."""
    seen = [s.recovery for s in bench.statuses if s.recovery]
    return [name for i, name in enumerate(seen) if i == 0 or seen[i - 1] != name]


def test_a_fresh_navigator_stops_whatever_one_before_it_had_started():
    bench = NavigatorBench()
    bench.run(0.2)
    assert [goal.active for goal in bench.goals] == [False]
    assert bench.status.state is NavState.IDLE


def test_a_restarted_navigators_goals_have_larger_numbers():
    bench = NavigatorBench()
    bench.go(*[FAR, NEAR] * 20)
    bench.run(10)
    after = NavigatorBench()
    after.now = bench.now
    after.go(NEAR)
    assert after.goal.id > bench.goal.id


def test_it_goes_to_a_pose_and_says_so():
    bench = NavigatorBench()
    reply = bench.go(FAR)
    assert (reply.accepted, reply.task_id) == (True, 1)
    assert (bench.goal.active, bench.goal.map_from_goal) == (True, FAR)
    bench.run(3)
    assert bench.status.state is NavState.NAVIGATING
    assert bench.status.reason == ""
    assert 2.0 < bench.status.distance_left < 5.1
    assert bench.status.time_left == pytest.approx(bench.status.distance_left / 0.5, rel=0.3)
    bench.run(20, until=ENDS)
    assert (bench.status.state, bench.status.reason) == (NavState.REACHED, "")
    assert stopped(bench)
    bench.run(5)
    assert bench.status.state is NavState.REACHED  # until the next task


def test_feedback_comes_five_times_a_second():
    bench = NavigatorBench()
    bench.go(FAR)
    n = len(bench.statuses)
    bench.run(4)
    assert len(bench.statuses) - n == 20


def test_a_new_task_takes_the_place_of_the_old_without_a_stop():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    assert bench.go(Pose2(-3.0, 0.0)).task_id == 2
    assert [order.active for order in bench.orders] == [True, True]
    bench.run(30, until=ENDS)
    assert bench.pose.x == pytest.approx(-3.0, abs=0.2)


def test_arriving_at_a_former_goal_is_not_arriving():
    bench = NavigatorBench()
    bench.go(NEAR)
    bench.run(1)
    late = bench.goal.id
    bench.go(FAR)
    bench.run(0.1)
    bench.call("follow", FollowStatus(bench.now, late, FollowState.ARRIVED, "", 0.0))
    assert bench.status.state is NavState.NAVIGATING
    assert bench.goal.map_from_goal == FAR


def test_a_route_is_followed_in_rounds_with_a_stay_at_each_pose():
    bench = NavigatorBench()
    poses = (Pose2(1.0, 0.0), Pose2(1.0, 1.0), Pose2(0.0, 1.0))
    bench.go(*poses, dwell=2.0, loops=2)
    bench.run(1)
    assert (bench.status.waypoint, bench.status.n_waypoints) == (0, 3)
    bench.run(60, until=ENDS)
    assert bench.status.state is NavState.REACHED
    driven = [goal.map_from_goal for goal in bench.goals if goal.active]
    assert driven == [*poses, *poses]
    stays = [b.stamp - a.stamp for a, b in pairwise(bench.goals) if not a.active]
    assert all(2.0 <= stay / S <= 2.4 for stay in stays)
    assert len(stays) == 6


def test_each_pose_has_its_own_stay_and_the_robot_says_that_it_stays():
    bench = NavigatorBench()
    poses = (Pose2(1.0, 0.0), Pose2(1.0, 1.0), Pose2(0.0, 1.0))
    bench.ask("navigate", Navigate(bench.now, poses, 0.0, 2, True, (3.0, 0.0, 1.0)))
    bench.run(60, until=ENDS)
    assert bench.status.state is NavState.REACHED
    stays = [b.stamp - a.stamp for a, b in pairwise(bench.goals) if not a.active]
    assert [round(stay / S) for stay in stays] == [3, 1, 3, 1]
    waits = [s for s in bench.statuses if s.reason == reasons.DWELLING.code]
    assert {(s.waypoint, s.round, s.n_rounds) for s in waits} == {(0, 0, 2), (2, 0, 2), (0, 1, 2), (2, 1, 2)}
    first = next(s for s in waits if s.waypoint == 0)
    assert first.time_left > 3.0 + 1.0


def test_a_pose_without_stay_or_heading_is_passed_and_the_last_is_stopped_at():
    bench = NavigatorBench()
    bench.follow_state = FollowState.FOLLOWING  # local control never says that it arrived
    bench.go(Pose2(1.0, 0.0), Pose2(2.0, 0.0), any_heading=True)
    bench.pose = Pose2(0.8, 0.0)
    bench.run(1)
    assert bench.status.waypoint == 0
    bench.pose = Pose2(0.9, 0.0)
    bench.run(1)
    assert [order.active for order in bench.orders] == [True, True]
    assert bench.status.waypoint == 1
    bench.pose = Pose2(1.95, 0.0)
    bench.run(1)
    assert (bench.status.state, bench.status.waypoint) == (NavState.NAVIGATING, 1)


def test_a_route_that_passes_through_stops_at_its_last_pose_only_whose_heading_alone_counts():
    bench = NavigatorBench()
    bench.follow_state = FollowState.FOLLOWING
    poses = (Pose2(2.0, 0.0, 1.5), Pose2(4.0, 0.0, -1.5))
    bench.ask("navigate", Navigate(bench.now, poses, 3.0, 2, any_heading=False, dwells=(3.0, 3.0), pass_through=True))
    within = NavigatorConfig().pass_within
    orders = []
    for target in (*poses, *poses):
        bench.pose = Pose2(target.x - within - 0.1, 0.0)
        bench.run(1)
        orders.append((bench.goal.map_from_goal.x, bench.goal.yaw_tolerance))
        bench.pose = Pose2(target.x - within + 0.1, 0.0)
        bench.run(1)
    assert [x for x, _ in orders] == [2.0, 4.0, 2.0, 4.0]
    assert min(yaw for _, yaw in orders[:3]) > np.pi > orders[3][1]
    assert all(order.active for order in bench.orders)
    assert bench.status.state is NavState.NAVIGATING, "the last pose is stopped at"
    bench.follow_state = FollowState.ARRIVED
    bench.run(60, until=ENDS)
    assert bench.status.state is NavState.REACHED


def test_a_pose_is_passed_by_the_way_of_its_own_plan_and_not_of_the_one_before():
    """The second pose lies beside the first one, behind a wall."""
    bench = NavigatorBench()
    poses = (Pose2(2.0, 0.0), Pose2(2.0, 0.3), Pose2(9.0, 0.0))
    bench.ask("navigate", Navigate(bench.now, poses, 0.0, 1, True, dwells=(0.0,) * 3, pass_through=True))
    bench.pose = Pose2(1.6, 0.0)
    bench.step()
    bench.follow_state = FollowState.FOLLOWING
    bench.step()
    assert bench.status.waypoint == 0
    assert bench.goal.map_from_goal == poses[1]
    seen = []
    for length in (None, 8.0, 0.65):
        if length is not None:
            bench.call("plan", replace(bench.path(), length=length))
        bench.call("follow", FollowStatus(bench.now, bench.goal.id, FollowState.FOLLOWING, "", 0.6))
        seen.append(bench.goal.map_from_goal)
    assert seen == [poses[1], poses[1], poses[2]]


def test_a_pose_that_wants_a_heading_and_a_patrol_of_one_place_are_not_passed():
    for poses, any_heading in (((Pose2(1.0, 0.0), Pose2(2.0, 0.0)), False), ((Pose2(1.0, 0.0),), True)):
        bench = NavigatorBench()
        bench.follow_state = FollowState.FOLLOWING
        bench.go(*poses, any_heading=any_heading, loops=0)
        bench.pose = Pose2(0.9, 0.0)
        bench.run(1)
        assert len(bench.orders) == 1


def test_a_recovery_that_the_limits_of_local_control_forbid_is_followed_by_the_next_one_at_once():
    """As with local_ctrl.max_reverse_speed 0 on a robot that may drive backward."""
    bench = NavigatorBench()
    bench.follow_state = FollowState.BLOCKED
    bench.go(FAR)
    while not bench.recoveries:
        bench.step()
    (backs_up,) = bench.recoveries
    bench.follow_reason = reasons.NO_REVERSE.code
    bench.act = lambda: FollowState.FAILED if bench.orders[-1] is backs_up else FollowState.FOLLOWING
    bench.run(0.3)
    assert [order.kind for order in bench.recoveries] == [RecoveryKind.BACK_UP, RecoveryKind.TURN]
    assert bench.orders[-2:] == [backs_up, bench.recoveries[-1]]
    assert (bench.status.recovery, bench.status.n_recoveries) == ("turn_left", 4)


def test_a_recovery_is_told_with_its_place_in_the_order_and_its_cause():
    bench = NavigatorBench()
    bench.follow_state, bench.follow_reason = FollowState.BLOCKED, reasons.BLOCKED.code
    bench.go(FAR)
    bench.run(300, until=ENDS)
    told = {s.recovery: s for s in bench.statuses if s.recovery}
    assert told["back_up"].detail == f"back_up, 3 of 6: {reasons.BLOCKED.text}"
    assert told["back_up"].state is NavState.RECOVERING
    assert told["back_up"].reason == reasons.BLOCKED.code


def test_a_patrol_goes_on_until_it_is_canceled():
    bench = NavigatorBench()
    bench.go(Pose2(0.6, 0.0), Pose2(0.0, 0.6), loops=0)
    bench.run(60)
    assert sum(goal.active for goal in bench.goals) > 10
    assert bench.status.state is NavState.NAVIGATING
    assert bench.cancel().accepted
    assert (bench.status.state, bench.status.reason) == (NavState.CANCELED, reasons.CANCELED.code)
    assert stopped(bench)


def test_a_pause_keeps_the_task_and_stops_the_clocks():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    assert bench.pause().accepted
    assert stopped(bench)
    bench.run(200)
    assert (bench.status.state, bench.status.reason) == (NavState.PAUSED, reasons.PAUSED.code)
    x = bench.pose.x
    bench.pause(False)
    assert bench.goal.map_from_goal == FAR
    bench.run(20, until=ENDS)
    assert bench.status.state is NavState.REACHED
    assert x < 4.0
    assert bench.status.n_recoveries == 0


def test_without_a_task_there_is_nothing_to_pause_and_cancel_is_granted():
    bench = NavigatorBench()
    assert not bench.pause().accepted
    assert bench.cancel().accepted
    assert not bench.orders


@pytest.mark.parametrize("reason", [reasons.GOAL_OUTSIDE, reasons.GOAL_BLOCKED, reasons.GOAL_UNKNOWN])
def test_a_goal_that_the_planner_refuses_fails_promptly_with_its_reason(reason):
    bench = NavigatorBench()
    bench.refusal = reason.code
    bench.go(FAR)
    assert bench.run(10, until=ENDS) < 2
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reason.code)
    assert reason.hint in bench.status.detail
    assert stopped(bench)


def test_an_unreachable_goal_fails_after_a_short_while():
    bench = NavigatorBench()
    bench.refusal = reasons.UNREACHABLE.code
    bench.go(FAR)
    assert 2 < bench.run(10, until=ENDS) < 5
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.UNREACHABLE.code)
    assert bench.status.n_recoveries == 0


def test_a_person_in_the_doorway_for_ten_seconds_does_not_end_the_task():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    bench.refusal = reasons.UNREACHABLE.code
    bench.run(10)
    assert bench.status.reason == reasons.UNREACHABLE.code
    bench.refusal = ""
    bench.run(30, until=ENDS)
    assert bench.status.state is NavState.REACHED
    assert not {RecoveryKind.BACK_UP, RecoveryKind.TURN} & {recovery.kind for recovery in bench.recoveries}


def test_a_way_that_stays_closed_fails_with_the_planners_reason():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    bench.refusal = reasons.UNREACHABLE.code
    assert bench.run(60, until=ENDS) < 30
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.UNREACHABLE.code)


def test_while_the_stack_starts_it_waits_with_the_reason_and_not_for_ever():
    bench = NavigatorBench()
    bench.refusal = reasons.NO_MAP.code
    bench.go(FAR)
    bench.run(15)
    assert (bench.status.state, bench.status.reason) == (NavState.NAVIGATING, reasons.NO_MAP.code)
    assert bench.run(30, until=ENDS) < 10
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.NO_MAP.code)


def test_after_a_late_start_of_the_planner_no_recovery_is_needed():
    bench = NavigatorBench()
    bench.refusal = reasons.NO_MAP.code
    bench.go(FAR)
    bench.run(15)
    bench.refusal = ""
    bench.run(30, until=ENDS)
    assert (bench.status.state, bench.status.n_recoveries) == (NavState.REACHED, 0)


@pytest.mark.parametrize("state", [FollowState.FOLLOWING, FollowState.BLOCKED, FollowState.FAILED, FollowState.IDLE])
def test_a_robot_that_never_comes_closer_tries_every_recovery_in_order_and_fails(state):
    bench = NavigatorBench()
    bench.follow_state = state
    bench.go(FAR)
    assert bench.run(300, until=ENDS) < 120
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.RECOVERIES_USED.code)
    assert names(bench) == LADDER
    assert bench.status.n_recoveries == len(LADDER)
    assert stopped(bench)
    actions = [(recovery.kind, round(recovery.amount, 2)) for recovery in bench.recoveries]
    assert actions == [
        (RecoveryKind.BACK_UP, 0.3),
        (RecoveryKind.TURN, 1.57),
        (RecoveryKind.TURN, -1.57),
        (RecoveryKind.WAIT, 5.0),
    ]
    assert [goal.clear_costmap for goal in bench.goals if goal.active][:3] == [False, False, True]


@pytest.mark.parametrize("silent", ["plan", "follow", "pose", "odom"])
def test_whoever_falls_silent_the_task_ends(silent):
    bench = NavigatorBench()
    bench.follow_state = FollowState.FOLLOWING
    bench.go(FAR)
    bench.run(1)
    bench.silent = {silent}
    assert bench.run(400, until=ENDS) < 200
    assert bench.status.state is NavState.FAILED
    assert bench.status.reason


def test_local_control_that_never_finishes_a_recovery_does_not_hold_it_up():
    bench = NavigatorBench()
    bench.follow_state = FollowState.BLOCKED
    bench.act = lambda: FollowState.FOLLOWING
    bench.go(FAR)
    assert bench.run(300, until=ENDS) < 130
    assert bench.status.reason == reasons.RECOVERIES_USED.code


def test_only_real_progress_earns_the_recoveries_again():
    bench = NavigatorBench()
    bench.go(Pose2(20.0, 0.0))
    bench.run(2)
    bench.follow_state = FollowState.BLOCKED
    bench.run(12)
    first = bench.status.n_recoveries
    assert first >= 2
    bench.follow_state = None
    bench.run(0.6)  # less than 0.7 m
    bench.follow_state = FollowState.BLOCKED
    bench.run(5)
    assert names(bench)[-1] == LADDER[first]  # goes on where it was
    bench.follow_state = None
    bench.run(6)
    bench.follow_state = FollowState.BLOCKED
    bench.run(5)
    assert names(bench)[-1] == LADDER[0]


def test_a_plan_that_swings_between_two_lengths_is_no_progress_for_ever():
    bench = NavigatorBench()
    bench.follow_state = FollowState.BLOCKED
    straight = bench.path
    bench.go(FAR)

    def swinging():
        path = straight()
        longer = 3.0 if bench.now // (2 * S) % 2 else 0.0
        return type(path)(path.stamp, path.goal_id, 1, "", path.xs, path.ys, path.yaws, path.length + longer, path.cost)

    bench.path = swinging
    bench.follow_state = FollowState.FOLLOWING
    assert bench.run(600, until=ENDS) < 250
    assert bench.status.state is NavState.FAILED


def test_a_gap_that_is_open_from_afar_and_closed_from_near_is_found_out():
    """It always comes closer to the gap, and then the way around is 20 m: that is no progress."""
    config = GoalAttemptConfig()
    attempt, n_turns = GoalAttempt(Pose2(9.0, 0.0), any_heading=True), 0
    for step in range(1000):
        left = 20.0 if step % 10 == 9 else 2.0 - 0.2 * (step % 10)
        n_turns += left == 20.0
        attempt.update(0.1, left, path_of(left), None, config.progress)
        if attempt.next_action(None, None, config)[0] is not AttemptAction.GO_ON:
            break
    assert attempt.next_action(None, None, config) == (AttemptAction.RECOVER, reasons.NO_WAY_THROUGH)
    assert n_turns == config.detours
    assert config.with_time_share(0.5).detours == 2
    attempt.reset_clocks()
    assert attempt.next_action(None, None, config)[0] is AttemptAction.GO_ON


def path_of(length):
    """A plan of this length, m."""
    line = np.array([0.0, length])
    return Path(0, 1, 1, "", line, np.zeros(2), np.zeros(2), length, length)


def test_stop_ends_the_task_and_its_release_moves_nothing():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    bench.guarded(GuardState.STOPPED, reasons.ESTOP.code)
    bench.run(1)
    assert (bench.status.state, bench.status.reason) == (NavState.CANCELED, reasons.ESTOP.code)
    refusal_reason = bench.go(FAR)
    assert (refusal_reason.accepted, refusal_reason.reason) == (False, reasons.ESTOP.code)
    bench.guarded(GuardState.IDLE, reasons.ESTOP_RELEASED.code)
    bench.run(5)
    assert stopped(bench)
    assert bench.go(FAR).accepted


def test_a_fault_of_the_base_fails_the_task_with_the_fault():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.guarded(GuardState.FAULT, reasons.WHEEL_STUCK.code)
    bench.run(1)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.WHEEL_STUCK.code)


def test_stop_also_ends_a_paused_task():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.pause()
    bench.guarded(GuardState.STOPPED, reasons.ESTOP.code)
    bench.run(1)
    assert bench.status.state is NavState.CANCELED
    assert not bench.pause(False).accepted


def test_an_obstacle_that_the_guard_holds_for_is_shown_and_leads_to_recoveries():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(1)
    bench.guarded(GuardState.HOLD, reasons.OBSTACLE.code)
    bench.follow_state = FollowState.FOLLOWING
    bench.run(5)
    assert bench.status.reason == reasons.OBSTACLE.code
    bench.run(10)
    assert bench.status.state is NavState.RECOVERING


@pytest.mark.parametrize("reason", [reasons.SCAN_OLD, reasons.ODOM_OLD, reasons.POSE_OLD, reasons.BASE_SILENT])
def test_a_missing_input_is_waited_for_without_recoveries_and_not_for_ever(reason):
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(1)
    bench.guarded(GuardState.HOLD, reason.code)
    bench.follow_state = FollowState.BLOCKED
    bench.run(25)
    assert (bench.status.state, bench.status.reason) == (NavState.NAVIGATING, reason.code)
    assert bench.status.n_recoveries == 0
    bench.run(30, until=ENDS)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reason.code)


def test_a_pose_lost_for_two_seconds_stops_the_robot_and_found_again_it_goes_on():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    bench.localization = Localization.LOST
    bench.run(1.5)
    assert not stopped(bench)
    bench.run(1)
    assert stopped(bench)
    assert bench.status.reason == reasons.POSE_LOST.code
    bench.localization = Localization.GOOD
    bench.run(20, until=ENDS)
    assert bench.status.state is NavState.REACHED


def test_a_pose_lost_for_good_fails_the_task():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    bench.localization = Localization.LOST
    bench.run(60, until=ENDS)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.POSE_LOST.code)


def test_whose_pose_is_lost_at_a_pose_of_the_route_stays_there_until_it_is_found():
    bench = NavigatorBench()
    bench.go(Pose2(), FAR, dwell=4.0)
    bench.run(1)
    bench.localization = Localization.LOST
    bench.run(20)
    assert stopped(bench)
    bench.localization = Localization.GOOD
    bench.run(30, until=ENDS)
    assert bench.status.state is NavState.REACHED


def test_whose_pose_stays_lost_at_a_pose_of_the_route_gives_up_with_the_reason():
    bench = NavigatorBench()
    bench.go(Pose2(), FAR, dwell=4.0)
    bench.run(1)
    bench.localization = Localization.LOST
    assert 20 < bench.run(60, until=ENDS) < 40
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.POSE_LOST.code)


def test_while_a_person_drives_by_hand_that_is_the_reason():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    bench.guarded(GuardState.ACTIVE, source="teleop")
    bench.follow_state = FollowState.FOLLOWING
    bench.run(10)
    assert (bench.status.state, bench.status.reason) == (NavState.NAVIGATING, reasons.BY_HAND.code)
    bench.guarded(GuardState.ACTIVE)
    bench.follow_state = None
    bench.run(30, until=ENDS)
    assert (bench.status.state, bench.status.n_recoveries) == (NavState.REACHED, 0)
    bench.go(Pose2())
    bench.guarded(GuardState.ACTIVE, source="teleop")
    bench.follow_state = FollowState.FOLLOWING
    bench.run(60, until=ENDS)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.BY_HAND.code)


def test_a_jump_of_the_pose_is_shown_and_planned_again():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    before = bench.goal.id
    bench.jump(Pose2(0.0, 1.0))
    bench.run(0.3)
    assert bench.goal.id > before
    assert bench.goal.clear_costmap
    assert bench.status.reason == reasons.POSE_JUMPED.code
    bench.run(20, until=ENDS)
    assert bench.status.state is NavState.REACHED


def test_a_clock_that_jumps_is_no_time_that_passed():
    bench = NavigatorBench()
    bench.go(FAR)
    bench.run(2)
    for leap in (3600, -4000):
        bench.now += leap * S
        bench.run(1)
    assert (bench.status.state, bench.status.n_recoveries) == (NavState.NAVIGATING, 0)


def test_what_makes_no_sense_for_a_robot_is_left_out():
    forward = X80.drive.model_copy(update={"max_reverse_speed": 0.0})
    arcs = X80.drive.model_copy(update={"min_turning_radius": 0.5, "turns_in_place": False})
    assert [step.name for step in recovery_steps(RecoveryConfig(), forward)] == [n for n in LADDER if n != "back_up"]
    assert [step.name for step in recovery_steps(RecoveryConfig(), arcs)] == [n for n in LADDER if "turn" not in n]
    assert [step.name for step in recovery_steps(RecoveryConfig(turn=0, wait=0), X80.drive)] == LADDER[:3]


def test_warming_up_changes_no_state():
    navigator = NavigatorService(NavigatorConfig(), X80)
    navigator.warm_up()
    assert navigator.navigation.task is None
    assert navigator.navigation.grid.empty


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(publications(NavigatorService), max_size=30), st.integers(0, 2**32))
def test_any_valid_messages_are_survived(events, seed):
    rng = np.random.default_rng(seed)
    navigator = NavigatorService(NavigatorConfig(), X80)
    jobs = []
    for method, event in events:
        navigator.now += int(rng.integers(0, S))
        effects = list(getattr(navigator, method)(*([event] if event else [])))
        while jobs:
            job = jobs.pop()
            effects += list(getattr(navigator, job.done)(job.function(*job.arguments)))
        for effect in effects:
            if isinstance(effect, Job):
                jobs.append(effect)
            elif not isinstance(effect, Log):
                assert not list(faults(effect.message))


def test_a_task_s_own_tolerances_count_and_without_them_the_configured_ones():
    bench = NavigatorBench()
    for own, wanted in (((0.05, 0.1), (0.05, 0.1)), ((0.0, 0.0), (0.15, 0.25)), ((0.4, 0.0), (0.4, 0.25))):
        bench.ask("navigate", Navigate(bench.now, (FAR, NEAR), 0.0, 1, False, (), *own))
        assert (bench.goal.tolerance, bench.goal.yaw_tolerance) == wanted
    bench.ask("navigate", Navigate(bench.now, (FAR,), 0.0, 1, True, (), 0.05, 0.1))
    assert bench.goal.yaw_tolerance > np.pi
    bench.run(20, until=ENDS)
    assert bench.pose.distance(FAR) <= 0.05
    assert Navigate(0, (FAR,), 0.0, 1, True, (), 0.001).problem()


@pytest.mark.parametrize(("seconds", "n_recoveries"), [(0.5, 0), (2.0, 1)])
def test_a_goal_given_in_contact_backs_up_only_where_local_control_does_not_lead_away(seconds, n_recoveries):
    bench = NavigatorBench()
    bench.guarded(GuardState.HOLD, reasons.BUMPER.code)
    bench.run(1)
    bench.go(Pose2(3.0, 0.0))
    begun = bench.now
    while bench.now - begun < seconds * S and not bench.recoveries:
        bench.guarded(GuardState.HOLD, reasons.BUMPER.code)
        bench.step()
    bench.guarded(GuardState.ACTIVE, reasons.LEAVING_CONTACT.code)
    bench.run(1)
    assert [order.kind for order in bench.recoveries] == n_recoveries * [RecoveryKind.BACK_UP]
