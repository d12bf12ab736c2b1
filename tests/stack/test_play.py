# SPDX-License-Identifier: Apache-2.0
"""`zenav replay FILE` over Zenoh: what listeners hear, what live services take, what a person's keys do."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

import pytest

from shared import topics
from shared.codec import decode
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import Localization, Message
from shared.recording import Recording, Writer, sink
from shared.runners import transport
from tests.replay.record import path_of
from tests.stack import processes
from tests.stack.test_live import free_stack, running
from tests.toys import ROBOT, build, eventful
from zenav.client import Client
from zenav.console.shutdown import StopFlag
from zenav.replay import player
from zenav.replay.player import play, typed_keys
from zenav.replay.player_clock import PlaybackOptions

ENDED = Pose2(3.098, 0.620, -0.145)
"""Where the drive of driving.mcap ends: see its figures."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "a.mcap"
    with Writer(path, {"robot": ROBOT.name}) as writer:
        eventful(sink(writer))
    return path


@pytest.fixture
def where() -> transport.StackAddress:
    return transport.StackAddress(free_stack())


class Ear:
    """Hears everything on the robot's keys."""

    def __init__(self, where: transport.StackAddress) -> None:
        self.heard: dict[str, list[bytes]] = {}
        self.changed = threading.Condition()
        self.client = Client(ROBOT.name, where)

    def hear(self, key: str, payload: bytes) -> None:
        with self.changed:
            self.heard.setdefault(key, []).append(payload)
            self.changed.notify_all()

    def until(self, holds: Callable[[], object], seconds: float = 20.0) -> None:
        with self.changed:
            assert self.changed.wait_for(holds, seconds), {key: len(them) for key, them in self.heard.items()}


@contextmanager
def ear(where: transport.StackAddress) -> Iterator[Ear]:
    listening = Ear(where)
    with listening.client as client:
        client.listen_raw("**", listening.hear)
        yield listening


def recorded(file: Path, key: str) -> list[bytes]:
    return [entry.payload for entry in Recording(file).entries([key])]


def test_everything_but_commands_comes_as_it_was_recorded_to_the_byte(file, where, capsys):
    with ear(where) as listening:
        assert play(file, "", str(where.domain), PlaybackOptions(rate=5.0)) == 0
        keys = {entry.key for entry in Recording(file).entries()}
        listening.until(lambda: all(len(listening.heard.get(k, ())) >= len(recorded(file, k)) for k in keys))
        for key in keys:
            assert listening.heard[key] == recorded(file, key), key
        assert "sim/clock" in listening.heard
    assert f"played {len(list(Recording(file).entries()))} messages" in capsys.readouterr().out


def test_with_now_live_services_take_it_and_a_second_pass_too(file, where):
    with running(build("odometry"), "odometry", where) as live, ear(where) as listening:
        wish = PlaybackOptions("base/wheels", now=True, rate=10.0, end=1.0)
        for n in (1, 2):
            play(file, "", str(where.domain), wish)
            listening.until(lambda n=n: len(listening.heard.get("odom", ())) >= 45 * n)
        assert live.stats.old == live.stats.intruders == live.stats.bad == 0
        newest, envelope = decode(topics.ODOM.type, listening.heard["odom"][-1])
        assert 0 <= (envelope.sent - newest.stamp) / 1e9 < 5


def test_with_recorded_stamps_tools_know_the_recorded_time(file, where):
    with ear(where) as listening:
        asked: list[float] = []

        def keys(seconds: float) -> str:
            asked.append(listening.client.now() / 1e9)
            return ""

        play_with(keys, file, where, PlaybackOptions("odom", rate=3.0))
        first = next(Recording(file).entries()).log_time / 1e9
        assert first + 2.0 < asked[-1] < first + 5.0


def play_with(keys: Callable[[float], str], file: Path, where: transport.StackAddress, wish: PlaybackOptions) -> None:
    """Plays with a person's keys: `keys` is asked 20 times a second."""
    hidden = player.no_keys
    player.no_keys = lambda stop, seconds: (stop.wait(seconds), keys(seconds))[1] if seconds > 0 else ""
    try:
        play(file, "", str(where.domain), wish)
    finally:
        player.no_keys = hidden


def test_a_person_pauses_steps_goes_on_and_ends(file, where):
    script = iter(["n", "", "n", "\x1b[C", "", " "])
    with ear(where) as listening:
        counts: list[int] = []

        def keys(seconds: float) -> str:
            counts.append(len(listening.heard.get("base/wheels", ())))
            key = next(script, None)
            return key if key is not None else "q" if counts[-1] >= 30 else ""

        play_with(keys, file, where, PlaybackOptions("base/wheels", paused=True))
        assert 30 <= len(listening.heard["base/wheels"]) < len(recorded(file, "base/wheels"))
        assert listening.heard["base/wheels"] == recorded(file, "base/wheels")[: len(listening.heard["base/wheels"])]
        assert counts[:2] == [0, 0] or counts[0] == 0  # nothing before the first step
        assert max(counts[:6]) <= 3  # each step is one message


