# SPDX-License-Identifier: Apache-2.0
"""The navigator takes settings amid a task: its times and recoveries follow, and the sequence goes on where it was."""

from services.navigator.config import NavigatorConfig
from services.navigator.service import NavigatorService
from shared.config import load_robot
from shared.reasons import BLOCKED
from shared.requests import Explore, SetSettings

ROBOT = load_robot("x80sv").robot


def changed(navigator: NavigatorService, **values: str) -> None:
    names = tuple(f"navigator.{name.replace('__', '.')}" for name in values)
    list(navigator.set_settings(SetSettings(navigator.now, names, tuple(values.values()), False)))
    assert set(navigator.run_time) >= set(names)


def test_exploration_takes_new_settings_and_the_times_of_a_goal_with_its_share():
    navigator = NavigatorService(NavigatorConfig(), ROBOT)
    navigator.name = "navigator"
    list(navigator.explore(Explore(0)))
    task = navigator.navigation.task
    changed(navigator, exploration__max_visits="9", exploration__patience="0.25", leg__blocked_time="8")
    assert navigator.navigation.task is task
    assert task.config.max_visits == 9
    assert navigator.navigation.attempt_config.blocked_time == 2.0


def test_a_recovery_that_is_left_out_from_now_on_is_not_tried_and_those_before_count():
    navigator = NavigatorService(NavigatorConfig(), ROBOT)
    navigator.name = "navigator"
    recoveries = navigator.navigation.recoveries
    recoveries.next(BLOCKED, None)
    n = len(recoveries.recovery_steps)
    changed(navigator, recovery__wait="0", recovery__back_up="0.1")
    assert len(recoveries.recovery_steps) == n - 1
    assert recoveries.n_tried == 1
    assert "wait" not in {step.name for step in recoveries.recovery_steps}
