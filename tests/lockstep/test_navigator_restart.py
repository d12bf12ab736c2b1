# SPDX-License-Identifier: Apache-2.0
"""A navigator that died comes back and goes on with its task, or says why not; a STOP meanwhile always wins."""

from dataclasses import replace
from functools import partial

import pytest

from shared import requests, topics
from shared.geometry import Pose2
from shared.messages import MapUpdate, NavState, Velocity
from shared.reasons import BLOCKED
from shared.recording import CONFIG, Writer, about, sink
from shared.requests import Cancel, Explore, Navigate, Pause
from tests.lockstep.stack import MS, QUICK, LockstepStack
from tests.replay.record import ReferenceRun
from zenav.replay.report import service_builder
from zenav.replay.reprocess import replay_file
from zenav.stack.hardware import Hardware

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


@pytest.fixture
def stack(tmp_path):
    return LockstepStack(tmp_path, settings=QUICK)


def route(stack, *xs, dwell=0.0, loops=1):
    poses = tuple(Pose2(x, 0.0, 0.0) for x in xs)
    reply = stack.lockstep.ask(requests.NAVIGATE, Navigate(stack.now, poses, dwell, loops, True))
    assert reply.accepted
    return reply.task_id


def away(stack, seconds, meanwhile=lambda: None):
    """The navigator is killed, and started again after so many seconds."""
    stack.lockstep.kill("navigator")
    meanwhile()
    stack.lockstep.run(seconds)
    stack.start("navigator")
    stack.lockstep.run(0.5)


def nav(stack):
    return stack.newest["nav/status"]


def where(stack):
    return (stack.truth.start.inverse() @ stack.truth.world_from_base).x


def told(stack, state, reason):
    assert (nav(stack).state, nav(stack).reason) == (state, reason), nav(stack)
    assert nav(stack).detail


def test_a_goal_is_driven_to_on_and_under_its_number(stack):
    task = route(stack, 5.0)
    stack.drives(0.5)
    away(stack, 1.5)
    assert nav(stack).state is NavState.NAVIGATING
    assert nav(stack).task_id == task
    stack.until(stack.ended, 30.0)
    assert stack.reached()
    assert nav(stack).task_id == task
    assert where(stack) == pytest.approx(5.0, abs=0.2)
    assert stack.old == []


def test_the_robot_does_not_stop_for_a_short_interruption(stack):
    route(stack, 6.0)
    stack.drives(0.75)
    slowest = [1.0]
    stack.lockstep.watch("sim/truth", lambda truth: slowest.append(truth.v))
    away(stack, 0.5)
    assert min(slowest) > 0.5


def test_killed_twice_in_a_row_it_still_gets_there(stack):
    route(stack, 5.0)
    stack.drives(0.5)
    away(stack, 1.0)
    away(stack, 1.0)
    stack.lockstep.kill("navigator")
    stack.lockstep.run(0.2)
    stack.start("navigator")
    stack.lockstep.run(0.1)  # dies before it has said anything
    away(stack, 1.0)
    stack.until(stack.ended, 30.0)
    assert stack.reached()


def test_a_route_goes_on_at_its_pose_with_the_loops_that_are_left(stack):
    visited = []
    stack.lockstep.watch("nav/status", lambda s: visited.append((s.round, s.waypoint)))
    task = route(stack, 1.5, 0.5, loops=2)
    stack.until(lambda: nav(stack).waypoint == 1, 20.0)
    away(stack, 1.0)
    assert (nav(stack).round, nav(stack).waypoint, nav(stack).n_rounds) == (0, 1, 2)
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert nav(stack).task_id == task
    assert list(dict.fromkeys(visited)) == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_the_time_away_counts_as_part_of_the_stay(stack):
    route(stack, 0.8, 2.0, dwell=6.0)
    stack.until(lambda: nav(stack).reason == "dwelling", 20.0)
    arrived, place = stack.now, where(stack)
    stack.lockstep.run(1.0)
    away(stack, 2.0)
    assert nav(stack).reason == "dwelling"
    stack.until(lambda: nav(stack).waypoint == 1, 20.0)
    assert (stack.now - arrived) * 1e-9 == pytest.approx(6.0, abs=0.6)
    assert where(stack) == pytest.approx(place, abs=0.05)
    stack.until(stack.ended, 30.0)
    assert stack.reached()


def test_a_recovery_is_over_and_the_goal_is_driven_to(stack):
    route(stack, 5.0)
    stack.drives(0.3)
    navigation = stack.lockstep.service("navigator").navigation
    assert navigation.attempt is not None
    effects = list(navigation._recover(navigation.attempt, BLOCKED, stack.now))  # as if local control had been blocked
    for effect in effects:
        stack.lockstep.publish(effect, "navigator")
    stack.lockstep.run(0.3)
    assert nav(stack).state is NavState.RECOVERING
    away(stack, 1.0)
    assert nav(stack).state is NavState.NAVIGATING
    stack.until(stack.ended, 40.0)
    assert stack.reached()


