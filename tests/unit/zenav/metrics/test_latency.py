# SPDX-License-Identifier: Apache-2.0
"""The latency chain of a recording, on a lockstep run whose delays are the registry's own."""

from time import thread_time

import numpy as np
import pytest
from numpy.testing import assert_allclose

from shared import topics
from shared.codec import envelope_of
from shared.config import Section, load_robot
from shared.messages import LaserScan, Velocity
from shared.recording import Recording, Writer, sink
from shared.runners.lockstep import START, Lockstep
from shared.service import Out, Service, every, on
from shared.types import NS_PER_S
from zenav.metrics.latency import LatencyChain, handler_times, latency_chain, latency_figures

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
        if not START + NS_PER_S <= self.now < START + 2 * NS_PER_S:
            yield topics.CMD_NAV(Velocity(self.now, 0.1, 0.0, ""))


class PassingGuard(Service):
    @on(topics.CMD_NAV)
    def command(self, command: Velocity) -> Out:
        yield topics.CMD_VEL(Velocity(self.now, command.v, command.w, ""))


class ListeningBase(Service):
    @on(topics.CMD_VEL)
    def command(self, command: Velocity) -> Out:
        return ()


def recorded(path, seconds=2.0, **other):
    names = {"sim": Sim, "local_ctrl": Control, "guard": PassingGuard, "base_driver": ListeningBase} | other
    with Writer(path) as writer:
        lockstep = Lockstep({name: made(Section(), ROBOT) for name, made in names.items() if made}, sink(writer))
        lockstep.run(seconds)
        lockstep.flush()
    return path


@pytest.fixture
def recording(tmp_path):
    return recorded(tmp_path / "run.mcap")


def test_the_parts_are_the_hops_and_the_wait_is_apart(recording):
    found = latency_chain(recording)
    assert len(found.latency) == 16
    assert_allclose(found.to_control, topics.SCAN.within)
    assert_allclose(found.control, topics.CMD_NAV.within)
    assert_allclose(found.guard, topics.CMD_VEL.within)
    hops = topics.SCAN.within + topics.CMD_NAV.within + topics.CMD_VEL.within
    assert_allclose(found.latency, hops)
    assert found.wait.min() >= 0
    assert found.wait.max() <= 0.05
    assert_allclose(found.total, found.latency + found.wait)
    assert latency_figures(found)["summary"]["latency_p99_ms"] == pytest.approx(hops * 1e3, abs=0.01)


def test_a_member_s_latency_ends_where_it_took_the_command(recording):
    taken = {
        (envelope.session, envelope.sequence): envelope.sent + 3_000_000
        for envelope in (envelope_of(entry.payload) for entry in Recording(recording).entries(("cmd/vel",)))
        if envelope.sent >= START + NS_PER_S
    }
    figures = latency_figures(latency_chain(recording, at_member=taken))
    expected = topics.SCAN.within + topics.CMD_NAV.within + 0.003
    assert figures["summary"]["member_p99_ms"] == pytest.approx(expected * 1e3, abs=0.01)
    assert figures["summary"]["n_member"] == 8  # of 16: the member came after a second
    assert "member_p99_ms" not in latency_figures(latency_chain(recording))["summary"]


def test_only_what_came_after_the_first_motion_counts(recording):
    found = latency_chain(recording, START + NS_PER_S)
    assert len(found.latency) == 8
    assert found.n_scans == 8


def test_every_scan_led_to_a_command(recording):
    found = latency_chain(recording)
    assert found.n_scans == 16
    assert sum(found.lost.values()) == 0
    assert latency_figures(found)["summary"]["n_scans_without_command"] == 0


def test_scans_that_led_to_no_command_are_counted_by_where_they_ended(tmp_path):
    found = latency_chain(recorded(tmp_path / "silent.mcap", 3.0, local_ctrl=SilentControl))
    assert found.n_scans == 24
    assert len(found.latency) == 16
    assert found.lost == {"not taken by local_ctrl": 0, "no cmd/nav at the guard": 8, "no cmd/vel at the base": 0}
    summary = latency_figures(found)["summary"]
    assert summary["n_scans"] == 24
    assert summary["n_scans_without_command"] == 8


def test_a_scan_that_local_ctrl_never_took_is_counted(tmp_path):
    class ControlWithoutScans(SilentControl):
        @on(topics.ESTOP)
        def scan(self, scan):
            return ()

    found = latency_chain(recorded(tmp_path / "deaf.mcap", 3.0, local_ctrl=ControlWithoutScans))
    assert found.lost["not taken by local_ctrl"] == found.n_scans > 20


def test_what_the_recording_s_end_cuts_off_is_not_counted(tmp_path):
    path = recorded(tmp_path / "cut.mcap", 0.88)
    assert sum(latency_chain(path).lost.values()) == 0


class SlowControl(Control):
    """Takes 4 ms for each command, and 20 ms for each scan, before the tick."""

    @every(hz=20)
    def tick(self) -> Out:
        spend(0.004)
        yield topics.CMD_NAV(Velocity(self.now, 0.1, 0.0, ""))

    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        spend(0.020)
        return ()


def spend(seconds):
    until = thread_time() + seconds
    while thread_time() < until:
        pass


def test_the_handlers_of_a_scan_are_those_that_made_its_command(tmp_path):
    names = {"sim": Sim, "local_ctrl": SlowControl, "guard": PassingGuard, "base_driver": ListeningBase}
    path = recorded(tmp_path / "slow.mcap", **names)
    spent = handler_times(path, lambda name: names[name](Section(), ROBOT))
    handlers = latency_chain(path, spent=spent).handlers
    assert len(handlers) == 16
    assert 0.004 < np.median(handlers) < 0.008


def of(latency, handlers):
    """A chain with these latencies and handlers, s, of each scan."""
    nothing = np.zeros(len(latency))
    return LatencyChain(
        to_control=np.array(latency),
        wait=nothing,
        control=nothing,
        guard=nothing,
        member=nothing * np.nan,
        handlers=np.array(handlers),
        sent=np.zeros(len(latency), np.int64),
        lost={},
        n_scans=len(latency),
    )


def test_latency_is_compared_with_the_handlers_of_the_same_scans_percentile_by_percentile():
    summary = latency_figures(of([0.012] * 90 + [0.120] * 10, [0.008] * 90 + [0.060] * 10))["summary"]
    assert summary["ratio_to_handlers_p50"] == 1.5
    assert summary["ratio_to_handlers"] == 2.0
    assert summary["handlers_p99_ms"] == 60.0


def test_scans_whose_handlers_are_unknown_are_not_compared():
    summary = latency_figures(of([0.012] * 50 + [0.9] * 50, [0.008] * 50 + [np.nan] * 50))["summary"]
    assert summary["ratio_to_handlers"] == 1.5
    assert summary["latency_p99_ms"] == 900.0
    unknown = latency_figures(of([0.012], [np.nan]))
    assert unknown["summary"]["ratio_to_handlers"] is None
    assert "the handlers on the way, alone" not in unknown["parts"]


def test_the_wait_for_the_control_tick_is_published_too(recording):
    found = latency_chain(recording)
    summary = latency_figures(found)["summary"]
    assert summary["with_wait_p50_ms"] == pytest.approx(np.percentile(found.total, 50) * 1e3, abs=0.01)
    assert summary["with_wait_p99_ms"] == pytest.approx(np.percentile(found.total, 99) * 1e3, abs=0.01)
    assert summary["with_wait_p99_ms"] >= summary["latency_p99_ms"]
