# SPDX-License-Identifier: Apache-2.0
"""A robot that waits for another one, or makes way for it, is not stuck: no recovery, and it says for which robot."""

from dataclasses import replace

import pytest

from services.navigator.config import NavigatorConfig
from services.navigator.goal_attempt import GoalAttemptConfig
from services.traffic.outgoing import no_other_robot
from shared import reasons
from shared.geometry import Pose2
from shared.messages import FollowState, GuardState, NavState
from shared.requests import Navigate
from tests.unit.services.navigator.bench import NavigatorBench


def tell(bench, gives_way=False):
    bench.call(
        "right_of_way",
        replace(no_other_robot(bench.now), active=True, whole=False, waits_for=("blue",), gives_way=gives_way),
    )


def wait(bench, seconds, reason, state=FollowState.BLOCKED):
    bench.follow_state, bench.follow_reason = state, reason.code
    for _ in range(seconds):
        tell(bench, reason is reasons.GIVING_WAY)
        bench.run(1)


@pytest.mark.parametrize(
    ("reason", "words"),
    [(reasons.RIGHT_OF_WAY, "waits for blue"), (reasons.GIVING_WAY, "makes way for blue")],
)
def test_a_wait_for_a_robot_starts_no_recovery_and_names_it(reason, words):
    bench = NavigatorBench()
    bench.go(Pose2(3.0, 0.0))
    wait(bench, 60, reason)
    assert (bench.status.state, bench.status.reason, bench.status.detail) == (NavState.NAVIGATING, reason.code, words)
    assert bench.recoveries == []
    bench.follow_state, bench.follow_reason = None, ""
    bench.run(20, until={NavState.REACHED})
    assert bench.status.state is NavState.REACHED


def test_a_wait_ends_the_task_after_its_own_time_and_a_blocked_path_still_needs_a_recovery():
    bench = NavigatorBench(NavigatorConfig(leg=GoalAttemptConfig(right_of_way_time=40.0)))
    bench.go(Pose2(3.0, 0.0))
    wait(bench, 45, reasons.RIGHT_OF_WAY)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.RIGHT_OF_WAY.code)
    other = NavigatorBench()
    other.go(Pose2(3.0, 0.0))
    wait(other, 6, reasons.BLOCKED)
    assert other.status.n_recoveries > 0


def test_a_hold_after_a_long_wait_has_its_own_time():
    bench = NavigatorBench(NavigatorConfig(leg=GoalAttemptConfig(hold_time=5.0)))
    bench.go(Pose2(3.0, 0.0))
    wait(bench, 30, reasons.RIGHT_OF_WAY)
    bench.guarded(GuardState.HOLD, reasons.SCAN_OLD.code)
    bench.run(4)
    assert (bench.status.state, bench.status.reason) == (NavState.NAVIGATING, reasons.SCAN_OLD.code)
    bench.run(2)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.SCAN_OLD.code)


def test_a_short_hold_does_not_prolong_a_wait():
    bench = NavigatorBench(NavigatorConfig(leg=GoalAttemptConfig(right_of_way_time=40.0)))
    bench.go(Pose2(3.0, 0.0))
    wait(bench, 30, reasons.RIGHT_OF_WAY)
    bench.guarded(GuardState.HOLD, reasons.SCAN_OLD.code)
    bench.run(1)
    bench.guarded(GuardState.ACTIVE)
    wait(bench, 15, reasons.RIGHT_OF_WAY)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.RIGHT_OF_WAY.code)


def test_a_robot_on_the_way_to_a_refuge_passes_no_pose_of_its_route():
    bench = NavigatorBench()
    poses = (Pose2(3.0, 0.0), Pose2(6.0, 0.0))
    bench.ask("navigate", Navigate(bench.now, poses, 0.0, 1, any_heading=True, dwells=(0.0, 0.0), pass_through=True))
    bench.pose = Pose2(2.8, 0.0)
    wait(bench, 3, reasons.GIVING_WAY, FollowState.FOLLOWING)
    assert bench.goal.map_from_goal.x == 3.0


def test_silence_of_traffic_is_waited_for_without_recoveries_until_the_hold_is_too_long():
    bench = NavigatorBench(NavigatorConfig(leg=GoalAttemptConfig(hold_time=25.0)))
    bench.go(Pose2(3.0, 0.0))
    tell(bench)
    bench.follow_state, bench.follow_reason = FollowState.BLOCKED, reasons.TRAFFIC_OLD.code
    bench.run(20)
    assert (bench.status.state, bench.status.reason) == (NavState.NAVIGATING, reasons.TRAFFIC_OLD.code)
    assert bench.recoveries == []
    assert bench.status.n_recoveries == 0
    bench.run(6)
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.TRAFFIC_OLD.code)