def test_exploring_goes_on(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    task = stack.lockstep.ask(requests.EXPLORE, Explore(stack.now)).task_id
    stack.drives(0.2)
    away(stack, 2.0)
    assert (nav(stack).state, nav(stack).task_id) == (NavState.EXPLORING, task)
    stack.until(lambda: nav(stack).state not in (NavState.EXPLORING, NavState.RECOVERING), 120.0)
    assert stack.reached()
    assert nav(stack).reason == "no_frontier"


def test_what_was_paused_stays_paused_until_it_is_resumed(stack):
    route(stack, 4.0)
    stack.drives(0.5)
    assert stack.lockstep.ask(requests.PAUSE, Pause(stack.now, True)).accepted
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    away(stack, 2.0)
    assert (nav(stack).state, nav(stack).reason) == (NavState.PAUSED, "paused")
    stack.stands_for(3.0)
    assert stack.lockstep.ask(requests.PAUSE, Pause(stack.now, False)).accepted
    stack.until(stack.ended, 30.0)
    assert stack.reached()


def test_what_was_done_or_canceled_is_not_begun_again(stack):
    task = route(stack, 1.0)
    stack.until(stack.reached, 20.0)
    away(stack, 0.5)
    assert (nav(stack).state, nav(stack).task_id) == (NavState.IDLE, task)
    stack.stands_for(2.0)
    route(stack, 4.0)
    stack.drives(0.5)
    stack.lockstep.ask(requests.CANCEL, Cancel(stack.now))
    away(stack, 0.5)
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    stack.stands_for(2.0)
    assert route(stack, 2.0) == task + 2


def test_after_eleven_seconds_it_stands_and_says_why(stack):
    task = route(stack, 7.5)
    stack.drives(0.2)
    away(stack, 11.0)
    told(stack, NavState.FAILED, "interrupted")
    assert "10 s" in nav(stack).detail
    assert nav(stack).task_id == task
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    stack.stands_for(2.0)


def test_a_stop_meanwhile_wins_and_after_its_release_nothing_moves(stack):
    route(stack, 5.0)
    stack.drives(0.5)
    away(stack, 1.0, partial(stack.stop, True))
    told(stack, NavState.CANCELED, "estop")
    stack.stop(False)
    stack.stands_for(4.0)


@pytest.mark.parametrize("restarts_guard", [False, True])
def test_a_stop_that_was_released_again_meanwhile_wins_too(stack, restarts_guard):
    route(stack, 2.0, 5.0, dwell=4.0)
    stack.until(lambda: nav(stack).reason == "dwelling", 20.0)  # it stands: nothing has to be armed again

    def meanwhile():
        stack.stop(True)
        stack.lockstep.run(0.3)
        stack.stop(False)
        stack.lockstep.run(0.1)
        if restarts_guard:
            stack.lockstep.kill("guard")
            stack.start("guard")

    away(stack, 0.5, meanwhile)
    told(stack, NavState.CANCELED, "estop_released")
    stack.stands_for(6.0)
    route(stack, 3.0)
    stack.until(stack.reached, 20.0)


def test_a_stop_in_full_drive_that_was_released_meanwhile_does_not_drive_on(stack):
    route(stack, 6.0)
    stack.drives(0.5)

    def meanwhile():
        stack.stop(True)
        stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
        stack.stop(False)

    away(stack, 0.5, meanwhile)
    told(stack, NavState.CANCELED, "estop_released")
    stack.stands_for(4.0)


def by_hand(stack, until):
    if stack.now < until:
        stack.lockstep.publish(topics.TELEOP(Velocity(stack.now, -0.2, 0.0, "")))
        stack.lockstep.at(0.05, partial(by_hand, stack, until))


def test_who_drives_by_hand_meanwhile_keeps_it_and_when_it_is_let_go_the_task_goes_on(stack):
    route(stack, 5.0)
    stack.drives(0.5)
    until = stack.now + 4000 * MS
    away(stack, 1.0, partial(by_hand, stack, until))
    assert nav(stack).reason == "by_hand"
    assert stack.guard.source == "teleop"
    stack.until(stack.ended, 40.0)
    assert stack.reached()


def test_on_another_map_the_task_does_not_go_on(stack):
    route(stack, 5.0)
    stack.drives(0.5)

    def meanwhile():
        old: MapUpdate = stack.lockstep.latched["map"].message
        tiles = old.rows, old.columns, old.cells
        stack.lockstep.publish(topics.MAP(MapUpdate(stack.now, old.map_id + 1, 1, old.resolution, *tiles)), "mapper")
        stack.lockstep.kill("mapper")

    away(stack, 0.5, meanwhile)
    told(stack, NavState.CANCELED, "other_map")
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    stack.stands_for(2.0)


@pytest.mark.parametrize("late", [0.05, 0.5])
def test_a_new_goal_wins(stack, late):
    task = route(stack, 6.0)
    stack.drives(0.5)
    stack.lockstep.kill("navigator")
    stack.lockstep.run(1.0)
    stack.start("navigator")
    stack.lockstep.run(late)
    assert route(stack, 1.0) == task + 1
    stack.until(stack.ended, 30.0)
    assert stack.reached()
    assert where(stack) == pytest.approx(1.0, abs=0.2)


def test_a_task_that_is_canceled_before_it_goes_on_is_over(stack):
    route(stack, 6.0)
    stack.drives(0.5)
    stack.lockstep.kill("navigator")
    stack.lockstep.run(1.0)
    stack.start("navigator")
    assert stack.lockstep.ask(requests.CANCEL, Cancel(stack.now)).accepted
    stack.lockstep.run(0.5)
    assert nav(stack).state is NavState.CANCELED
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    stack.stands_for(3.0)


def test_without_the_guard_it_waits_and_then_says_what_is_missing(stack):
    route(stack, 6.0)
    stack.drives(0.5)
    away(stack, 1.0, partial(stack.lockstep.kill, "guard"))
    assert nav(stack).state is NavState.NAVIGATING
    stack.lockstep.run(4.0)
    told(stack, NavState.FAILED, "interrupted")
    assert "the guard" in nav(stack).detail
    stack.start("guard")
    stack.stands_for(2.0)


def test_a_fault_of_the_base_meanwhile_ends_the_task(stack):
    route(stack, 6.0)
    stack.drives(0.5)

    def meanwhile():
        stack.lockstep.kill("base_driver")
        status = replace(stack.newest["base/status"], stamp=stack.now, fault="wheel_stuck", detail="the left wheel")
        stack.lockstep.publish(topics.BASE_STATUS(status), "base_driver")

    away(stack, 0.5, meanwhile)
    told(stack, NavState.FAILED, "wheel_stuck")
    stack.until(lambda: abs(stack.truth.v) < 0.02, 3.0)
    stack.start("base_driver")
    stack.lockstep.run(0.3)
    stack.stop(False)
    stack.stands_for(3.0)


def test_a_clock_that_was_set_back_meanwhile_ends_the_task_with_its_reason(stack):
    route(stack, 6.0)
    stack.drives(0.5)

    def meanwhile():  # as the task looks from a clock that was set back by an hour
        sent = stack.lockstep.latched["nav/task"]
        ahead = replace(sent.message, stamp=stack.now + 3600 * 1000 * MS)
        stack.lockstep.latched["nav/task"] = replace(sent, message=ahead)

    away(stack, 1.0, meanwhile)
    told(stack, NavState.FAILED, "interrupted")
    assert "clock" in nav(stack).detail
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    stack.stands_for(2.0)


def test_the_goal_is_dropped_where_the_task_does_not_go_on(stack):
    route(stack, 6.0)
    stack.drives(0.5)
    goals = []
    stack.lockstep.watch("goal", goals.append)
    away(stack, 11.0)
    assert [goal.active for goal in goals] == [False] * len(goals) != []


def test_a_replay_of_the_restart_gives_the_same_bytes(tmp_path):
    path, written = tmp_path / "restart.mcap", []
    run = ReferenceRun(written.append, "room", "x80sv", Hardware.MESSAGES)
    run.go(3.2, 0.6)
    run.lockstep.run(1.5)
    run.restart("navigator", 0.7)
    run.lockstep.run(2.0)
    run.lockstep.flush()
    with Writer(path, about(run.file.robot.name), {CONFIG: run.file.text.encode()}) as writer:
        for sent in written:
            sink(writer)(sent)
    report = replay_file(path, ["navigator"], None, service_builder(run.file), lambda done, of: None, {})
    assert report.notes == []
    topics_ = {topic.key: topic for topic in report.topics}
    assert topics_["nav/task"].n_equal > 4
    assert topics_["nav/status"].n_equal > 10
    assert all(t.n_different == t.n_lacking == t.n_new == 0 for t in report.topics)
    told_ = [sent.message for sent in written if sent.key == "nav/status"]
    assert {status.task_id for status in told_[-5:]} == {1}
    assert told_[-1].state in (NavState.NAVIGATING, NavState.REACHED)
