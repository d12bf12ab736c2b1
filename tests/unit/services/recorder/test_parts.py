# SPDX-License-Identifier: Apache-2.0
"""A recording in parts: each is read and replayed alone; together they are what was published."""

from pathlib import Path

import pytest

from services.recorder.recording_store import RecorderConfig, RecordingStore
from services.recorder.service import RecorderService
from shared import topics
from shared.codec import decode
from shared.messages import MapUpdate, Message
from shared.recording import CONFIG, Recording
from shared.runners.host import Sent, merged
from shared.runners.journal import HOLE
from shared.runners.replay import replay
from tests.toys import ROBOT, build, eventful
from zenav.replay.reprocess import compare_replayed, replay_file

PART = 1.2  # s


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[Sent]]:
    """A run of 3.3 s as the recorder takes it, split each PART; and all that was published."""
    folder = tmp_path_factory.mktemp("parts")
    config = RecorderConfig(folder=str(folder), split_time=PART)
    store = RecordingStore(config)
    recorder, published = RecorderService(config, ROBOT, store), list[Sent]()
    recorder.robot_file = "robot: {}\n"

    def take(sent: Sent) -> None:
        published.append(sent)
        recorder.now = sent.envelope.sent
        recorder.raw(sent.key, sent.payload, sent.envelope, recorder.now)
        if len(published) % 25 == 0:
            list(recorder.flush())

    eventful(take)
    store.close()
    return sorted(folder.iterdir()), published


def latched_after(published: list[Sent]) -> dict[str, Message]:
    held: dict[str, Message] = {}
    for sent in published:
        if sent.topic.latched:
            held[sent.key] = merged(held.get(sent.key), sent.message)
    return held


def test_the_parts_hold_each_message_once_and_say_which_they_are(run):
    parts, published = run
    assert len(parts) >= 3
    assert [Recording(part).about["part"] for part in parts] == [str(n + 1) for n in range(len(parts))]
    assert len({Recording(part).about["recording"] for part in parts}) == 1
    found = [e.payload for part in parts for e in Recording(part).entries() if not e.latched]
    assert found == [sent.payload for sent in published]
    assert all(Recording(part).problems == [] for part in parts)


def test_each_part_begins_with_the_configuration_and_what_was_latched(run):
    parts, published = run
    n_before = 0
    for part in parts:
        recording = Recording(part)
        assert recording.attachments[CONFIG] == b"robot: {}\n"
        expected = latched_after(published[:n_before])
        entries = list(recording.entries())
        head = [entry for entry in entries if entry.latched]
        assert entries[: len(head)] == head
        assert {e.key for e in head} == expected.keys()
        for entry in head:
            type_ = topics.BY_KEY[entry.key].type
            assert repr(decode(type_, entry.payload)[0]) == repr(expected[entry.key])
        n_before += len(entries) - len(head)
    assert any(isinstance(m, MapUpdate) and len(m.rows) > 1 for m in expected.values())


def test_the_first_part_replays_to_the_byte(run):
    recording = Recording(run[0][0])
    replayed = replay(recording, ["base_driver", "odometry", "mapper"], build)
    assert replayed.gaps == []
    report = compare_replayed(replayed)
    assert report.equal, report


@pytest.mark.parametrize("name", ["planner", "mapper"])
def test_a_later_part_replays_from_what_was_latched(run, name):
    recording = Recording(run[0][-1])
    lives = recording.lives()[name]
    older = [life for life in lives if life.events[0].kind == HOLE]
    replayed = replay(recording, [name], build)
    assert len(replayed.gaps) >= len(older)
    assert replayed.sent[name]
    if name == "planner":  # all that it knows is latched: so it says the same again
        report = compare_replayed(replayed)
        assert report.equal, report
        assert sum(topic.n_equal for topic in report.topics) >= 2


def test_replay_names_where_the_recorder_missed_something(tmp_path):
    """Equal up to there; the gap names the message, and the notes what the recorder wrote down."""
    config = RecorderConfig(file=str(tmp_path / "a.mcap"))
    store = RecordingStore(config)
    recorder = RecorderService(config, ROBOT, store)

    def take(sent: Sent) -> None:
        if sent.key == "base/wheels" and sent.envelope.sequence == 60:
            return  # a link was overloaded
        recorder.now = sent.envelope.sent
        recorder.raw(sent.key, sent.payload, sent.envelope, recorder.now)

    eventful(take)
    list(recorder.flush())
    store.close()
    report = replay_file(tmp_path / "a.mcap", ["odometry"], None, build, lambda done, of: None)
    assert any("base/wheels #60" in note and "missing" in note for note in report.notes)
    assert any("the recorder had missed 1 messages (overload): 1 base/wheels" in note for note in report.notes)
    (odom,) = [topic for topic in report.topics if topic.key == "odom"]
    assert odom.n_equal >= 60
