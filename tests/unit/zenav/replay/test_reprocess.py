# SPDX-License-Identifier: Apache-2.0
"""The file that a replay writes, and the words about where it leaves the recording."""

from pathlib import Path

import pytest

from shared import topics
from shared.config import UserError, load_robot
from shared.recording import CONFIG, Recording, Writer, sink
from shared.runners.host import Sent
from tests.toys import Dead, build, eventful
from zenav.__main__ import _status
from zenav.recording.opening import recorded_robot_file
from zenav.replay.comparison import TopicReport
from zenav.replay.report import print_crash, topic_line
from zenav.replay.reprocess import ReplayReport, replay_file

CHAIN = ["base_driver", "odometry", "mapper", "planner"]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "a.mcap"
    with Writer(path, {"robot": "x80"}, {CONFIG: load_robot("x80sv").text.encode()}) as writer:
        eventful(sink(writer))
    return path


def nothing(done: int, of: int) -> None:
    pass


def row(report: ReplayReport, key: str) -> TopicReport:
    return next(topic for topic in report.topics if topic.key == key)


def test_an_unchanged_stack_writes_the_recording_again(file, tmp_path):
    report = replay_file(file, CHAIN, tmp_path / "out.mcap", build, nothing)
    assert report.equal
    assert report.notes == []
    assert list(Recording(tmp_path / "out.mcap").entries()) == list(Recording(file).entries())
    assert Recording(tmp_path / "out.mcap").about["replayed"] == "base_driver,odometry,mapper,planner"
    assert row(report, "base/wheels").n_equal > 150
    assert row(report, "log/mapper").n_equal > 0


def test_the_same_replay_gives_the_same_file(file, tmp_path):
    for name in "ab":
        replay_file(file, ["mapper"], tmp_path / name, build, nothing)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def changed(name: str) -> Dead:
    assert name == "odometry"
    return Dead(gain=0.2)


def test_a_changed_service_is_told_by_its_first_difference(file, tmp_path):
    report = replay_file(file, ["odometry"], tmp_path / "out.mcap", changed, nothing)
    assert not report.equal
    odom = row(report, "odom")
    assert odom.n_different > 100
    assert odom.first.startswith("#0: odom_from_base.x is 0.004")
    out, recorded = Recording(tmp_path / "out.mcap"), Recording(file)
    assert [e.key for e in out.entries()] == [e.key for e in recorded.entries()]
    assert list(out.entries(["pose", "map"])) == list(recorded.entries(["pose", "map"]))
    assert not {e.payload for e in out.entries(["odom"])} & {e.payload for e in recorded.entries(["odom"])}


def test_a_replay_that_is_interrupted_leaves_what_was_there(file, tmp_path, monkeypatch):
    written = []

    def interrupted(*arguments):
        written.append(arguments)
        if len(written) == 10:
            raise KeyboardInterrupt

    out = tmp_path / "out.mcap"
    out.write_bytes(b"former")
    monkeypatch.setattr("zenav.replay.reprocess._write_sent", interrupted)
    with pytest.raises(KeyboardInterrupt):
        replay_file(file, ["mapper"], out, build, nothing)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"former"]


def test_a_replay_never_overwrites_what_it_is_compared_with(file, tmp_path, capsys):
    reference = tmp_path / "reference.mcap"
    reference.write_bytes(file.read_bytes())
    arguments = ["replay", str(file), "--through", "odometry"]
    assert _status([*arguments, "--against", str(reference), "--out", str(reference)]) == 2
    assert "is what is compared with" in capsys.readouterr().err
    assert reference.read_bytes() == file.read_bytes()


def test_a_crash_outside_of_an_event_is_not_called_recorded(file, capsys):
    assert print_crash(ValueError("bad"), Recording(file), ["mapper"], False) == 1
    said = capsys.readouterr().err
    assert "as recorded" not in said
    assert "mapper: no crash is recorded" in said


def test_a_replay_can_be_replayed(file, tmp_path):
    replay_file(file, ["odometry"], tmp_path / "b.mcap", changed, nothing)
    assert replay_file(tmp_path / "b.mcap", ["odometry"], None, changed, nothing).equal
    assert not replay_file(tmp_path / "b.mcap", ["odometry"], None, build, nothing).equal


def record(path: Path, keep) -> Path:  # type: ignore[no-untyped-def]
    with Writer(path) as writer:
        to_file = sink(writer)
        eventful(lambda sent: to_file(sent) if keep(sent) else None)
    return path


def test_what_the_recorder_dropped_comes_in_where_it_was_sent(file, tmp_path):
    def keep(sent: Sent) -> bool:
        return (sent.key, sent.envelope.sequence) != ("odom", 12)

    path = record(tmp_path / "a.mcap", keep)
    report = replay_file(path, ["odometry"], tmp_path / "out.mcap", build, nothing)
    assert report.equal
    assert row(report, "odom").n_new == 2  # one a session
    assert list(Recording(tmp_path / "out.mcap").entries(["odom"])) == list(Recording(file).entries(["odom"]))


