# SPDX-License-Identifier: Apache-2.0
"""The latency chain of a recording, on a lockstep run whose delays are the registry's own."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from shared import topics
from shared.config import Section, load_robot
from shared.messages import LaserScan, Velocity
from shared.recording import Writer, sink
from shared.runners.lockstep import Lockstep
from shared.service import Out, Service, every, on
from zenav.bench.chain import chain
from zenav.bench.stack import figures

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


class Guard(Service):
    @on(topics.CMD_NAV)
    def command(self, command: Velocity) -> Out:
        yield topics.CMD_VEL(Velocity(self.now, command.v, command.w, ""))


class Base(Service):
    @on(topics.CMD_VEL)
    def command(self, command: Velocity) -> Out:
        return ()


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "run.mcap"
    names = {"sim": Sim, "local_ctrl": Control, "guard": Guard, "base_driver": Base}
    with Writer(path) as writer:
        lockstep = Lockstep({name: made(Section(), ROBOT) for name, made in names.items()}, sink(writer))
        lockstep.run(2.0)
        lockstep.flush()
    return path


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
    from shared.runners.lockstep import START

    assert len(chain(recording, START + 1_000_000_000).latency) == 8
