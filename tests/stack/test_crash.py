# SPDX-License-Identifier: Apache-2.0
"""A live service that dies by an exception leaves a recording that raises the same one in the same event."""

import io
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from services.recorder.recording_store import RecorderConfig, RecordingStore
from shared import requests, topics
from shared.codec import Envelope, decode, encode
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import MapUpdate, NavTask, Odometry, TaskKind
from shared.recording import Recording
from shared.requests import Cancel, LoadMap, Pause
from shared.runners import transport
from shared.runners.blackbox import BlackBox, crash_in, crash_of
from shared.runners.client import Client
from shared.runners.clock import StackClock
from shared.runners.journal import HOLE
from shared.runners.latched_disk import LatchedDisk
from shared.runners.live_runner import LiveRunner
from shared.runners.replay import replay
from shared.service import Answer, Job, Out, Service, answer, every, on
from tests.stack.test_live import free_stack, running
from tests.stack.test_live_recording import Watched
from tests.toys import DEFAULTS, ROBOT, Plan, Tiles, build, tile
from zenav.recording.opening import recorded_robot_file
from zenav.replay import report
from zenav.replay.player_clock import PlaybackOptions
from zenav.replay.report import print_crash
from zenav.stack.launch import ROOT


class DyingPlan(Plan):
    """Dies in its fifth plan on a map, with words that hold all that it knows."""

    def __init__(self) -> None:
        super().__init__(DEFAULTS, ROBOT)
        self.n_plans = 0

    @every(hz=5)
    def plan(self) -> Out:
        yield from super().plan()
        self.n_plans += self.map is not None
        if self.n_plans == 5 and self.map is not None:
            raise ZeroDivisionError(f"x {self.x!r}, map {self.map.version} {self.map.cells.sum()}")


class DyingTiles(Tiles):
    """Dies on a map from outside, in a job of its own, or in the tenth update of its map after a restart."""

    def __init__(self, dies: str) -> None:
        super().__init__(DEFAULTS, ROBOT)
        self.dies = dies

    @answer(requests.LOAD_MAP)
    def load(self, request: LoadMap) -> Answer[requests.Reply]:
        reply = yield from super().load(request)
        raise RuntimeError(f"bonus {self.bonus}, odometries {self.n_odometries}, row {request.map.rows[0]}")
        return reply

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        yield from super().odometry(odometry)
        if self.dies == "job" and self.n_odometries == 30:
            yield Job(divided, (self.n_odometries,), done="counted", takes=0.1)

    @every(hz=2)
    def draw(self) -> Out:
        yield from super().draw()
        if self.dies == "restart" and self.version > 12:
            raise RuntimeError(f"version {self.version}")


class DyingTask(Service):
    """Gets a task while a job of it runs, and dies before that ends."""

    def __init__(self, until: threading.Event) -> None:
        super().__init__(DEFAULTS, ROBOT)
        self.until = until

    @on(topics.TASK)
    def restored(self, task: NavTask) -> Out:
        return ()

    @answer(requests.CANCEL)
    def cancel(self, request: Cancel) -> Answer[requests.Reply]:
        yield Job(self.until.wait, (), done="waited", takes=1.0)
        unused = (False, (), (), 1, False, 0.0, 0.0, 0, 0, False, 0.0)
        yield topics.TASK(NavTask(self.now, 7, TaskKind.NONE, 0.0, 0, *unused))
        return requests.Reply(self.now, True, "", "", 7)

    @answer(requests.PAUSE)
    def pause(self, request: Pause) -> Answer[requests.Reply]:
        raise RuntimeError("no pause")
        yield

    def waited(self, is_set: bool) -> Out:
        return ()


def divided(n: int) -> int:
    raise ArithmeticError(f"{n} / 0")


@contextmanager
def dying(service: Service, name: str, where: transport.StackAddress, folder: Path) -> Iterator[threading.Thread]:
    """Runs it until it dies; the traceback goes nowhere."""
    box = BlackBox(folder, name, ROBOT.name, "")
    with transport.opened(where, name) as session:
        live = LiveRunner(service, name, ROBOT.name, session, StackClock(), LatchedDisk(folder / "memory", name), box)

        def run() -> None:
            with suppress(ZeroDivisionError, RuntimeError, ArithmeticError):
                live.run()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield thread
        finally:
            live.stop()
            thread.join(20)
            assert not thread.is_alive()


def crash(folder: Path, name: str) -> Recording:
    """The one recording of a crash, and nothing else that the box left."""
    (path,) = folder.glob(f"crash-{name}-*.mcap")
    assert not list(folder.glob("life-*"))
    return Recording(path)


@pytest.fixture
def where() -> transport.StackAddress:
    return transport.StackAddress(free_stack())


def test_a_late_joiner_that_dies_in_a_tick_is_replayed_from_its_black_box(tmp_path, where, capsys):
    with (
        running(build("base_driver"), "base_driver", where),
        running(build("odometry"), "odometry", where),
        running(build("mapper"), "mapper", where) as mapper,
    ):
        while mapper.host.n_events < 60:
            threading.Event().wait(0.05)
        with dying(DyingPlan(), "planner", where, tmp_path) as thread:
            thread.join(20)
    recording = crash(tmp_path, "planner")
    assert recording.problems == []
    (life,) = recording.lives()["planner"]
    assert life.events[0].kind != HOLE
    with pytest.raises(ZeroDivisionError, match="map") as raised:
        replay(recording, ["planner"], lambda name: DyingPlan())
    assert f"event {len(life.events) - 1} at {life.events[-1].now} ns" in raised.value.__notes__[0]
    assert crash_of(raised.value) == crash_in(recording, "planner") != ""
    assert print_crash(raised.value, recording, ["planner"], False) == 1
    assert "as recorded, the same exception in the same event" in capsys.readouterr().err


