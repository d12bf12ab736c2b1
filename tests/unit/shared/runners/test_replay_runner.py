# SPDX-License-Identifier: Apache-2.0
"""A == replay(A), to the byte; and where it cannot be, it is said where and why."""

from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from shared import topics
from shared.config import UserError
from shared.messages import Journal, Odometry, Velocity, WheelState
from shared.recording import Recording, Writer, sink
from shared.runners.host import Sent
from shared.runners.lockstep import Lockstep, Sink
from shared.runners.replay import Replayed, replay
from shared.service import Job, Log, Out, Service, every, on
from tests.toys import DEFAULTS, ROBOT, Dead, Tiles, ToyBase, build, eventful

CHAIN = ("base_driver", "odometry", "mapper", "planner")


def recorded(path: Path, run: Callable[[Sink], object], keep: Callable[[Sent], bool] = lambda sent: True) -> list[Sent]:
    """Records a run, without what the recorder is to miss; returns all that was published."""
    published: list[Sent] = []
    with Writer(path) as writer:
        record = sink(writer)

        def take(sent: Sent) -> None:
            published.append(sent)
            if keep(sent):
                record(sent)

        run(take)
    return published


def by(published: list[Sent], name: str) -> list[bytes]:
    """What the handlers of a service published."""
    return [s.payload for s in published if s.envelope.publisher == name and s.topic is not topics.JOURNAL]


def out_of(replayed: Replayed, name: str) -> list[bytes]:
    return [sent.payload for sent in replayed.sent[name]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, list[Sent]]:
    path = tmp_path_factory.mktemp("run") / "a.mcap"
    published = recorded(path, eventful)
    return Recording(path), published


def test_the_run_holds_every_kind_of_event(run):
    recording, _ = run
    kinds = {event.kind for lives in recording.lives().values() for life in lives for event in life.events}
    assert kinds == {0, 1, 2, 3, 5}
    assert {name: len(lives) for name, lives in recording.lives().items()} == {
        "base_driver": 1, "odometry": 2, "mapper": 2, "planner": 2
    }  # fmt: skip


@pytest.mark.parametrize("name", CHAIN)
def test_replaying_a_service_gives_what_it_published_to_the_byte(run, name):
    recording, published = run
    replayed = replay(recording, [name], build)
    assert replayed.gaps == []
    assert out_of(replayed, name) == journalled(published, name) != []


def journalled(published: list[Sent], name: str) -> list[bytes]:
    """What a service published before its last journal. A killed service has no journal of its last second."""
    last = {s.message.session: i for i, s in enumerate(published) if isinstance(s.message, Journal)}
    return [
        s.payload
        for i, s in enumerate(published)
        if s.envelope.publisher == name and s.topic is not topics.JOURNAL and i < last[s.envelope.session]
    ]


@pytest.mark.parametrize("names", list(permutations(CHAIN))[::5])
def test_the_chain_gives_what_it_published_whatever_its_order(run, names):
    recording = run[0]
    replayed = replay(recording, list(names), build)
    assert replayed.gaps == []
    for name in names:
        assert out_of(replayed, name) == out_of(replay(recording, [name], build), name)


def test_a_replay_of_a_whole_run_misses_nothing(tmp_path):
    def steady(record: Sink) -> None:
        lockstep = Lockstep({name: build(name) for name in CHAIN}, record)
        lockstep.run(2.13)
        lockstep.flush()

    published = recorded(tmp_path / "a.mcap", steady)
    replayed = replay(Recording(tmp_path / "a.mcap"), list(CHAIN), build)
    for name in CHAIN:
        assert out_of(replayed, name) == by(published, name) != []


def test_what_a_killed_service_sent_after_its_last_journal_reaches_the_chain_as_recorded(tmp_path):
    def killing(record: Sink) -> None:
        lockstep = Lockstep({name: build(name) for name in CHAIN}, record)
        lockstep.run(1.5)
        lockstep.kill("odometry")
        lockstep.run(0.6)
        lockstep.flush()

    published = recorded(tmp_path / "a.mcap", killing)
    replayed = replay(Recording(tmp_path / "a.mcap"), list(CHAIN), build)
    assert replayed.gaps == []
    assert 0 < len(out_of(replayed, "odometry")) < len(by(published, "odometry"))
    assert out_of(replayed, "mapper") == by(published, "mapper")


# --- what is missing ------------------------------------------------------------------------------------------------


