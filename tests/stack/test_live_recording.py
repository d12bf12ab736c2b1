# SPDX-License-Identifier: Apache-2.0
"""What ran over Zenoh replays to the byte: late joiners, a restart, background work, whatever order things came in."""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from services.recorder.recording_store import RecorderConfig, RecordingStore
from services.recorder.service import RecorderService
from shared.codec import Envelope, decode, envelope_of
from shared.geometry import Pose2
from shared.messages import MapUpdate
from shared.recording import Recording
from shared.runners import transport
from shared.runners.clock import StackClock
from shared.runners.host import LATCHED
from shared.runners.latched_disk import LatchedDisk
from shared.runners.live_runner import LiveRunner
from shared.service import Service
from tests.stack import processes
from tests.stack.processes import ALL, wait
from tests.stack.test_live import free_stack
from tests.toys import ROBOT, build
from zenav.recording.opening import recorded_robot_file
from zenav.replay.report import service_builder
from zenav.replay.reprocess import replay_file

CHAIN = ["base_driver", "odometry", "mapper", "planner"]


class Watched(RecorderService):
    """Can be waited for: `hears` returns when each key came so often again."""

    def __init__(self, config: RecorderConfig, store: RecordingStore) -> None:
        super().__init__(config, ROBOT, store)
        self.wanted: Counter[str] = Counter()
        self.satisfied = threading.Event()

    def raw(self, key: str, payload: bytes, envelope: Envelope, now: int, latched: bool = False) -> None:
        super().raw(key, payload, envelope, now, latched)
        self.wanted.subtract([key])
        if not +self.wanted:
            self.satisfied.set()

    def hears(self, **counts: int) -> bool:
        self.wanted = Counter({key.replace("_", "/"): n for key, n in counts.items()})
        self.satisfied.clear()
        return self.satisfied.wait(60)


def recorded(session: zenoh.Session, name: str) -> bool:
    """Returns when the recorder hears this service: on a busy machine its first journal could go by before that."""
    publisher, found = session.declare_publisher(f"{ROBOT.name}/journal/{name}"), threading.Event()
    publisher.declare_matching_listener(lambda status: found.set() if status.matching else None)
    there: Any = publisher.matching_status  # its stub says bool, it is an object
    return there.matching or found.wait(60)


@contextmanager
def running(
    service: Service, name: str, where: transport.StackAddress, memory: LatchedDisk | None = None
) -> Iterator[LiveRunner]:
    with transport.opened(where, name) as session:
        live = LiveRunner(service, name, ROBOT.name, session, StackClock(), memory)
        if not isinstance(service, RecorderService):
            assert recorded(session, name)
        thread = threading.Thread(target=live.run)
        thread.start()
        try:
            yield live
        finally:
            live.stop()
            thread.join(10)
            assert not thread.is_alive()


def test_a_live_run_replays_to_the_byte(tmp_path):
    where, memory = transport.StackAddress(free_stack()), LatchedDisk(tmp_path, "mapper")
    config = RecorderConfig(file=str(tmp_path / "a.mcap"))
    store = RecordingStore(config)
    recorder = Watched(config, store)
    with running(recorder, "recorder", where) as live:
        with running(build("base_driver"), "base_driver", where), running(build("odometry"), "odometry", where):
            with running(build("mapper"), "mapper", where, memory), running(build("planner"), "planner", where):
                assert recorder.hears(plan=3, health_mapper=3)  # its memory is written between two healths
            with running(build("mapper"), "mapper", where, memory):
                assert recorder.hears(map=2)
                with running(build("planner"), "planner", where):
                    assert recorder.hears(plan=3)
        assert live.stats.bad == 0
    store.close()

    recording = Recording(tmp_path / "a.mcap")
    lives = recording.lives()
    assert {name: len(lives[name]) for name in CHAIN} == {"base_driver": 1, "odometry": 1, "mapper": 2, "planner": 2}
    assert lives["mapper"][1].events[0].kind == LATCHED  # its own map
    report = replay_file(tmp_path / "a.mcap", CHAIN, tmp_path / "out.mcap", build, lambda done, of: None)
    assert report.notes == []
    assert report.equal, report
    counts = {topic.key: topic.n_equal for topic in report.topics}
    assert min(counts[key] for key in ("base/wheels", "odom", "pose", "map", "plan")) >= 3
    assert [e.payload for e in Recording(tmp_path / "out.mcap").entries()] == [e.payload for e in recording.entries()]


@pytest.mark.timeout(300)
def test_the_real_stack_driving_replays_to_the_byte_service_by_service_and_as_a_chain(tmp_path):
    path = tmp_path / "drive.mcap"
    with processes.running(tmp_path / "logs", ("recorder", *ALL), settings=(f"recorder.file={path}",)) as stack:
        stack.until(stack.reached(stack.go(Pose2(1.0, 0.2, 0.0))))
    recording = Recording(path)
    file = recorded_robot_file(recording)
    assert file is not None
    for names in (*([name] for name in ALL), list(ALL)):
        report = replay_file(path, names, None, service_builder(file), lambda done, of: None)
        assert report.notes == [], names
        assert report.equal, [topic for topic in report.topics if not topic.equal]
        assert sum(topic.n_equal for topic in report.topics) > 4
    assert sum(topic.n_equal for topic in report.topics) > 500


def test_a_recorder_that_comes_late_records_what_was_latched_before(tmp_path):
    where = transport.StackAddress(free_stack())
    store = RecordingStore(RecorderConfig(file=str(tmp_path / "a.mcap")))
    early = Watched(RecorderConfig(), RecordingStore(RecorderConfig(file=str(tmp_path / "first.mcap"))))
    with (
        running(early, "recorder", where),
        running(build("base_driver"), "base_driver", where),
        running(build("odometry"), "odometry", where),
        running(build("mapper"), "mapper", where),
        transport.opened(where) as session,
    ):
        assert early.hears(map=3, pose=1)
        everything, heard = transport.Everything(session, ROBOT.name), list[transport.RawSample]()
        limit = time.monotonic() + 20
        while not any(arrival.latched and arrival.key == f"{ROBOT.name}/map" for arrival in heard):
            assert time.monotonic() < limit
            wait(0.05)
            heard += everything.take_all()
    late = RecorderService(RecorderConfig(), ROBOT, store)
    for full_key, payload, at, latched in heard:  # as the runner's loop: one by one
        late.raw(full_key.removeprefix(f"{ROBOT.name}/"), payload, envelope_of(payload), at, latched)
    early._store.close()
    store.close()
    entries = list(Recording(tmp_path / "a.mcap").entries())
    kept = next(entry for entry in entries if entry.key == "map" and entry.latched)
    assert len(decode(MapUpdate, kept.payload)[0].rows) >= 3
