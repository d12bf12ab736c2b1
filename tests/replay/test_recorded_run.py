# SPDX-License-Identifier: Apache-2.0
"""A run of the whole stack, recorded, goes through each of its services again and gives what it gave, to the byte."""

from pathlib import Path

import pytest

from shared import requests, topics
from shared.config import RobotFile, load_robot
from shared.messages import EmergencyStop
from shared.recording import CONFIG, Recording, Writer, sink
from shared.requests import Explore
from shared.runners.host import LATCHED
from shared.runners.lockstep import Lockstep
from shared.service import Service
from zenav.classes import made
from zenav.replay import Report, replay_file, robot_file

STACK = ("sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator")

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def service(name: str, file: RobotFile) -> Service:
    return made(name, file, file.robot)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight seconds of exploring, in which the mapper dies and comes back; under STOP, guard and base driver do."""
    path, file = tmp_path_factory.mktemp("run") / "run.mcap", load_robot("x80sv")
    with Writer(path, {"robot": file.robot.name}, {CONFIG: file.text.encode()}) as writer:
        lockstep = Lockstep({name: service(name, file) for name in STACK}, sink(writer))
        lockstep.run(1.0)
        assert lockstep.ask(requests.EXPLORE, Explore(lockstep.now)).accepted
        lockstep.run(3.7)
        lockstep.kill("mapper")
        lockstep.run(0.5)
        lockstep.start("mapper", service("mapper", file))
        lockstep.run(1.8)
        lockstep.publish(topics.ESTOP(EmergencyStop(lockstep.now, True, "test")))
        lockstep.run(0.33)
        for name in ("guard", "base_driver"):
            lockstep.kill(name)
            lockstep.run(0.21)
            lockstep.start(name, service(name, file))
        lockstep.run(0.5)
        lockstep.flush()
    return path


def replayed(path: Path, names: list[str], out: Path | None = None) -> Report:
    file = robot_file(Recording(path))
    assert file is not None
    return replay_file(path, names, out, lambda name: service(name, file), lambda done, of: None)


@pytest.mark.parametrize("name", STACK)
def test_each_service_gives_what_it_gave(run, name):
    report = replayed(run, [name])
    assert report.notes == []
    assert report.equal, report.topics
    assert sum(topic.n_equal for topic in report.topics) >= 4


@pytest.mark.parametrize(("name", "key"), [("guard", "guard/status"), ("base_driver", "base/status")])
def test_a_restarted_service_hears_first_what_it_had_latched_itself(run, name, key):
    before, after = Recording(run).lives()[name]
    first = after.events[0]
    assert (first.kind, first.key, first.session) == (LATCHED, key, before.session)


def test_the_whole_stack_gives_the_recording_again(run, tmp_path):
    report = replayed(run, list(STACK), tmp_path / "out.mcap")
    assert report.notes == []
    assert report.equal, report.topics
    assert list(Recording(tmp_path / "out.mcap").entries()) == list(Recording(run).entries())


def test_a_recording_of_seconds_stays_small(run):
    assert run.stat().st_size < 1_000_000
