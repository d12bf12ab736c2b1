# SPDX-License-Identifier: Apache-2.0
"""`zenav bench soak`: what counts as growth, and what a fault's report measures."""

import os
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import GuardState, GuardStatus, MotorCommand, Truth
from zenav.bench.service_faults import FaultReport, Faults
from zenav.bench.soak import SoakPlan, longest_standing, map_error_of, report_of, waiting_grows
from zenav.bench.soak_runs import run_virtual
from zenav.bench.soak_samples import ServiceSample, growths, joined_small, process_sample, state_mb
from zenav.console.shutdown import StopFlag
from zenav.metrics.evaluation import RunTrack
from zenav.scenario.scenario import load_scenario

NONE = np.empty(0, np.float32)


def life(pid, memory, since=0.0, n=50):
    return [ServiceSample(since + 5.0 * i, pid, memory(i), 20, 9, 0.02) for i in range(n)]


def test_a_process_that_keeps_its_size_holds():
    (row,) = growths({"guard": life(7, lambda i: 40.0 + (i % 2))}, since=0.0)
    assert row.faults == []


@pytest.mark.parametrize("growth", [0.06, 0.5])
def test_a_process_that_grows_by_over_a_twentieth_does_not_hold(growth):
    (row,) = growths({"guard": life(7, lambda i: 40.0 * (1 + 1.3 * growth * i / 49))}, since=0.0)
    assert row.faults == ["memory"]


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("n_files", 21, "file handles"),
        ("n_threads", 10, "threads"),
        ("age", 0.09, "the age of its messages"),
        ("dropped", 1, "dropped messages"),
    ],
)
def test_each_thing_that_grows_is_named(field, value, words):
    rows = life(7, lambda i: 40.0)
    rows[-15:] = [replace(row, **{field: value}) for row in rows[-15:]]
    (row,) = growths({"guard": rows}, since=0.0)
    assert row.faults == [words]


def test_growth_before_the_warm_up_and_of_an_earlier_life_does_not_count():
    early = life(6, lambda i: 10.0 * i) + life(7, lambda i: min(10.0 * i, 200.0), since=250.0)
    (row,) = growths({"mapper": early}, since=400.0)
    assert row.faults == []


def test_small_states_are_judged_by_their_sum():
    together = joined_small({"a": life(1, lambda i: 0.2), "b": life(1, lambda i: 0.3), "c": life(1, lambda i: 9.0)})
    assert {name: rows[-1].memory for name, rows in together.items()} == {"c": 9.0, "the others": 0.5}


def test_this_process_has_a_sample():
    found = process_sample(os.getpid(), 1.0, None)
    assert found is not None
    assert found.memory > 1
    assert found.n_files > 0
    assert found.n_threads > 0


def test_a_process_that_has_ended_has_none():
    assert process_sample(2**22 - 1, 1.0, None) is None


class Holder:
    def __init__(self, n):
        self.rows = [np.zeros(125_000) for _ in range(n)]
        self.part, self.twice = np.zeros(250_000)[:10], self.rows


def test_a_state_counts_each_array_once_and_a_part_with_the_whole():
    assert state_mb(Holder(3)) == pytest.approx(5.0, abs=0.01)
    assert state_mb(Holder(5)) - state_mb(Holder(4)) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(("at_the_end", "grows"), [(100, False), (140, False), (200, True)])
def test_events_that_pile_up_are_named(at_the_end, grows):
    waiting = [(30.0 * i, 100 if i < 25 else at_the_end) for i in range(50)]
    assert bool(waiting_grows(waiting, since=0.0)) is grows


def test_the_longest_time_at_one_place_is_found_and_what_was_before_the_first_motion_does_not_count():
    track = RunTrack()
    positions = [0.0] * 500 + [0.01 * i for i in range(500)] + [5.0] * 400 + [5.0 + 0.01 * i for i in range(300)]
    for i, x in enumerate(positions):
        track.add(
            Truth(20_000_000 * i, Pose2(x, 0, 0), Pose2(), 0.5 if i >= 500 else 0.0, 0.0, False, 0, x, NONE, NONE), 0
        )
    assert longest_standing(track) == pytest.approx(8.0, abs=0.4)


def test_another_file_is_no_report_to_compare_with(tmp_path):
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(UserError, match=r"other\.json is no report"):
        map_error_of(tmp_path / "other.json")


def test_services_die_in_lockstep_and_the_run_goes_on(tmp_path):
    tours = load_scenario("x80sv", "office", 0, [])
    faults = Faults(tours.names, 2.0, np.random.default_rng(1))
    run = run_virtual(tours, 32.0, tmp_path / "run.mcap", StopFlag(), faults)
    report = report_of(run, tmp_path / "run.mcap", SoakPlan(0.5, 2.0, 0, lockstep=True), reference=0.001)
    assert len(run.faults) >= 5
    assert {row.kind for row in run.faults} == {"kill"}
    assert report["summary"]["contacts"] == 0
    assert report["summary"]["max_zero_s"] <= 0.25
    assert report["summary"]["cpu_ms_per_s_last"] > 0
    assert [line for line in report["broken"] if "mean wall error" in line], "a map ten times as bad is not named"
    assert run.waiting


def truth(v):
    return Truth(0, Pose2(), Pose2(), v, 0.0, False, 0, 0.0, NONE, NONE)


def struck():
    """Faults, at the moment when one has just begun at 1 s of the stack's clock, while the robot drove."""
    faults = Faults(["guard"], 20.0, np.random.default_rng(0))
    faults.reports.append(FaultReport("guard", "kill", 10.0, 0.0, True))
    faults._fault_ns = faults._last_motion_command = 10**9
    faults._goes_on, faults._resumes_from = True, 10.0
    return faults


def command(faults, milliseconds, left):
    faults._hear(MotorCommand(0, left, left), 10**9 + milliseconds * 10**6)


def test_the_zero_command_is_that_after_the_last_one_that_moves():
    faults = struck()
    for at in range(0, 180, 20):
        command(faults, at, 5.0)
    for at in range(180, 400, 20):
        command(faults, at, 0.0)
    command(faults, 400, 5.0)  # the service is back
    faults._hear(truth(0.0), 0)
    faults._measure(10.4)
    assert faults.reports[0].zero_s == pytest.approx(0.16)


def test_a_board_without_commands_has_stopped():
    faults = struck()
    command(faults, 60, 5.0)
    command(faults, 900, 5.0)
    faults._measure(10.4)
    assert faults.reports[0].zero_s == pytest.approx(0.06)


def test_the_robot_has_resumed_when_it_moves_and_not_before_half_a_second():
    faults = struck()
    faults._hear(truth(0.4), 0)
    faults._measure(10.3)
    assert faults.reports[0].resumed_s == inf
    faults._hear(truth(0.0), 0)
    faults._measure(13.0)
    assert faults.reports[0].resumed_s == inf
    faults._hear(GuardStatus(0, GuardState.HOLD, "nav", "odom_old", "", 0.0), 0)
    faults._hear(truth(0.2), 0)
    faults._measure(14.0)
    assert faults.reports[0].resumed_s == pytest.approx(4.0)
    assert faults.reports[0].reasons == ("odom_old",)
