# SPDX-License-Identifier: Apache-2.0
"""`zenav bench faults`: the matrix, what is measured from the fault on, and which targets a trial misses."""

import json
from collections import Counter
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from services.sim.message_faults import MessageFault
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import (
    GuardState,
    GuardStatus,
    Localization,
    MotorCommand,
    PoseEstimate,
    Truth,
    Velocity,
)
from shared.topics import SERVICES
from zenav.__main__ import _status
from zenav.bench import fault_trial
from zenav.bench.fault_rigs import LockstepStack
from zenav.bench.fault_table import FAULT_ROWS, SEQUENCE, DriveMode, FaultRow
from zenav.bench.fault_trial import SPEEDS, FaultMeter, FaultResult, FaultTrial
from zenav.bench.faults import fault_summary, matrix, missed_targets, selected_rows, table_row

MS, S = 1_000_000, 1_000_000_000
ROW = FaultRow("scan_nan", frozenset({"scan_old"}), 250.0)
GOOD = FaultResult("scan_nan", DriveMode.NAVIGATION, 0.5, 0, 120.0, 60.0, 0.1, 0.1, 0, ["scan_old"], True, 0.2, True)


def test_every_row_breaks_what_there_is():
    names = {row.name for row in FAULT_ROWS}
    assert len(names) == len(FAULT_ROWS)
    assert {row.name for row in FAULT_ROWS if not row.killed} == {*MessageFault, SEQUENCE}
    assert {FAULT_ROWS[i].name for i in selected_rows("", live=False)} == names - {SEQUENCE}
    assert {row.killed for row in FAULT_ROWS if row.killed} < set(SERVICES)


def test_each_fault_comes_equally_often_and_in_every_mode_and_speed():
    rows = selected_rows("", live=True)
    trials = matrix(9 * len(rows), 0, rows)
    assert set(Counter(trial.row for trial in trials).values()) == {9}
    for row in rows:
        assert {(t.mode, t.speed) for t in trials if t.row == row} == {(m, s) for m in DriveMode for s in SPEEDS}
    assert len({trial.seed for trial in trials}) == len(trials)
    fifty = matrix(50, 0, rows)
    assert {trial.row for trial in fifty} == set(rows)
    assert set(Counter((t.mode, t.speed) for t in fifty)) == {(m, s) for m in DriveMode for s in SPEEDS}


def test_an_unknown_fault_is_told_with_the_nearest():
    with pytest.raises(UserError) as error:
        selected_rows("scan_nam", live=False)
    assert "scan_nan" in error.value.hint
    assert [FAULT_ROWS[i].name for i in selected_rows("sonar_dead, scan_nan", live=False)] == ["scan_nan", "sonar_dead"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, []),
        ({"zero_ms": 300.0}, ["300 ms"]),
        ({"zero_ms": inf}, ["never stood"]),
        ({"contacts": 1}, ["1 contacts"]),
        ({"right": False}, ["told scan_old"]),
        ({"wrong_while_good": 1.2}, ["pose wrong but good for 1.2 s"]),
        ({"resumed": False}, ["did not resume"]),
        ({"trouble": "it did not start"}, ["no trial: it did not start"]),
    ],
)
def test_each_target_that_is_missed_is_named(change, words):
    result = replace(GOOD, **change)
    assert missed_targets(result, ROW) == words
    assert table_row(ROW, [result])[-2] == ("1 not good" if words else "good")


def test_a_fault_that_ends_before_the_limit_need_not_stop_the_robot():
    went_on = replace(GOOD, zero_ms=inf, right=False)
    assert missed_targets(replace(went_on, lasts=0.2), ROW) == []
    assert missed_targets(replace(went_on, lasts=0.3), ROW) == ["never stood", "told scan_old"]
    assert missed_targets(replace(GOOD, zero_ms=900.0, lasts=0.2), ROW) == ["900 ms"]


def test_where_nothing_has_to_stand_time_is_not_judged_and_a_hand_may_creep():
    by_hand = replace(GOOD, mode=DriveMode.TELEOP, zero_ms=inf)
    creeps = replace(ROW, stops=frozenset({DriveMode.NAVIGATION}), creeps=frozenset({DriveMode.TELEOP}))
    assert missed_targets(by_hand, creeps) == []
    assert missed_targets(replace(by_hand, creep_ms=400.0), creeps) == ["400 ms"]
    assert missed_targets(replace(by_hand, right=False), replace(ROW, stops=frozenset())) == []


def test_the_summary_counts_and_json_has_no_infinity():
    found = [GOOD, replace(GOOD, zero_ms=inf)]
    told = fault_summary(found)
    assert (told["trials"], told["good"]) == (2, 1 if FAULT_ROWS[0].limit >= 120 else 0)
    assert json.loads(json.dumps([r.as_json() for r in found], allow_nan=False))[1]["zero_ms"] is None


def truth(at: Pose2, distance: float = 0.0) -> Truth:
    none = np.zeros(0, np.float32)
    return Truth(0, at, Pose2(), 0.5, 0.0, False, 0, distance, none, none)