@pytest.mark.parametrize(("dies", "error"), [("request", RuntimeError), ("job", ArithmeticError)])
def test_a_request_and_a_job_that_kill_are_replayed(tmp_path, where, dies, error):
    with (
        running(build("base_driver"), "base_driver", where),
        running(build("odometry"), "odometry", where),
        transport.opened(where) as tool,
        dying(DyingTiles(dies), "mapper", where, tmp_path) as thread,
    ):
        if dies == "request":
            with Client(ROBOT.name, where) as client:
                assert client.answers(requests.LOAD_MAP, 20.0)
            update = MapUpdate(1, 7, 1, 0.05, *2 * [tile_row()], tile(5, 5))
            payload = encode(LoadMap(1, update, Pose2()), Envelope("operator", "o", 0, 1))
            list(tool.get(f"{ROBOT.name}/request/load_map", payload=payload, timeout=20.0))
        thread.join(20)
    recording = crash(tmp_path, "mapper")
    with pytest.raises(error) as raised:
        replay(recording, ["mapper"], lambda name: DyingTiles(dies))
    assert crash_of(raised.value) == crash_in(recording, "mapper") != ""


def test_what_was_to_be_kept_is_kept_though_a_job_runs_when_the_service_dies(tmp_path, where):
    job_ends = threading.Event()
    with dying(DyingTask(job_ends), "navigator", where, tmp_path) as thread, Client(ROBOT.name, where) as client:
        assert client.answers(requests.PAUSE, 20.0)
        assert client.ask(requests.CANCEL, Cancel(client.now())).task_id == 7
        with pytest.raises(UserError):  # it dies instead of a reply
            client.ask(requests.PAUSE, Pause(client.now(), True), 1.0)
        thread.join(20)
    kept = LatchedDisk(tmp_path / "memory", "navigator").read("nav/task")
    job_ends.set()
    assert kept is not None
    assert decode(NavTask, kept)[0].task_id == 7


def tile_row():  # type: ignore[no-untyped-def]
    import numpy as np

    return np.array([5], np.int32)


def test_a_recorder_that_ran_from_the_start_has_the_crash_too(tmp_path, where):
    config = RecorderConfig(file=str(tmp_path / "run.mcap"))
    store = RecordingStore(config)
    recorder = Watched(config, store)
    with running(recorder, "recorder", where), running(build("mapper"), "mapper", where):
        assert recorder.hears(map=1)
        with dying(DyingPlan(), "planner", where, tmp_path) as thread:
            thread.join(20)
        assert recorder.hears(map=2)  # what the planner said last has come too
    store.close()
    recording = Recording(tmp_path / "run.mcap")
    with pytest.raises(ZeroDivisionError) as raised:
        replay(recording, ["planner"], lambda name: DyingPlan())
    assert crash_of(raised.value) == crash_in(recording, "planner") == crash_in(crash(tmp_path, "planner"), "planner")


def test_what_a_restarted_service_got_back_is_in_its_black_box(tmp_path, where):
    with (
        running(build("base_driver"), "base_driver", where),
        running(build("odometry"), "odometry", where),
    ):
        for _ in range(2):
            with dying(DyingTiles("restart"), "mapper", where, tmp_path) as thread:
                thread.join(4.2)  # the first one is ended before; its successor takes up its map
            if any(tmp_path.glob("crash-*")):
                break
    recording = crash(tmp_path, "mapper")
    with pytest.raises(RuntimeError, match="version") as raised:
        replay(recording, ["mapper"], lambda name: DyingTiles("restart"))
    assert crash_of(raised.value) == crash_in(recording, "mapper")


def test_an_end_in_order_leaves_nothing(tmp_path, where):
    with dying(build("base_driver"), "base_driver", where, tmp_path) as thread:
        threading.Event().wait(1.5)
        assert thread.is_alive()
    assert [path.name for path in tmp_path.iterdir()] == ["memory"]


def test_the_debugger_opens_where_it_was_raised(tmp_path, where, monkeypatch, capsys):
    with running(build("mapper"), "mapper", where), dying(DyingPlan(), "planner", where, tmp_path) as thread:
        thread.join(20)
    path = crash(tmp_path, "planner").path
    monkeypatch.setattr(report, "service_builder", lambda file: lambda name: DyingPlan())
    monkeypatch.setattr("sys.stdin", io.StringIO("p self.n_plans\nq\n"))
    assert report.replay(path, "x80sv", "0", PlaybackOptions(), report.ReplayOptions("planner", pdb=True)) == 1
    assert "(Pdb) 5" in capsys.readouterr().out


PROCESS = """
import shared.repeatable
from shared import topics
from shared.runners import live
from shared.service import Service, every

class Dies(Service):
    n = 0

    @every(hz=50)
    def tick(self):
        self.n += 1
        if self.n == 20:
            raise ZeroDivisionError("twenty")
        return ()

Dies.__module__ = "services.odometry.service"
live.main(Dies)
"""


def test_a_process_that_dies_tells_its_traceback_its_recording_and_ends(tmp_path, where):
    arguments = ["--stack", str(where.domain), "--crashes", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", PROCESS, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    recording = crash(tmp_path, "odometry")
    assert f"zenav replay {recording.path} --through odometry" in done.stderr
    assert 'raise ZeroDivisionError("twenty")' in done.stderr or "ZeroDivisionError: twenty" in done.stderr
    assert crash_in(recording, "odometry").endswith("ZeroDivisionError: twenty")
    assert len(recording.lives()["odometry"][0].events) == 20
    assert recorded_robot_file(recording) is not None