def test_a_message_that_was_not_recorded_is_named_and_bytes_are_equal_up_to_there(tmp_path):
    lost = topics.WHEELS.key, 30
    published = recorded(tmp_path / "a.mcap", eventful, lambda sent: (sent.key, sent.envelope.sequence) != lost)
    replayed = replay(Recording(tmp_path / "a.mcap"), ["odometry"], build)
    assert len(replayed.gaps) == 1
    assert "base/wheels #30" in str(replayed.gaps[0])
    assert "event 30" in str(replayed.gaps[0])
    assert out_of(replayed, "odometry")[:30] == by(published, "odometry")[:30]
    assert len(out_of(replayed, "odometry")) > 80  # and it goes on


def test_a_lost_journal_is_a_gap_of_its_events(tmp_path):
    lost = "journal/base_driver", 1
    recorded(tmp_path / "a.mcap", eventful, lambda sent: (sent.key, sent.envelope.sequence) != lost)
    replayed = replay(Recording(tmp_path / "a.mcap"), ["base_driver"], build)
    assert [(gap.event, gap.what) for gap in replayed.gaps] == [(50, "50 entries of the journal are missing")]


def test_a_recording_that_begins_late_says_so_and_goes_on_counting(tmp_path):
    published = recorded(tmp_path / "a.mcap", eventful, late(1.2))
    replayed = replay(Recording(tmp_path / "a.mcap"), ["odometry", "base_driver"], build)
    for name in ("odometry", "base_driver"):
        gaps = [gap for gap in replayed.gaps if gap.name == name]
        assert gaps[0].event == 0
        assert len(gaps) <= 3  # the hole, and what was on its way at the border
    first = replayed.sent["base_driver"][0].envelope
    assert first in [s.envelope for s in published]


def late(seconds: float) -> Callable[[Sent], bool]:
    return lambda sent: sent.envelope.sent >= 1_000_000_000_000_000_000 + seconds * 1e9


def test_latched_tiles_from_before_the_recording_are_a_gap(tmp_path):
    recorded(tmp_path / "a.mcap", eventful, late(0.7))
    replayed = replay(Recording(tmp_path / "a.mcap"), ["planner"], build)
    assert [gap.what for gap in replayed.gaps][:1] == ["map #0 of mapper-1 is missing"]


@pytest.mark.parametrize(
    ("names", "words"), [(["guard"], "no journal of guard"), (["odometry", "lidar_driver"], "no journal of lidar")]
)
def test_a_service_that_was_not_recorded_is_refused_by_name(run, names, words):
    with pytest.raises(UserError, match=words):
        replay(run[0], names, build)


# --- when the code is another ---------------------------------------------------------------------------------------


def test_another_gain_runs_through_the_chain(run):
    recording, published = run
    replayed = replay(recording, ["odometry", "mapper"], lambda n: Dead(gain=0.2) if n == "odometry" else build(n))
    assert replayed.gaps == []
    assert out_of(replayed, "odometry") != by(published, "odometry")[: len(out_of(replayed, "odometry"))]
    poses = [s.payload for s in replayed.sent["mapper"] if s.topic is topics.POSE]
    assert poses
    assert not set(poses) & set(by(published, "mapper"))


class Busier(Tiles):
    """Orders a job for each odometry."""

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        self.n_odometries += 1
        yield Job(abs, (-1,), done="counted", takes=0.1)


def test_jobs_that_the_journal_does_not_end_are_done_after_their_time(run):
    replayed = replay(run[0], ["mapper"], lambda name: Busier())
    assert len(replayed.sent["mapper"]) > 100  # each contains its bonus


class PlannerWithoutInputs(Service):
    """A planner that listens to nothing any more."""

    @every(hz=5)
    def tick(self) -> Out:
        return ()


def test_events_that_the_service_takes_no_more_are_gaps(run):
    replayed = replay(run[0], ["planner"], lambda name: PlannerWithoutInputs(DEFAULTS, ROBOT))
    assert {gap.what for gap in replayed.gaps} == {
        "planner does not listen to map any more",
        "planner does not listen to pose any more",
    }


class Still(Service):
    def __init__(self) -> None:
        super().__init__(DEFAULTS, ROBOT)

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        return ()


def test_what_a_changed_service_sends_no_more_is_missed_by_name(run):
    replayed = replay(run[0], ["odometry", "mapper"], lambda n: Still() if n == "odometry" else build(n))
    assert replayed.sent["odometry"] == []
    assert replayed.gaps[0].what == "odom #0 of odometry-1 is missing"


class Crash(Dead):
    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        if wheels.left > 0.5:
            raise ZeroDivisionError("here")
        return super().wheels(wheels)


def test_a_crash_is_replayed_with_the_place_of_its_event(run):
    with pytest.raises(ZeroDivisionError, match="here") as error:
        replay(run[0], ["odometry"], lambda name: Crash())
    assert "odometry (odometry-1): event" in error.value.__notes__[0]


# --- circles --------------------------------------------------------------------------------------------------------


