# SPDX-License-Identifier: Apache-2.0
"""`zenav bench explore`: the time of several robots as a share of one robot's, seed by seed."""

from types import SimpleNamespace

import pytest

from shared import requests, topics
from shared.config import UserError
from shared.messages import NavState
from shared.requests import Explore
from zenav.bench.explore import ExploreRun, explore, explores, mean_shares, share_of_one
from zenav.scenario.robot_group import RobotGroup


def run(robots, seed, seconds):
    return ExploreRun(robots, seed, seconds, ["reached"] * robots, 0, 10.0, 1.0, 1.0, 1.0, "", 1.0)


def test_a_share_is_of_one_robots_time_with_the_same_seed():
    runs = [run(1, 0, 200.0), run(1, 1, 100.0), run(2, 0, 100.0), run(2, 1, 70.0), run(2, 2, 50.0)]
    assert [share_of_one(one, runs) for one in runs] == [None, None, 0.5, 0.7, None]
    assert mean_shares(runs) == {2: 0.6}


@pytest.mark.parametrize(
    ("state", "goes_on"),
    [(NavState.EXPLORING, True), (NavState.RECOVERING, True), (NavState.REACHED, False), (NavState.FAILED, False)],
)
def test_a_run_goes_on_while_a_robot_recovers(state, goes_on):
    assert explores(SimpleNamespace(state=state)) is goes_on


@pytest.mark.parametrize("robots", ["0", "1,21", "0-2", "two"])
def test_a_wrong_number_of_robots_is_refused_before_anything_runs(robots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as refused:
        explore("x80sv", "room", robots, "0", 10.0, 1, None, [])
    assert refused.value.hint
    assert not list(tmp_path.iterdir())


def test_robots_of_a_group_hear_what_the_others_explore():
    names = ("red", "blue")
    with RobotGroup("x80sv", "room", names, settings=["local_ctrl.mppi.rollouts=200"]) as group:
        heard = {name: [] for name in names}
        for member in group.members:
            member.lockstep.watch(topics.OTHERS_SHARE.key, heard[member.name].append)
        group.run(1.0)
        for member in group.members:
            others = tuple(name for name in names if name != member.name)
            start = member.scenario.world.start
            assert member.lockstep.ask(requests.EXPLORE, Explore(member.lockstep.now, others, start)).accepted
        group.run(1.5)
    for name in names:
        assert {share.robot for share in heard[name]} == set(names) - {name}
        assert (heard[name][-1].coarse_cells() >= 0).any()
