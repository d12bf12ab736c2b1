# SPDX-License-Identifier: Apache-2.0
"""`zenav bench soak`: what counts as growth, and what a fault's report measures."""

import os
from math import inf

import numpy as np
import pytest

from shared.geometry import Pose2
from shared.messages import GuardState, GuardStatus, MotorCommand, Truth
from zenav.bench.service_faults import FaultReport, Faults
from zenav.bench.soak import ProcessSample, growths, sample

NONE = np.empty(0, np.float32)


def life(pid, pss, since=0.0, n=50):
    return [ProcessSample(since + 5.0 * i, pid, pss(i), 20, 9) for i in range(n)]


def test_a_process_that_keeps_its_size_holds():
    (row,) = growths({"guard": life(7, lambda i: 40.0 + (i % 2))}, since=0.0)
    assert row.holds


@pytest.mark.parametrize("growth", [0.06, 0.5])
def test_a_process_that_grows_by_over_a_twentieth_does_not_hold(growth):
    (row,) = growths({"guard": life(7, lambda i: 40.0 * (1 + 1.3 * growth * i / 49))}, since=0.0)
    assert not row.holds


def test_one_more_file_handle_does_not_hold():
    rows = life(7, lambda i: 40.0)
    rows[-15:] = [ProcessSample(s.at, s.pid, s.pss, s.n_files + 1, s.n_threads) for s in rows[-15:]]
    (row,) = growths({"guard": rows}, since=0.0)
    assert row.files == 1
    assert not row.holds


def test_growth_before_the_warm_up_and_of_an_earlier_life_does_not_count():
    early = life(6, lambda i: 10.0 * i) + life(7, lambda i: min(10.0 * i, 200.0), since=250.0)
    (row,) = growths({"mapper": early}, since=400.0)
    assert row.holds


def test_this_process_has_a_sample():
    found = sample(os.getpid(), 1.0)
    assert found is not None
    assert found.pss > 1
    assert found.n_files > 0
    assert found.n_threads > 0


def test_a_process_that_has_ended_has_none():
    assert sample(2**22 - 1, 1.0) is None


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