def test_a_late_joiner_gets_the_whole_map_also_from_before_the_start(file, where):
    got: list[Message] = []
    arrived = threading.Event()

    def keys(seconds: float) -> str:
        if got:
            return "q"
        kept = asker.latched_value(topics.MAP, timeout=1.0)
        if kept is not None:
            got.append(kept)
            arrived.set()
        return ""

    with Client(ROBOT.name, where) as asker:
        play_with(keys, file, where, PlaybackOptions("map", start=3.0, paused=True))
    first = next(Recording(file).entries()).log_time
    whole = None
    for entry in Recording(file).entries(["map"]):
        if entry.log_time - first < 3e9:
            update, _ = decode(topics.MAP.type, entry.payload)
            whole = update if whole is None else whole.merged(update)
    assert arrived.is_set()
    assert (got[0].version, got[0].cells.tolist()) == (whole.version, whole.cells.tolist())


def test_real_services_take_a_drive_that_is_played_as_if_it_were_now(tmp_path):
    with processes.running(tmp_path, ("odometry", "mapper", "guard")) as stack:
        reasons: list[str] = []
        stack.client.listen(topics.GUARD, lambda status, _: reasons.append(status.reason))
        thread = threading.Thread(
            target=play, args=(path_of("driving"), "", str(stack.where.domain), PlaybackOptions(now=True, start=1.0))
        )
        with pytest.MonkeyPatch.context() as patch:
            # signals are handled on the main thread only
            patch.setattr("zenav.replay.player.stop_on_signal", lambda: nullcontext(StopFlag()))
            thread.start()
            stack.until(lambda: (pose := stack.client.latest(topics.POSE)) and pose.map_from_base.x > 1.0)
            del reasons[:]
            stack.until(lambda: not thread.is_alive())
            thread.join()
        pose = stack.client.latest(topics.POSE)
        assert pose.state is Localization.GOOD
        assert pose.map_from_base.distance(ENDED) < 0.15
        assert not {"scan_old", "odom_old"} & set(reasons[:-5])
        assert sum(health.intruders + health.bad_messages for health in stack.healths.values()) == 0


def test_keys_are_read_from_a_terminal_as_they_come():
    reader, writer = os.pipe()
    assert typed_keys(reader, 0.0) == ""
    os.write(writer, b" n")
    assert typed_keys(reader, 5.0) == " n"
    os.close(writer)
    assert typed_keys(reader, 5.0) == "q"
    os.close(reader)


def test_what_a_running_service_says_is_left_out_and_told(file, where, capsys):
    with running(build("odometry"), "odometry", where):
        play(file, "", str(where.domain), PlaybackOptions(end=0.2))
        assert "odom: odometry runs" in capsys.readouterr().err.replace("health/odometry, ", "")
        with pytest.raises(UserError, match="odom is not played: odometry runs"):
            play(file, "", str(where.domain), PlaybackOptions("odom"))


def test_what_a_service_says_that_comes_to_life_is_played_no_more(file, where, capsys):
    with ExitStack() as later, ear(where) as listening:
        started: list[object] = []

        def keys(seconds: float) -> str:
            if len(listening.heard.get("odom", ())) > 10 and not started:
                started.append(later.enter_context(running(build("odometry"), "odometry", where)))
            return ""

        play_with(keys, file, where, PlaybackOptions("odom,base/wheels", loop=False))
    assert started
    assert "odom is played no more since odometry runs" in capsys.readouterr().err


def test_passes_follow_each_other_until_somebody_ends_them(file, where):
    with running(build("odometry"), "odometry", where) as live, ear(where) as listening:

        def keys(seconds: float) -> str:
            return "q" if len(listening.heard.get("base/wheels", ())) > 60 else ""

        play_with(keys, file, where, PlaybackOptions("base/wheels", now=True, rate=5.0, end=0.5, loop=True))
        sessions = [decode(topics.WHEELS.type, p)[1].session for p in listening.heard["base/wheels"]]
        assert len(set(sessions)) >= 3
        assert sessions == sorted(sessions)
        assert live.stats.old == live.stats.intruders == 0


def test_a_renamed_topic_comes_under_its_other_name(file, where):
    with ear(where) as listening:
        play(file, "", str(where.domain), PlaybackOptions("odom", remap=("odom=old/odom",), rate=20.0))
        listening.until(lambda: len(listening.heard.get("old/odom", ())) == len(recorded(file, "odom")))
        assert not set(listening.heard.get("odom", ())) & set(recorded(file, "odom"))


def test_a_recording_that_breaks_off_is_played_up_to_there_and_that_is_told(file, where, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert play(cut, "", str(where.domain), PlaybackOptions(rate=50.0)) == 0
    out, err = capsys.readouterr()
    assert 10 < int(out.split()[1]) < len(list(Recording(file).entries()))
    assert "was not closed" in err


@pytest.mark.parametrize(
    ("wish", "told"),
    [(PlaybackOptions(start=100.0), "nothing lies between"),
     (PlaybackOptions(start=2.0, end=1.0), "nothing lies between"),
     (PlaybackOptions("odm"), "no topic odm")],
)  # fmt: skip
def test_what_cannot_be_played_is_one_line_and_a_hint(file, wish, told):
    with pytest.raises(UserError, match=told):
        play(file, "", "0", wish)
