# SPDX-License-Identifier: Apache-2.0
"""A replay gives the debug topics again, to the byte: that a client listens is an event."""

from collections import Counter
from pathlib import Path

import pytest

from shared import requests
from shared.config import load_robot
from shared.recording import CONFIG, Recording, Writer, sink
from shared.requests import Explore, Watch
from shared.runners.lockstep import Lockstep
from zenav.convert.foxglove import to_foxglove
from zenav.replay.reprocess import replay_file
from zenav.stack.service_loader import build_service

STACK = ("sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator")

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def test_a_replay_shows_what_was_shown(tmp_path: Path):
    file = load_robot("x80sv")
    robot = file.robot
    with Writer(tmp_path / "a.mcap", {"robot": robot.name}, {CONFIG: file.text.encode()}) as writer:
        lockstep = Lockstep({name: build_service(name, file, robot) for name in STACK}, sink(writer))
        lockstep.run(1.0)
        lockstep.ask(requests.EXPLORE, Explore(lockstep.now))
        lockstep.run(1.5)
        for row in (requests.WATCH, requests.WATCH_GRAPH, requests.WATCH_GLOBAL_COSTMAP):
            assert lockstep.ask(row, Watch(lockstep.now, 1.0)).accepted
        lockstep.run(2.0)
        lockstep.flush()
    recording = Recording(tmp_path / "a.mcap")
    keys = ["debug/costmap", "debug/rollouts", "debug/graph", "debug/global_costmap"]
    shown = Counter(entry.key for entry in recording.entries(keys))
    assert shown["debug/costmap"] == 5
    assert shown["debug/rollouts"] > 0
    assert shown["debug/graph"] == shown["debug/global_costmap"] == 1
    report = replay_file(
        recording.path,
        ["local_ctrl", "mapper", "planner"],
        None,
        lambda n: build_service(n, file, robot),
        lambda done, of: None,
    )
    assert report.equal, report.topics
    assert {topic.key: topic.n_equal for topic in report.topics if topic.key in shown} == dict(shown)
    assert to_foxglove(recording, tmp_path / "b.mcap", lambda share: None)[1] == []