class Obedient(ToyBase):
    """The wheels follow the guard."""

    @on(topics.CMD_VEL)
    def command(self, velocity: Velocity) -> Out:
        self.angle += velocity.v
        return ()


class CircleGuard(Service):
    def __init__(self, share: float = 0.1) -> None:
        super().__init__(DEFAULTS, ROBOT)
        self.share = share

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        yield topics.CMD_VEL(Velocity(self.now, self.share * np.sin(wheels.left), 0.0, ""))


def circle(record: Sink) -> None:
    lockstep = Lockstep({"base_driver": Obedient(), "guard": CircleGuard()}, record)
    lockstep.run(2.0)
    lockstep.flush()


def in_circle(name: str) -> Service:
    return Obedient() if name == "base_driver" else CircleGuard()


def test_services_that_feed_each_other_replay_together(tmp_path):
    published = recorded(tmp_path / "a.mcap", circle)
    replayed = replay(Recording(tmp_path / "a.mcap"), ["guard", "base_driver"], in_circle)
    assert replayed.gaps == []
    for name in ("guard", "base_driver"):
        assert out_of(replayed, name) == by(published, name)


class Mute(Service):
    def __init__(self) -> None:
        super().__init__(DEFAULTS, ROBOT)

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        return ()


@pytest.mark.parametrize("broken", ["guard", "base_driver"])
def test_a_circle_that_is_broken_ends(tmp_path, broken):
    class Silent(Service):
        @on(topics.CMD_VEL)
        def command(self, velocity: Velocity) -> Out:
            return ()

    def made(name: str) -> Service:
        if name != broken:
            return in_circle(name)
        return Mute() if name == "guard" else Silent(DEFAULTS, ROBOT)

    recorded(tmp_path / "a.mcap", circle)
    replayed = replay(Recording(tmp_path / "a.mcap"), ["guard", "base_driver"], made)
    assert replayed.gaps


# --- without journals -----------------------------------------------------------------------------------------------


def without_journals(sent: Sent) -> bool:
    return sent.topic is not topics.JOURNAL


def test_without_journals_the_stamps_give_the_order_and_it_is_said(tmp_path):
    published = recorded(tmp_path / "a.mcap", eventful, without_journals)
    recording = Recording(tmp_path / "a.mcap")
    first, second = (replay(recording, ["odometry", "mapper"], build) for _ in range(2))
    assert not first.journalled
    assert out_of(first, "odometry") == out_of(second, "odometry")
    assert out_of(first, "mapper") == out_of(second, "mapper") != []
    wheels = [s for s in published if s.topic is topics.WHEELS]
    assert [s.message.stamp for s in first.sent["odometry"]] == [s.message.stamp for s in wheels]


def test_without_journals_and_without_inputs_nothing_is_replayed(tmp_path):
    recorded(tmp_path / "a.mcap", eventful, lambda sent: sent.topic is topics.POSE)
    with pytest.raises(UserError, match="nothing that odometry could take"):
        replay(Recording(tmp_path / "a.mcap"), ["odometry"], build)


def test_stamps_of_another_day_are_refused_and_not_ticked_through(tmp_path):
    with Writer(tmp_path / "a.mcap") as writer:
        for stamp in (0, 10**18):
            host = Lockstep({}, sink(writer))
            host.publish(topics.WHEELS(WheelState(stamp, 0, 0.0, 0.0, 0.0, 0.0)), "base_driver")
    with pytest.raises(UserError, match="span 11574 days"):
        replay(Recording(tmp_path / "a.mcap"), ["odometry"], build)


class Refusing(Dead):
    """Odometry that stands where its wheels' messages are rejected."""

    @every(hz=10)
    def why(self) -> Out:
        yield Log("INFO", f"{self.x} {self.rejections.stamp_problem('base/wheels', self.now)}")


def test_messages_that_are_rejected_by_their_sequence_are_so_in_the_replay(tmp_path):
    def counting_wrongly(record: Sink) -> None:
        lockstep = Lockstep({"base_driver": build("base_driver"), "odometry": Refusing()}, record)
        sequences = lockstep._hosts["base_driver"]._sequences
        lockstep.run(0.5)
        lockstep.watch("base/wheels", lambda _: sequences.update({"base/wheels": 10}))
        lockstep.run(1.0)
        lockstep.flush()

    published = recorded(tmp_path / "a.mcap", counting_wrongly)
    replayed = replay(Recording(tmp_path / "a.mcap"), ["odometry"], lambda name: Refusing())
    assert replayed.gaps == []
    assert out_of(replayed, "odometry") == by(published, "odometry")
    assert any("wheels: the sequence" in s.message.text for s in published if s.topic is topics.LOG)
