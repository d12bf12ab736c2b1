# SPDX-License-Identifier: Apache-2.0
"""The benchmarks that know the truth, on one small world: what they drive, what they score, what they call wrong."""

import json
from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from shared.geometry import Pose2
from shared.messages import Localization, PoseEstimate
from zenav.bench import buildings as bench
from zenav.bench.buildings import building_figures, drive_tour, reaches_targets, summary
from zenav.bench.figure_pages import PLACES
from zenav.bench.figure_rows import ROWS
from zenav.bench.ground_truth_driver import GroundTruthDriver
from zenav.bench.localise import GIVES_UP, LocalizationTrial, PoseMonitor, run_trial
from zenav.bench.localise import reaches_targets as all_kept
from zenav.bench.localise import summary as told_of
from zenav.bench.sim_slam_harness import DriveResult, SimSlamHarness, harness_robot_file


@pytest.fixture(scope="module")
def toured():
    harness = SimSlamHarness(harness_robot_file("x80sv", "room", 0, None, []))
    assert drive_tour(harness, np.random.default_rng(0)) == []
    return harness


def test_the_tour_visits_every_goal_touches_nothing_and_ends_where_it_began(toured):
    trajectory = toured.track.true_trajectory
    for goal in (*toured.world.goals.values(), toured.world.start):
        assert np.hypot(*(trajectory[:, :2] - (goal.x, goal.y)).T).min() < 0.4
    assert np.hypot(*(trajectory[-1, :2] - trajectory[0, :2])) < 0.4
    assert toured.truth.n_contacts == 0


def run_of(harness, **changes):
    """What is reported of a building."""
    return {"building": 0, "trouble": "", "not_reached": [], **building_figures(harness), "cpu_s": 1.0, **changes}


def test_a_small_room_keeps_every_promise(toured):
    run = run_of(toured)
    assert run["pose_error_mean_m"] < 0.03
    assert run["keyframe_error_mean_m"] < 0.03
    assert reaches_targets(run)
    assert summary([run, {"building": 1, "trouble": "none"}])["kept"] == 1


def test_what_a_tour_reports_becomes_a_published_row(toured):
    run = run_of(toured)
    row = next(row for row in ROWS if row.name == "buildings")
    cells = row.cells([{"runs": [run]}, {"runs": [{"building": 1, "trouble": "none"}]}])
    assert [line[0] for line in cells["buildings"]] == ["0", "1", "**mean**"]
    assert {len(line) for line in cells["buildings"]} == {len(PLACES["buildings"].head)}
    assert 0.5 < run["map_completeness"] <= 1
    assert f"completeness {run['map_completeness'] * 100:.1f} %" in cells["measured"][0][0]


class GivesUp(GroundTruthDriver):
    """Drives for two seconds, then no further."""

    def go(self, goal, truth):
        self.n_commands = 0
        return super().go(goal, truth)

    def command(self, truth, seconds):
        self.n_commands += 1
        return super().command(truth, seconds) if self.n_commands <= 40 else None


class IntoTheWall(GroundTruthDriver):
    """Drives straight on until the robot touches something."""

    def command(self, truth, seconds):
        return (0.3, 0.0) if truth.n_contacts == 0 else None


def driven_by(driver):
    harness = SimSlamHarness(harness_robot_file("x80sv", "room", 0, None, []))
    harness.driver = driver(harness.paths)
    return harness


def test_a_drive_tells_how_it_ended():
    harness = driven_by(GroundTruthDriver)
    desk = harness.world.goals["desk"]
    assert harness.drive(desk, lambda: harness.truth.distance > 0.3) is DriveResult.STOPPED
    assert harness.drive(Pose2(50.0, 50.0, 0.0)) is DriveResult.NO_PATH
    harness.driver = GivesUp(harness.paths)
    assert harness.drive(desk) is DriveResult.GAVE_UP
    harness.driver = GroundTruthDriver(harness.paths)
    assert harness.drive(desk) is DriveResult.REACHED
    assert harness.truth.world_from_base.distance(desk) < 0.6


def test_a_goal_that_the_driver_gave_up_is_not_reached_and_counts_against_the_building():
    harness = driven_by(GivesUp)
    missed = drive_tour(harness, np.random.default_rng(0))
    assert {line.partition(":")[0] for line in missed} >= {"desk", "shelf"}
    run = run_of(harness, not_reached=missed, pose_error_mean_m=0.0, map_within_5_cm=1.0)
    assert not reaches_targets(run)
    assert reaches_targets({**run, "not_reached": []})
    assert summary([run])["not_reached"] == len(missed)