def test_where_equal_bytes_end_is_told_with_its_time_and_then_the_rest(tmp_path):
    path = record(
        tmp_path / "a.mcap", lambda s: (s.key, s.envelope.sequence) not in {("base/wheels", 30), ("odom", 40)}
    )
    notes = replay_file(path, ["odometry", "mapper"], None, build, nothing).notes
    assert notes[0].startswith("equal bytes are not promised from here on: +0.6")
    assert "odometry (odometry-1), event 30: base/wheels #30 of base_driver-1 is missing" in notes[0]


def test_a_lost_journal_is_told_as_the_end_of_equal_bytes(tmp_path):
    path = record(tmp_path / "a.mcap", lambda s: (s.key, s.envelope.sequence) != ("journal/base_driver", 1))
    (note, *_) = replay_file(path, ["base_driver"], None, build, nothing).notes
    assert note.startswith("equal bytes are not promised from here on: +")
    assert "entries of the journal are missing" in note


def test_hundreds_of_gaps_are_told_as_a_few_and_a_number(tmp_path):
    path = record(tmp_path / "a.mcap", lambda s: s.key != "base/wheels")
    notes = replay_file(path, ["odometry"], None, build, nothing).notes
    assert len(notes) == 21
    assert notes[-1].endswith("gaps more")


def test_people_see_how_many_are_equal_different_lacking_and_new():
    words = topic_line(TopicReport("odom", 40, 3, 2, 1, 0, "#7: v is 1.0, was 2.0")).split(maxsplit=9)
    assert words == ["odom", "40", "equal", "3", "different", "2", "lacking", "1", "new", "#7: v is 1.0, was 2.0"]
    assert "5 after the last journal" in topic_line(TopicReport("odom", 40, n_beyond=5))
    assert "7 within tolerance" in topic_line(TopicReport("odom", 40, n_within=7))


def test_what_no_journal_tells_is_kept_and_counted(tmp_path):
    path = record(tmp_path / "a.mcap", lambda s: s.key != "journal/odometry" or s.envelope.sequence == 0)
    report = replay_file(path, ["odometry"], tmp_path / "out.mcap", build, nothing)
    assert report.equal
    assert row(report, "odom").n_beyond > 20
    assert list(Recording(tmp_path / "out.mcap").entries()) == list(Recording(path).entries())


def test_a_recording_without_journals_is_replayed_and_says_so(tmp_path):
    path = record(tmp_path / "a.mcap", lambda sent: sent.topic is not topics.JOURNAL)
    report = replay_file(path, ["odometry", "mapper"], tmp_path / "out.mcap", build, nothing)
    assert any("no journals" in note for note in report.notes)
    keys = [e.key for e in Recording(tmp_path / "out.mcap").entries()]
    assert keys.count("odom") == keys.count("base/wheels")


def test_a_truncated_recording_is_replayed_up_to_where_it_ends(tmp_path):
    path = tmp_path / "cut.mcap"
    writer = Writer(path)
    to_file = sink(writer)
    eventful(lambda sent: (to_file(sent), writer.flush())[0])
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    report = replay_file(path, ["base_driver"], None, build, nothing)
    assert report.equal
    assert row(report, "base/wheels").n_equal > 50
    assert any("not closed" in note for note in report.notes)
    writer.close()


def test_the_configuration_of_a_recording_is_the_robots_file(file):
    found = recorded_robot_file(Recording(file))
    assert found is not None
    assert found.robot == load_robot("x80sv").robot


@pytest.mark.parametrize("text", [b"", b"[1, 2", b"just words", b"\xff\xfe"])
def test_a_damaged_configuration_is_told(tmp_path, text):
    Writer(tmp_path / "a.mcap", {}, {CONFIG: text}).close()
    with pytest.raises(UserError, match="configuration is damaged"):
        recorded_robot_file(Recording(tmp_path / "a.mcap"))


def test_a_recording_without_configuration_has_none(tmp_path):
    Writer(tmp_path / "a.mcap").close()
    assert recorded_robot_file(Recording(tmp_path / "a.mcap")) is None


@pytest.mark.parametrize(
    ("names", "out", "words"),
    [
        (["maper"], "out.mcap", "maper is not a service"),
        (["mapper"], "a.mcap", "is the recording itself"),
        (["mapper"], "/dev/null/out.mcap", "cannot write"),
        (["guard"], "out.mcap", "no journal of guard"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_a_hint(file, tmp_path, names, out, words):
    out_path = file if out == "a.mcap" else tmp_path / out
    with pytest.raises(UserError, match=words) as error:
        replay_file(file, names, out_path, build, nothing)
    assert error.value.hint
