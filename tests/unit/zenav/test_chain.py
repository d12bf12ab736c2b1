# SPDX-License-Identifier: Apache-2.0
"""The latency chain of a recording, on a lockstep run whose delays are the registry's own."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from shared import topics
from shared.config import Section, load_robot
from shared.messages import LaserScan, Velocity
from shared.recording import Writer, sink
from shared.runners.lockstep import START, Lockstep
from shared.service import Out, Service, every, on
from zenav.bench.chain import Chain, chain
from zenav.bench.stack import figures

SECOND = 1_000_000_000
ROBOT = load_robot("x80sv").robot


class Sim(Service):
    @every(hz=8)
    def tick(self) -> Out:
        yield topics.SCAN(LaserScan(self.now, 0.0, 0.01, 0.1, 0.1, 5.0, np.ones(10, np.float32)))


class Control(Service):
    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        return ()

    @every(hz=20)
    def tick(self) -> Out:
        yield topics.CMD_NAV(Velocity(self.now, 0.1, 0.0, ""))


class SilentControl(Control):
    """Commands nothing in the second second."""

    @every(hz=20)
    def tick(self) -> Out:
        if not START + SECOND <= self.now < START + 2 * SECOND:
            yield topics.CMD_NAV(Velocity(self.now, 0.1, 0.0, ""))


class Guard(Service):
    @on(topics.CMD_NAV)
    def command(self, command: Velocity) -> Out:
        yield topics.CMD_VEL(Velocity(self.now, command.v, command.w, ""))


class Base(Service):
    @on(topics.CMD_VEL)
    def command(self, command: Velocity) -> Out:
        return ()


def recorded(path, seconds=2.0, **other):
    names = {"sim": Sim, "local_ctrl": Control, "guard": Guard, "base_driver": Base} | other
    with Writer(path) as writer:
        lockstep = Lockstep({name: made(Section(), ROBOT) for name, made in names.items() if made}, sink(writer))
        lockstep.run(seconds)
        lockstep.flush()
    return path


@pytest.fixture
def recording(tmp_path):
    return recorded(tmp_path / "run.mcap")


def test_the_parts_are_the_hops_and_the_wait_is_apart(recording):
    found = chain(recording)
    assert len(found.latency) == 16
    assert_allclose(found.to_control, topics.SCAN.within)
    assert_allclose(found.control, topics.CMD_NAV.within)
    assert_allclose(found.guard, topics.CMD_VEL.within)
    hops = topics.SCAN.within + topics.CMD_NAV.within + topics.CMD_VEL.within
    assert_allclose(found.latency, hops)
    assert found.wait.min() >= 0
    assert found.wait.max() <= 0.05
    assert_allclose(found.total, found.latency + found.wait)
    assert figures(found)["summary"]["latency_p99_ms"] == pytest.approx(hops * 1e3, abs=0.01)


def test_only_what_came_after_the_first_motion_counts(recording):
    found = chain(recording, START + SECOND)
    assert len(found.latency) == 8
    assert found.n_scans == 8


def test_every_scan_led_to_a_command(recording):
    found = chain(recording)
    assert found.n_scans == 16
    assert sum(found.lost.values()) == 0
    assert figures(found)["summary"]["n_scans_without_command"] == 0


def test_scans_that_led_to_no_command_are_counted_by_where_they_ended(tmp_path):
    found = chain(recorded(tmp_path / "silent.mcap", 3.0, local_ctrl=SilentControl))
    assert found.n_scans == 24
    assert len(found.latency) == 16
    assert found.lost == {"not taken by local_ctrl": 0, "no cmd/nav at the guard": 8, "no cmd/vel at the base": 0}
    summary = figures(found)["summary"]
    assert summary["n_scans"] == 24
    assert summary["n_scans_without_command"] == 8


def test_a_scan_that_local_ctrl_never_took_is_counted(tmp_path):
    class Deaf(SilentControl):
        @on(topics.ESTOP)
        def scan(self, scan):
            return ()

    found = chain(recorded(tmp_path / "deaf.mcap", 3.0, local_ctrl=Deaf))
    assert found.lost["not taken by local_ctrl"] == found.n_scans > 20


def test_what_the_recording_s_end_cuts_off_is_not_counted(tmp_path):
    path = recorded(tmp_path / "cut.mcap", 0.88)
    assert sum(chain(path).lost.values()) == 0


def of_seconds(latency, handlers):
    """A chain of ten scans a second with the latencies (s) of each second, and what health said of the handlers."""
    n = len(latency)
    stamps = START + np.concatenate([k * SECOND + np.arange(10) * SECOND // 10 for k in range(n)])
    spread = np.concatenate([np.linspace(value / 2, value, 10) for value in latency])
    nothing = np.zeros(10 * n)
    reports = START + (np.arange(n) + 1) * SECOND
    health = {name: np.column_stack((reports, values)) for name, values in handlers.items()}
    return Chain(stamps, spread, nothing, nothing, nothing, health, {}, 10 * n)


def test_the_slowest_scan_of_a_second_is_compared_with_the_slowest_handlers_of_that_second():
    chain_of = of_seconds([0.010, 0.030, 0.012], {"sim": [0.001] * 3, "local_ctrl": [0.004, 0.019, 0.005]})
    assert_allclose(chain_of.by_second, [(0.010, 0.005), (0.030, 0.020), (0.012, 0.006)])
    summary = figures(chain_of)["summary"]
    assert summary["ratio_to_handlers"] == pytest.approx(2.0)  # the median of 2.0, 1.5, 2.0
    assert summary["handlers_ms"] == pytest.approx(6.0)


def test_a_single_slow_second_of_both_is_no_higher_ratio():
    steady = of_seconds([0.012] * 9, {"local_ctrl": [0.008] * 9})
    stalled = of_seconds([0.012] * 8 + [0.120], {"local_ctrl": [0.008] * 8 + [0.080]})
    ratios = [figures(found)["summary"]["ratio_to_handlers"] for found in (steady, stalled)]
    assert ratios == [1.5, 1.5]


def test_a_second_in_which_a_service_told_no_health_is_not_compared():
    chain_of = of_seconds([0.010, 0.030], {"sim": [0.001, 0.001], "local_ctrl": [0.004, 0.019]})
    chain_of.handlers["sim"] = chain_of.handlers["sim"][:1]
    assert_allclose(chain_of.by_second, [(0.010, 0.005)])


def test_the_wait_for_the_control_tick_is_published_too(recording):
    found = chain(recording)
    summary = figures(found)["summary"]
    assert summary["with_wait_p50_ms"] == pytest.approx(np.percentile(found.total, 50) * 1e3, abs=0.01)
    assert summary["with_wait_p99_ms"] == pytest.approx(np.percentile(found.total, 99) * 1e3, abs=0.01)
    assert summary["with_wait_p99_ms"] >= summary["latency_p99_ms"]
