# SPDX-License-Identifier: Apache-2.0
"""The scenario's steps against a navigator made of answers."""

from shared import requests
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus
from shared.requests import Reply
from zenav.scenario.mission import MAX_REFUSED_S, MAX_RESTARTS, RETRY_PERIOD_S, TIME_PER_GOAL_S, LegState, Mission

GOALS = [("kitchen", Pose2(1, 2, 3)), ("home", Pose2())]


class MissionNavigator:
    """Takes what it is asked for, unless `refuses` names a reason."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.refuses = ""
        self.task = 0
        self.now = 100.0

    def ask(self, request: requests.Request, message: object) -> Reply:
        self.asked.append(request.key)
        if self.refuses == "no_answer":
            raise UserError("no_answer", "")
        self.task += not self.refuses
        return Reply(0, not self.refuses, self.refuses, "", self.task)

    def status(self, state: NavState, task: int | None = None, reason: str = "") -> NavStatus:
        task = self.task if task is None else task
        stamp = round(self.now * 1e9)
        return NavStatus(stamp, task, state, "", reason, "", Pose2(), 0.0, 0.0, 0, 1, 0)

    def step(self, mission: Mission, state: NavState, task: int | None = None, reason: str = "") -> None:
        self.now += 1.1 * RETRY_PERIOD_S
        mission.step(self.now, self.status(state, task, reason))


def test_it_explores_and_drives_to_every_goal_in_order():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask)
    for _ in range(3):
        navigator.step(mission, NavState.IDLE)
        navigator.step(mission, NavState.NAVIGATING)
        assert mission.leg.state is LegState.UNDER_WAY
        navigator.step(mission, NavState.REACHED)
    assert mission.leg is None
    assert navigator.asked == ["request/explore", "request/navigate", "request/navigate"]
    assert (mission.n_reached, mission.n_goals, mission.explored) == (2, 2, True)


def test_a_status_from_before_the_request_ends_nothing():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, explores=False)
    before = navigator.status(NavState.REACHED, 1)
    navigator.step(mission, NavState.IDLE)
    mission.step(navigator.now + 0.1, before)
    assert mission.leg.name == "kitchen"


def test_a_stack_that_is_not_ready_is_asked_again_and_a_wrong_goal_is_not():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, explores=False)
    for navigator.refuses in ("no_map", "no_answer", "scan_old"):
        navigator.step(mission, NavState.IDLE)
        assert mission.leg.name == "kitchen"
    navigator.refuses = "goal_outside"
    navigator.step(mission, NavState.IDLE)
    assert mission.legs[0].state is LegState.FAILED
    assert mission.legs[0].reason == "goal_outside"
    assert mission.leg.name == "home"


def test_patience_with_a_stack_that_never_gets_ready_ends():
    navigator = MissionNavigator()
    navigator.refuses = "no_map"
    mission = Mission(GOALS, navigator.ask)
    n = 0
    while mission.leg is not None:
        navigator.step(mission, NavState.IDLE)
        n += 1
        assert n < 10 * MAX_REFUSED_S / RETRY_PERIOD_S
    assert mission.n_reached == 0


def test_a_restarted_navigator_gets_the_leg_again_a_few_times():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, explores=False)
    for n in range(MAX_RESTARTS):
        navigator.task = 5
        navigator.step(mission, NavState.IDLE)
        navigator.step(mission, NavState.IDLE, task=0)
        assert mission.legs[0].state is LegState.WAITING
        assert len(navigator.asked) == n + 1
    navigator.step(mission, NavState.IDLE)
    navigator.step(mission, NavState.IDLE, task=0)
    assert mission.legs[0].state is LegState.FAILED


def test_a_failed_goal_does_not_keep_the_next_from_being_tried():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, explores=False)
    navigator.step(mission, NavState.IDLE)
    navigator.step(mission, NavState.FAILED, reason="unreachable")
    navigator.step(mission, NavState.FAILED)
    navigator.step(mission, NavState.REACHED)
    assert [leg.state for leg in mission.legs] == [LegState.FAILED, LegState.REACHED]


def test_a_task_of_somebody_else_is_not_ours():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, explores=False)
    navigator.step(mission, NavState.IDLE)
    navigator.step(mission, NavState.REACHED, task=navigator.task + 1)
    assert mission.legs[0].state is LegState.FAILED


def test_exploring_ends_in_time_for_the_goals_where_the_whole_is_bounded():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, seconds=2 * TIME_PER_GOAL_S * len(GOALS) + 10)
    navigator.step(mission, NavState.IDLE)
    begun = navigator.now
    while mission.legs[0].state is LegState.UNDER_WAY:
        navigator.step(mission, NavState.EXPLORING)
        assert navigator.now - begun < TIME_PER_GOAL_S * len(GOALS) + 20
    assert mission.legs[0].state is LegState.CUT
    navigator.step(mission, NavState.EXPLORING)
    assert navigator.asked == ["request/explore", "request/navigate"]
    assert mission.explored


def test_a_run_too_short_for_goals_is_all_exploring():
    navigator = MissionNavigator()
    mission = Mission(GOALS, navigator.ask, seconds=1.5 * TIME_PER_GOAL_S * len(GOALS))
    navigator.step(mission, NavState.IDLE)
    for _ in range(100):
        navigator.step(mission, NavState.EXPLORING)
    assert mission.legs[0].state is LegState.UNDER_WAY
