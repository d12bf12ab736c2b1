# SPDX-License-Identifier: Apache-2.0
"""The benchmarks that know the truth, on one small world: what they drive, what they score, what they call wrong."""

from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from shared.geometry import Pose2
from shared.messages import Localization, PoseEstimate
from zenav.bench.buildings import figures, kept, summary, tour
from zenav.bench.figure_pages import PLACES
from zenav.bench.figure_rows import ROWS
from zenav.bench.localise import GIVES_UP, Trial, Watch, trial
from zenav.bench.localise import kept as all_kept
from zenav.bench.localise import summary as told_of
from zenav.bench.rig import Rig, robot_file


@pytest.fixture(scope="module")
def toured():
    rig = Rig(robot_file("x80sv", "room", 0, None, []))
    assert tour(rig, np.random.default_rng(0))
    return rig


def test_the_tour_visits_every_goal_touches_nothing_and_ends_where_it_began(toured):
    way = toured.track.true_way
    for goal in (*toured.world.goals.values(), toured.world.start):
        assert np.hypot(*(way[:, :2] - (goal.x, goal.y)).T).min() < 0.4
    assert np.hypot(*(way[-1, :2] - way[0, :2])) < 0.4
    assert toured.truth.n_contacts == 0


def test_a_small_room_keeps_every_promise(toured):
    run = {"building": 0, "trouble": "", **figures(toured), "cpu_s": 1.0}
    assert run["pose_error_mean_m"] < 0.03
    assert run["keyframe_error_mean_m"] < 0.03
    assert kept(run)
    assert summary([run, {"building": 1, "trouble": "none"}])["kept"] == 1


def test_what_a_tour_reports_becomes_a_published_row(toured):
    run = {"building": 0, "trouble": "", **figures(toured), "cpu_s": 1.0}
    row = next(row for row in ROWS if row.name == "buildings")
    cells = row.cells([{"runs": [run]}, {"runs": [{"building": 1, "trouble": "none"}]}])
    assert [line[0] for line in cells["buildings"]] == ["0", "1", "**mean**"]
    assert {len(line) for line in cells["buildings"]} == {len(PLACES["buildings"].head)}
    assert 0.5 < run["map_completeness"] <= 1
    assert f"completeness {run['map_completeness'] * 100:.1f} %" in cells["measured"][0][0]


def test_its_speed_is_a_robot_s(toured):
    assert 0.25 < toured.truth.distance / (toured.track.truths[-1][0] - toured.track.truths[0][0]) * 1e9 < 0.8


def test_found_from_nowhere_then_carried_away_it_notices_and_is_found_again(toured):
    told = trial("x80sv", "room", 3, toured.mapper.mapping.snapshot(), [])
    assert told.found_m is not None
    assert told.found_m < 10
    assert told.carried
    assert told.noticed_s is not None
    assert told.noticed_s < 3
    assert told.back_m is not None
    assert told.back_m < 10
    assert told.wrong_s == 0
    assert all_kept(told_of([told]))


def test_carried_away_its_wheels_did_not_turn():
    rig = Rig(robot_file("x80sv", "room", 0, None, []))
    angles, distance = rig.sim.state_now[5:7].copy(), rig.truth.distance
    there = Pose2(rig.world.start.x + 0.5, rig.world.start.y, rig.world.start.yaw + pi / 2)
    rig.carry(there)
    rig.stand(0.5)
    at = rig.truth.world_from_base
    assert hypot(at.x - there.x, at.y - there.y) < 1e-6
    assert np.array_equal(rig.sim.state_now[5:7], angles)
    assert rig.truth.distance == distance


def test_a_pose_that_is_called_good_and_is_wrong_counts_until_it_is_right():
    rig = Rig(robot_file("x80sv", "room", 0, None, []))
    watch = Watch(rig, rig.world.start)
    estimate = PoseEstimate(rig.truth.stamp, Pose2(), Pose2(), np.zeros(9), 1.0, Localization.GOOD)
    off, turned = (replace(estimate, map_from_base=pose) for pose in (Pose2(0.4, 0, 0), Pose2(0, 0, 0.1)))
    poor = replace(off, state=Localization.POOR)
    steps = [(estimate, True, 0.0), (off, False, 0.1), (poor, False, 0.1), (turned, False, 0.2), (estimate, True, 0.2)]
    for told, right, wrong in steps:
        stamp = max(rig.truth.stamp, watch.last + 100_000_000)
        watch.take(replace(told, stamp=stamp))
        assert watch.right is right
        assert watch.wrong_s == pytest.approx(wrong)


def test_what_was_never_found_counts_against_it():
    trials = [Trial(found_m=2.0), Trial(found_m=GIVES_UP - 1, wrong_s=0.3), Trial()]
    told = told_of(trials)
    assert told["found_share"] == pytest.approx(1 / 3, abs=1e-3)
    assert told["wrongly_sure"] == 1
    assert not all_kept(told)