def test_times_count_from_the_fault_and_the_distance_to_the_first_zero():
    meter = FaultMeter(0.1)
    meter.add("hardware/motors", MotorCommand(0, 0.0, 0.0), 1 * S)
    meter.add("sim/truth", truth(Pose2(), 1.0), 1 * S)
    meter.begin(2 * S)
    meter.add("hardware/motors", MotorCommand(0, -100.0, 100.0), 2 * S + 10 * MS)
    meter.add("sim/truth", truth(Pose2(), 1.2), 2 * S + 100 * MS)
    meter.add("cmd/vel", Velocity(0, 0.08, 0.0, ""), 2 * S + 120 * MS)
    meter.add("hardware/motors", MotorCommand(0, 0.0, 0.0), 2 * S + 200 * MS)
    meter.add("hardware/motors", MotorCommand(0, 0.0, 0.0), 2 * S + 300 * MS)
    meter.add("guard/status", GuardStatus(0, GuardState.HOLD, "", "scan_old", "stamps", 0.0), 2 * S + 200 * MS)
    result = replace(GOOD)
    fault_trial._fill_in(result, replace(ROW, detail="stamp"), meter, truth(Pose2(), 1.5))
    assert (result.zero_ms, result.creep_ms) == (200.0, 120.0)
    assert result.distance == pytest.approx(0.2)
    assert result.driven == pytest.approx(0.5)
    assert (result.reasons, result.right) == (["scan_old"], True)
    fault_trial._fill_in(result, replace(ROW, detail="are they ns"), meter, truth(Pose2(), 1.5))
    assert result.right is False


def test_only_a_wrong_pose_that_is_good_and_fresh_counts():
    covariance = np.zeros(9)
    for state, away, every, longest in (
        ("good", 0.4, 5, 2.0),
        ("good", 0.2, 5, 0.0),
        ("poor", 0.4, 5, 0.0),
        ("good", 0.4, 60, 0.0),
    ):
        meter = FaultMeter(0.1)
        meter.add("sim/truth", truth(Pose2()), 0)
        meter.begin(0)
        for i in range(101):
            now = i * 20 * MS
            meter.add("sim/truth", truth(Pose2(away, 0.0, 0.0)), now)
            if i % every == 0:
                pose = PoseEstimate(now, Pose2(), Pose2(), covariance, 1.0, Localization(state))
                meter.add("pose", pose, now)
        assert meter.wrong_longest / S == pytest.approx(longest, abs=0.05)


def test_the_longest_time_without_a_pose_counts_from_the_fault_and_to_now():
    meter = FaultMeter(0.1)
    meter.add("sim/truth", truth(Pose2()), 0)
    meter.begin(1 * S)
    assert meter.without_pose(1500 * MS) == 500 * MS
    for at in (1700, 1800, 2000):
        meter.add("pose", PoseEstimate(0, Pose2(), Pose2(), np.zeros(9), 1.0, Localization.GOOD), at * MS)
    assert meter.without_pose(2100 * MS) == 700 * MS
    assert meter.without_pose(3 * S) == 1000 * MS


@pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here
def test_a_trial_in_lockstep_gives_the_same_twice_and_the_command_its_json(tmp_path, capsys):
    row = [row.name for row in FAULT_ROWS].index("scan_silent")
    trial = FaultTrial(row, DriveMode.NAVIGATION, 0.5, 3)
    first = fault_trial.lockstep("x80sv", trial)
    assert first == fault_trial.lockstep("x80sv", trial)
    assert missed_targets(first, FAULT_ROWS[row]) == []
    assert 0 < first.zero_ms < 600
    assert 0 < first.distance < 0.4
    out = tmp_path / "faults.json"
    status = _status(["bench", "faults", "--trials", "1", "--only", "scan_silent", "--out", str(out)])
    report = json.loads(out.read_text())
    assert status == (0 if report["summary"]["good"] == 1 else 1)
    assert report["trials"][0]["fault"] == "scan_silent"
    assert "scan_silent" in capsys.readouterr().out


class RestartingStack(LockstepStack):
    """A killed service is back after 0.4 s, as where a launcher starts it again."""

    killed_at: int | None = None

    def kill(self, name: str) -> None:
        super().kill(name)
        self.killed_at = self.now

    def is_back(self, name: str) -> bool:
        if self.killed_at is not None and self.now - self.killed_at >= 400 * MS:
            super().start(name)
            self.killed_at = None
        return self.killed_at is None

    def start(self, name: str) -> None:
        assert self.is_back(name)


@pytest.mark.timeout(600)
def test_a_killed_service_that_is_back_at_once_need_not_stop_the_robot(tmp_path):
    row = next(i for i, row in enumerate(FAULT_ROWS) if row.killed == "mapper")
    trial = FaultTrial(row, DriveMode.NAVIGATION, 0.5, 3)
    result = fault_trial.run_trial(RestartingStack("x80sv", fault_trial.settings_of("x80sv", trial, tmp_path)), trial)
    assert result.lasts == pytest.approx(0.4, abs=0.05)
    assert missed_targets(result, FAULT_ROWS[row]) == []
    stood_late = replace(result, lasts=2.0, zero_ms=inf)
    assert "never stood" in missed_targets(stood_late, FAULT_ROWS[row])