def test_a_contact_counts_against_the_building():
    harness = driven_by(IntoTheWall)
    harness.drive(harness.world.goals["shelf"])
    run = run_of(harness, pose_error_mean_m=0.0, map_within_5_cm=1.0)
    assert run["collisions"] == 1
    assert not reaches_targets(run)
    assert reaches_targets({**run, "collisions": 0})
    assert summary([run])["collisions"] == 1


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({}, 0, "building 0: done"),
        ({"not_reached": ["desk: given up on the way"]}, 1, "desk: given up on the way"),
        ({"collisions": 2}, 1, "2 contacts"),
    ],
)
def test_the_verdict_the_table_and_the_file_name_what_was_missed_and_touched(
    changes, status, said, toured, tmp_path, monkeypatch, capsys
):
    run = run_of(toured, pose_error_mean_m=0.01, map_within_5_cm=0.99, **changes)
    monkeypatch.setattr(bench, "tour_building", lambda *_: run)
    monkeypatch.setattr(bench, "new_run_folder", lambda _: tmp_path)
    out = tmp_path / "buildings.json"
    assert bench.buildings("x80sv", "0", 1, out, []) == status
    shown = capsys.readouterr()
    assert said in shown.err
    row = shown.out.splitlines()[-1].split()
    n_missed, n_contacts = len(run["not_reached"]), run["collisions"]
    assert row[:7] == ["0", "6", "x", "5", "2", str(n_missed), str(n_contacts)]
    written = json.loads(out.read_text())
    assert written["summary"]["kept"] == 1 - status
    assert written["summary"]["not_reached"] == n_missed
    assert written["runs"][0]["not_reached"] == run["not_reached"]
    assert written["runs"][0]["collisions"] == n_contacts


def test_its_speed_is_a_robot_s(toured):
    assert 0.25 < toured.truth.distance / (toured.track.truths[-1][0] - toured.track.truths[0][0]) * 1e9 < 0.8


def test_found_from_nowhere_then_carried_away_it_notices_and_is_found_again(toured):
    told = run_trial("x80sv", "room", 3, toured.mapper.slam.snapshot(), [])
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
    harness = SimSlamHarness(harness_robot_file("x80sv", "room", 0, None, []))
    angles, distance = harness.sim.state_now[5:7].copy(), harness.truth.distance
    there = Pose2(harness.world.start.x + 0.5, harness.world.start.y, harness.world.start.yaw + pi / 2)
    harness.carry(there)
    harness.stand(0.5)
    at = harness.truth.world_from_base
    assert hypot(at.x - there.x, at.y - there.y) < 1e-6
    assert np.array_equal(harness.sim.state_now[5:7], angles)
    assert harness.truth.distance == distance


def test_a_pose_that_is_called_good_and_is_wrong_counts_until_it_is_right():
    harness = SimSlamHarness(harness_robot_file("x80sv", "room", 0, None, []))
    watch = PoseMonitor(harness, harness.world.start)
    estimate = PoseEstimate(harness.truth.stamp, Pose2(), Pose2(), np.zeros(9), 1.0, Localization.GOOD)
    off, turned = (replace(estimate, map_from_base=pose) for pose in (Pose2(0.4, 0, 0), Pose2(0, 0, 0.1)))
    poor = replace(off, state=Localization.POOR)
    steps = [(estimate, True, 0.0), (off, False, 0.1), (poor, False, 0.1), (turned, False, 0.2), (estimate, True, 0.2)]
    for told, right, wrong in steps:
        stamp = max(harness.truth.stamp, watch.last + 100_000_000)
        watch.add(replace(told, stamp=stamp))
        assert watch.right is right
        assert watch.wrong_s == pytest.approx(wrong)


def test_what_was_never_found_counts_against_it():
    trials = [LocalizationTrial(found_m=2.0), LocalizationTrial(found_m=GIVES_UP - 1, wrong_s=0.3), LocalizationTrial()]
    told = told_of(trials)
    assert told["found_share"] == pytest.approx(1 / 3, abs=1e-3)
    assert told["wrongly_sure"] == 1
    assert not all_kept(told)
