# SPDX-License-Identifier: Apache-2.0
"""`zenav bench fleet`: what one robot's goals count for, and a short run of two robots."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from shared.geometry import Pose2
from shared.messages import NavState
from zenav.__main__ import _status
from zenav.bench.fleet import FleetRun, drive
from zenav.scenario.random_goals import LOOK_S, RandomGoals, RobotRecord


class Toy:
    """A member whose status and truth a test sets, and places all over a square."""

    def __init__(self):
        self.name, self.asked = "red", []
        self.nav = SimpleNamespace(task_id=0, state=NavState.IDLE, reason="")
        self.truth = SimpleNamespace(world_from_base=Pose2(), v=0.0, w=0.0, n_contacts=0, distance=0.0)

    def now(self):
        return 0

    def ask(self, request, message):
        self.asked.append(message.poses[0])
        self.nav.task_id, self.nav.state = len(self.asked), NavState.NAVIGATING
        return SimpleNamespace(accepted=True, task_id=len(self.asked))

    def random_pose(self, rng):
        return Pose2(*rng.uniform(-6, 6, 2).tolist())


@pytest.fixture
def toy():
    return Toy()


@pytest.fixture
def driver(toy):
    return RandomGoals(toy, toy, np.random.default_rng(1))


def test_each_goal_is_at_least_three_metres_away_and_comes_after_the_last_one_ended(toy, driver):
    for _ in range(50):
        driver.step()
        driver.step()
        toy.truth.world_from_base = toy.asked[-1]
        toy.nav.state = NavState.REACHED
    assert driver.record.n_reached == 49
    ways = [a.distance(b) for a, b in zip([Pose2(), *toy.asked], toy.asked, strict=False)]
    assert min(ways) >= 3.0


def test_a_goal_that_fails_counts_with_its_reason_and_a_stand_is_the_longest_one_on_the_way(toy, driver):
    driver.step()
    for v in (0.0, 0.0, 0.0, 0.5, 0.0):
        toy.truth.v = v
        driver.step()
    toy.nav.state, toy.nav.reason = NavState.FAILED, "no_plan"
    driver.step()
    assert driver.record.longest_standstill == pytest.approx(3 * LOOK_S)
    assert (driver.record.n_failed, driver.record.n_reached, driver.record.reasons) == (1, 0, {"no_plan": 1})


def test_a_run_is_the_sum_of_its_robots_and_its_longest_stand():
    run = FleetRun([RobotRecord("a", 3, 0, 1, 5.0, 2.0), RobotRecord("b", 4, 1, 2, 6.0, 9.0)], True, 100.0, 1.0)
    assert (run.n_reached, run.n_contacts, run.longest_standstill) == (7, 3, 9.0)
    assert not run.is_good


@pytest.mark.parametrize(
    ("record", "is_good"),
    [
        (RobotRecord("a", n_reached=1, longest_standstill=60.0), True),
        (RobotRecord("a", n_reached=0, n_failed=19), False),
        (RobotRecord("a", n_reached=5, n_contacts=1), False),
        (RobotRecord("a", n_reached=5, longest_standstill=60.2), False),
    ],
)
def test_a_good_run_reaches_goals_touches_nothing_and_never_stands_for_long(record, is_good):
    assert FleetRun([record], True, 100.0, 1.0).is_good == is_good


def test_two_robots_in_a_room_drive(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "fleet.json"
    quick = ["--coordination", "on", "--set", "local_ctrl.mppi.rollouts=200"]
    assert _status(["bench", "fleet", "--world", "room", "--seconds", "5", "--out", str(out), *quick]) in (0, 1)
    alone, both = json.loads(out.read_text())["runs"]
    assert [len(run["robots"]) for run in (alone, both)] == [1, 2]
    assert all(robot["distance"] > 0.5 for run in (alone, both) for robot in run["robots"])
    assert 100 < alone["traffic"] < 1000 < both["traffic"], "bytes a second: alone it says only that it is there"


def test_robots_that_hide_the_walls_from_each_other_are_found_and_then_drive_without_hearing_another():
    run = drive("x80sv", "office", 4, 5.0, 0, ["local_ctrl.mppi.rollouts=200"], coordinated=False)
    assert all(robot.distance > 0.5 for robot in run.robots)
    assert run.traffic < 1000, "bytes a second: each says only that it is there"


def test_more_robots_than_a_room_holds_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert _status(["bench", "fleet", "--world", "room", "--robots", "20", "--seconds", "5"]) == 2
    assert "has room for" in capsys.readouterr().err
