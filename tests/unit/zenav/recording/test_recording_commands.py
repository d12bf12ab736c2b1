# SPDX-License-Identifier: Apache-2.0
"""`zenav recording`: its reports agree with what was published, and the recordings that it writes replay."""

import errno
import fcntl
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image

from services.recorder.recording_store import RecorderConfig, RecordingStore
from services.recorder.service import RecorderService
from shared import topics
from shared.codec import Envelope, decode, encode
from shared.config import UserError
from shared.messages import EmergencyStop, LaserScan, LogLine, MapMode, Odometry, Velocity
from shared.recording import CONFIG, Channel, Drop, Entry, Recording, Writer, sink
from shared.recordings.reader import LATCHED
from shared.runners.replay import replay
from shared.types import NS_PER_S
from tests.replay.record import path_of
from tests.toys import ROBOT, build, eventful
from zenav.__main__ import _status
from zenav.client.map_modes import OnMap
from zenav.recording.info import Silences, recording_info
from zenav.recording.merge import merge
from zenav.recording.plot import series
from zenav.recording.repair import repair
from zenav.recording.trim import trim
from zenav.replay.reprocess import compare_replayed

CHAIN = ["base_driver", "odometry", "mapper", "planner"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 3.3 s."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    with Writer(path, {"robot": ROBOT.name, "commit": "abc"}, {CONFIG: b"robot: {}\n"}) as writer:
        eventful(sink(writer))
    return path


def unclosed(path: Path, to: Path) -> Path:
    """As kill -9 leaves it: no index, and the beginning of a chunk at the end."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    last = summary.chunk_indexes[-1]
    to.write_bytes(path.read_bytes()[: last.chunk_start_offset + last.chunk_length // 2])
    return to


def rows(path: Path) -> list[tuple[str, int, bytes]]:
    return [(e.key, e.log_time, e.payload) for e in Recording(path).entries()]


# --- info -----------------------------------------------------------------------------------------------------------


def test_info_counts_what_is_read_with_an_index_and_without(run, tmp_path):
    entries = list(Recording(run).entries())
    counts: dict[str, int] = {}
    for entry in entries:
        counts[entry.key] = counts.get(entry.key, 0) + 1
    whole = recording_info(run)
    assert whole.indexed
    assert {row.key: row.n for row in whole.topics} == counts
    assert whole.messages == len(entries)
    assert whole.seconds == pytest.approx((entries[-1].log_time - entries[0].log_time) / NS_PER_S, abs=0.05)
    assert whole.about["robot"] == ROBOT.name
    assert whole.attachments == {CONFIG: 10}
    assert whole.problems == []

    cut = recording_info(unclosed(run, tmp_path / "cut.mcap"))
    assert not cut.indexed
    assert {row.key: row.n for row in cut.topics if row.n} != counts
    assert sum(row.n for row in cut.topics) == len(rows(tmp_path / "cut.mcap"))


@pytest.mark.parametrize("closed", [True, False])
def test_info_finds_the_silences_of_a_topic(tmp_path, closed):
    path, n = tmp_path / "a.mcap", 0
    writer = Writer(path)
    for i in range(1000):  # 20 s at 50 Hz, silent from 4 to 7 s and from 12 to 13.5 s
        if not 200 <= i < 350 and not 600 <= i < 675:
            writer.write("odom", Odometry, b"x", i * NS_PER_S // 50, 0, i)
            n += 1
        if i % 50 == 0:
            writer.write("health/mapper", LogLine, b"x", i * NS_PER_S // 50, 0, i)
            writer.flush()
    if closed:
        writer.close()
    else:
        writer.flush()
    found = {row.key: row for row in recording_info(path).topics}
    writer.close()
    assert (found["odom"].n, found["odom"].gaps) == (n, 2)
    assert found["odom"].longest_gap == pytest.approx(3.02)
    assert found["odom"].expected_hz == 50
    assert found["health/mapper"].gaps == 0
    assert found["health/mapper"].hz == pytest.approx(1.0)


def test_a_topic_that_fell_silent_before_the_end_is_a_gap():
    told = Silences(first=0, last=10 * NS_PER_S).summary(101, 10.0, 14 * NS_PER_S)
    assert told == (10.0, 1, 4.0)
    assert Silences(first=0, last=10 * NS_PER_S).summary(101, 0.0, 14 * NS_PER_S) == (10.0, 0, 0.0)  # only events


def test_info_names_the_parts_of_a_recording_in_order(tmp_path):
    for part in (2, 1, 3):
        with Writer(tmp_path / f"run.part{part}.mcap", {"recording": "run", "part": str(part)}):
            pass
    with Writer(tmp_path / "runner.mcap", {"recording": "runner", "part": "1"}):
        pass
    assert recording_info(tmp_path / "run.part2.mcap").parts == ["run.part1.mcap", "run.part2.mcap", "run.part3.mcap"]
    assert recording_info(tmp_path / "runner.mcap").parts == []


def test_info_tells_what_was_missed_and_its_status_is_1(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with Writer(path, {"robot": "x80"}) as writer:
        writer.write("scan", LogLine, b"x", 5 * NS_PER_S, 0, 0)
        writer.note_drops(
            [Drop(7 * NS_PER_S, "overload", "scan", "s", 1, 4), Drop(7 * NS_PER_S, "overload", "odom", "s", 9, 1)]
        )
    assert [(row.key, row.missed) for row in recording_info(path).topics] == [("scan", 4)]
    assert _status(["recording", "info", str(path)]) == 1
    out = capsys.readouterr().out
    assert "2.0 s after the start the recorder had missed 5 messages (overload): 4 scan, 1 odom" in out


def test_info_as_json_is_one_object(run, capsys):
    assert _status(["recording", "info", str(run), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["messages"] == len(rows(run))
    assert {row["key"] for row in told["topics"]} >= {"odom", "map", "journal/mapper"}


# --- cat ------------------------------------------------------------------------------------------------------------


def test_cat_writes_the_fields_of_the_messages_that_are_asked_for(run, capsys):
    assert _status(["recording", "cat", str(run), "odom", "map", "--begin", "1", "--end", "2"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    zero = rows(run)[0][1]
    expected = [r for r in rows(run) if r[0] in ("odom", "map") and zero + NS_PER_S <= r[1] < zero + 2 * NS_PER_S]
    assert [(line["key"], line["log_time"]) for line in lines] == [(key, time) for key, time, _ in expected]
    first = next(line for line in lines if line["key"] == "odom")
    odom, envelope = decode(Odometry, next(p for key, _, p in expected if key == "odom"))
    assert first["v"] == odom.v
    assert first["@"] == {
        "publisher": "odometry", "session": envelope.session, "sequence": envelope.sequence, "sent": envelope.sent
    }  # fmt: skip


def test_an_end_at_infinity_is_the_end_of_the_recording(run, capsys):
    assert _status(["recording", "cat", str(run), "odom", "--end", "inf"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == sum(key == "odom" for key, *_ in rows(run))


def test_cat_counts_and_matches_patterns(run, capsys):
    assert _status(["recording", "cat", str(run), "journal/*", "-n", "3"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 3
    assert all(line["key"].startswith("journal/") for line in lines)


def test_cat_tells_what_it_does_not_know(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        writer.write("weather", LogLine, encode(LogLine(1, "INFO", "rain"), Envelope("sky", "s", 0, 1)), 1, 1, 0)
        writer.write("estop", LogLine, b"\xc1", 2, 2, 0)
    assert _status(["recording", "cat", str(path)]) == 0
    weather, estop = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert weather["message"]["text"] == "rain"
    assert "no topic" in weather["problem"]
    assert estop["size"] == 1


def test_cat_writes_what_is_attached(run, capfdbinary):
    assert _status(["recording", "cat", str(run), "--attachment", CONFIG]) == 0
    assert capfdbinary.readouterr().out == b"robot: {}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["cat", "{}", "odmo"], "did you mean `odom`"),
        (["cat", "{}", "guard/status"], "holds nothing on guard/status"),
        (["cat", "{}", "--begin", "99"], "3.3 s long"),
        (["cat", "{}", "--begin", "2", "--end", "1"], "nothing lies between"),
        (["cat", "{}", "--attachment", "map.yaml"], "has no map.yaml attached"),
        (["plot", "{}", "odom"], "names no field"),
        (["plot", "{}", "odom:x"], "odom has no field x"),
        (["plot", "{}", "odo:v"], "did you mean `odom`"),
        (["plot", "{}", "cmd/vel:reason"], "holds nothing on cmd/vel"),
        (["plot", "{}", "pose:state"], "has no number for pose:state"),
        (["plot", "{}", "odom:v", "--out", "{}/a.png"], "cannot write"),
        (["trim", "{}", "--out", "{}"], "is read from"),
        (["trim", "{}", "--out", "{}.zip"], "is no name for a recording"),
        (["merge", "{}", "--out", "b.mcap"], "two recordings or more"),
        (["info", "no.mcap"], "cannot read"),
        (["trim", "no.mcap", "--out", "{}"], "cannot read"),
        (["merge", "no.mcap", "none.mcap", "--out", "{}"], "cannot read"),
        (["mark", "no.mcap"], "cannot read"),
    ],
)
def test_what_is_asked_wrongly_is_told_in_one_line(run, capsys, arguments, words):
    assert _status(["recording", *(a.replace("{}", str(run)) for a in arguments)]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 2


# --- repair ---------------------------------------------------------------------------------------------------------


def test_repair_gives_a_killed_recorders_file_its_index_back(run, tmp_path, capsys):
    path = unclosed(run, tmp_path / "run.mcap")
    before, damaged = rows(path), path.read_bytes()
    assert _status(["recording", "repair", str(path)]) == 1  # the last chunk's beginning is lost
    assert f"{len(before)} messages" in capsys.readouterr().out
    assert rows(path) == before == rows(run)[: len(before)]
    recording = Recording(path)
    assert recording.indexed
    assert recording.problems == []
    assert (recording.about, recording.attachments) == (Recording(run).about, Recording(run).attachments)
    assert (tmp_path / "run.mcap.damaged").read_bytes() == damaged
    with path.open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == len(before)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run.mcap.damaged"]


def test_repair_of_a_file_that_only_lacks_its_index_loses_nothing(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    writer = Writer(tmp_path / "live.mcap")
    for i in range(100):
        writer.write("estop", LogLine, b"x" * i, i, i, i)
    writer.flush()
    path.write_bytes((tmp_path / "live.mcap").read_bytes())
    writer.close()
    before = rows(path)
    assert _status(["recording", "repair", str(path)]) == 0
    assert rows(path) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "live.mcap"]
    assert _status(["recording", "repair", str(path), "--out", str(tmp_path / "b.mcap")]) == 0
    assert rows(tmp_path / "b.mcap") == before


def test_repair_counts_the_messages_of_a_damaged_chunk(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        for i in range(30):
            writer.write("estop", LogLine, bytes([i]) * 50, i, i, i)
            if i % 10 == 9:
                writer.flush()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[1]
    damaged = bytearray(path.read_bytes())
    damaged[chunk.chunk_start_offset + chunk.chunk_length - 4] ^= 0xFF
    path.write_bytes(damaged)
    assert _status(["recording", "repair", str(path), "--out", str(tmp_path / "b.mcap")]) == 1
    assert "10 messages are lost" in capsys.readouterr().err
    assert [time for _, time, _ in rows(tmp_path / "b.mcap")] == [*range(10), *range(20, 30)]


def test_a_disk_that_refuses_leaves_the_damaged_file_as_it_is(run, tmp_path, monkeypatch):
    path = unclosed(run, tmp_path / "run.mcap")
    before = path.read_bytes()

    def refuse(writer: Writer) -> None:
        writer._file.cut()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Writer, "close", refuse)
    with pytest.raises(UserError, match="No space left"):
        repair(path, None)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("command", ["repair", "repair --out", "trim", "merge", "replay", "convert", "demo"])
def test_a_file_that_a_recorder_still_writes_is_not_replaced(run, tmp_path, capsys, command):
    live = tmp_path / "live.mcap"
    arguments = {
        "repair": ["recording", "repair", str(live)],
        "repair --out": ["recording", "repair", str(run), "--out", str(live)],
        "trim": ["recording", "trim", str(run), "--begin", "1", "--out", str(live)],
        "merge": ["recording", "merge", str(run), str(run), "--out", str(live)],
        "replay": ["replay", str(run), "--through", "odometry", "--robot", "x80sv", "--out", str(live)],
        "convert": ["convert", str(run), str(live), "--to", "foxglove", "--force"],
        "demo": ["demo", "--lockstep", "--world", "room", "--seconds", "5", "--record", str(live)],
    }[command]
    entries = list(Recording(run).entries(as_recorded=True))
    with Writer(live, exclusive=True) as writer:
        for entry in entries[:100]:
            writer.copy(entry)
        writer.flush()
        assert _status(arguments) != 0
        assert f"{live} is still being written" in capsys.readouterr().err
        for entry in entries[100:]:
            writer.copy(entry)
    assert list(Recording(live).entries(as_recorded=True)) == entries


def test_where_a_file_system_has_no_locks_an_unclosed_recording_is_repaired(run, tmp_path, monkeypatch):
    def refused(file, operation):
        raise OSError(errno.ENOLCK, "no locks")

    cut = unclosed(run, tmp_path / "cut.mcap")
    monkeypatch.setattr(fcntl, "flock", refused)
    repair(cut, None)
    assert Recording(cut).indexed


def test_what_other_programs_wrote_survives_a_repair(tmp_path):
    import mcap.writer

    path = tmp_path / "ros.mcap"
    writer = mcap.writer.Writer(str(path))
    writer.start("ros2", "rosbag2")
    writer.add_metadata("rosbag2", {"ROS_DISTRO": "jazzy"})
    number = writer.register_schema("sensor_msgs/msg/LaserScan", "ros2msg", b"?")
    channel = writer.register_channel("/scan", "cdr", number, {"offered_qos_profiles": "- depth: 1"})
    writer.add_message(channel, 1, b"x", 1, 0)
    bare = writer.register_channel("/raw", "", 0)
    writer.add_message(bare, 2, b"y", 2, 0)
    writer.finish()
    assert _status(["recording", "repair", str(path)]) == 0
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        assert [(m.name, m.metadata) for m in reader.iter_metadata() if m.name == "rosbag2"] == [
            ("rosbag2", {"ROS_DISTRO": "jazzy"})
        ]
        found = [(s and s.name, c.topic, c.metadata, m.data) for s, c, m in reader.iter_messages()]
    assert found == [
        ("sensor_msgs/msg/LaserScan", "/scan", {"offered_qos_profiles": "- depth: 1"}, b"x"),
        (None, "/raw", {}, b"y"),
    ]


# --- trim and merge -------------------------------------------------------------------------------------------------


def test_a_trimmed_beginning_replays_to_the_byte(run, tmp_path):
    out = tmp_path / "t.mcap"
    assert _status(["recording", "trim", str(run), "--end", "2.05", "--out", str(out)]) == 0
    assert rows(out) == [row for row in rows(run) if row[1] < rows(run)[0][1] + 2_050_000_000]
    replayed = replay(Recording(out), ["base_driver", "odometry", "mapper"], build)
    assert replayed.gaps == []
    report = compare_replayed(replayed)
    assert report.equal, report


def test_a_trimmed_middle_begins_with_what_was_latched_and_replays(run, tmp_path):
    out = tmp_path / "t.mcap"
    assert _status(["recording", "trim", str(run), "--begin", "1.5", "--out", str(out)]) == 0
    begin = rows(run)[0][1] + NS_PER_S * 3 // 2
    recording = Recording(out)
    entries = list(recording.entries())
    assert [(e.key, e.log_time, e.payload) for e in entries if not e.latched] == [r for r in rows(run) if r[1] >= begin]
    assert {e.key for e in entries if e.latched} == {"map", "pose", "plan"}
    assert all(e.log_time == begin for e in entries if e.latched)
    assert recording.attachments[CONFIG] == b"robot: {}\n"
    replayed = replay(recording, ["planner"], build)
    assert compare_replayed(replayed).equal


def test_trimming_topics_keeps_the_journals(run, tmp_path):
    out = tmp_path / "t.mcap"
    assert _status(["recording", "trim", str(run), "--topics", "odom,base/*", "--out", str(out)]) == 0
    assert {key for key, *_ in rows(out)} == {"odom", "base/wheels", *(f"journal/{name}" for name in CHAIN)}
    assert compare_replayed(replay(Recording(out), ["odometry"], build)).equal


def test_merged_parts_are_what_was_published_and_replay_to_the_byte(tmp_path, capsys):
    config = RecorderConfig(file=str(tmp_path / "run.mcap"), split_time=0.8)
    store, published = RecordingStore(config), []
    recorder = RecorderService(config, ROBOT, store)

    def take(sent):
        published.append(sent.payload)
        recorder.now = sent.envelope.sent
        recorder.raw(sent.key, sent.payload, sent.envelope, recorder.now)
        if len(published) % 20 == 0:
            list(recorder.flush())

    eventful(take)
    store.close()
    parts = sorted(map(str, tmp_path.glob("run*.mcap")))
    assert len(parts) >= 4
    out = tmp_path / "whole.mcap"
    assert _status(["recording", "merge", *reversed(parts), "--out", str(out)]) == 0
    recording = Recording(out)
    assert [entry.payload for entry in recording.entries()] == published
    replayed = replay(recording, CHAIN, build)
    assert replayed.gaps == []
    assert compare_replayed(replayed).equal


def test_trim_keeps_a_latched_message_that_no_other_of_its_topics_follows(tmp_path):
    path, out = tmp_path / "a.mcap", tmp_path / "b.mcap"
    payload = encode(EmergencyStop(0, True, "x"), Envelope("operator", "s", 0, 0))
    with Writer(path) as writer:
        writer.write("estop", EmergencyStop, payload, 0, 0, 0)
        for second in range(60):
            writer.write("log/mapper", LogLine, b"x", second * NS_PER_S, 0, second)
    assert trim(path, out, 30.0, None, ["estop"]) == 0
    assert [(e.key, e.log_time, e.latched, e.payload) for e in Recording(out).entries()] == [
        ("estop", 30 * NS_PER_S, True, payload)
    ]


def test_what_was_latched_while_the_disk_was_full_is_in_the_merged_recording(tmp_path):
    latched = {"metadata": (LATCHED,), "encoding": "msgpack", "schema_name": "", "schema_encoding": "", "schema": b""}
    for part, missed in ((1, []), (2, [Drop(30, "disk_full", "map", "s", 2, 5)])):
        about = {"robot": "x80", "recording": "run", "part": str(part)}
        with Writer(tmp_path / f"run.part{part}.mcap", about) as writer:
            for key in ("map", "plan") if part == 2 else ():
                writer.copy(Entry(Channel(key=key, **latched), 30, 20, 6, b"latched"))
            writer.note_drops(missed)
            for i in range(3):
                writer.write("map", LogLine, b"x", 30 * part - 30 + i, i, 7 * part - 7 + i)
    out = tmp_path / "whole.mcap"
    assert merge([tmp_path / "run.part1.mcap", tmp_path / "run.part2.mcap"], out) == 0
    found = [(entry.key, entry.log_time, entry.latched) for entry in Recording(out).entries()]
    assert found == [
        ("map", 0, False), ("map", 1, False), ("map", 2, False), ("map", 30, True),
        ("map", 30, False), ("map", 31, False), ("map", 32, False),
    ]  # fmt: skip


def test_recordings_that_were_taken_side_by_side_are_merged_by_their_times(tmp_path):
    for name, first in (("a", 0), ("b", 1)):
        with Writer(tmp_path / f"{name}.mcap", {"robot": "x80"}, {CONFIG: name.encode()}) as writer:
            for i in range(first, 20, 2):
                writer.write(f"log/{name}", LogLine, b"x", i, i, i)
    out = tmp_path / "c.mcap"
    assert merge([tmp_path / "b.mcap", tmp_path / "a.mcap"], out) == 0
    assert [time for _, time, _ in rows(out)] == list(range(20))
    assert Recording(out).attachments == {CONFIG: b"a", f"b-{CONFIG}": b"b"}


def test_a_message_that_stands_in_two_recordings_is_merged_once(run, tmp_path, capsys):
    part, out = tmp_path / "part.mcap", tmp_path / "whole.mcap"
    assert trim(run, part, 0.5, 1.5, []) == 0
    said = [entry for entry in Recording(part).entries() if not entry.latched]
    assert merge([part, run, run], out) == 0
    assert [entry for entry in Recording(out).entries() if not entry.latched] == list(Recording(run).entries())
    assert f"{len(said) + len(rows(run))} messages stood in two of them" in capsys.readouterr().err
    assert compare_replayed(replay(Recording(out), CHAIN, build)).equal


def test_what_one_recording_holds_twice_stays_twice(tmp_path):
    for name in "ab":
        with Writer(tmp_path / f"{name}.mcap", {"robot": "x80"}) as writer:
            for at in (1, 1, 2):
                writer.write("log/a", LogLine, b"x", at, 0, 7)
    assert merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "c.mcap") == 0
    assert [time for _, time, _ in rows(tmp_path / "c.mcap")] == [1, 1, 2]


def test_recordings_of_two_robots_are_not_merged(tmp_path):
    for name in "ab":
        with Writer(tmp_path / f"{name}.mcap", {"robot": name}):
            pass
    with pytest.raises(UserError, match="recordings of a and b"):
        merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "c.mcap")
    assert not (tmp_path / "c.mcap").exists()


# --- the others -----------------------------------------------------------------------------------------------------


def test_a_marked_recording_is_kept_and_may_be_given_free(run, capsys):
    keep = run.with_name(f"{run.name}.keep")
    assert _status(["recording", "mark", str(run)]) == 0
    assert keep.exists()
    assert _status(["recording", "mark", str(run), "--remove"]) == 0
    assert not keep.exists()


def test_plot_takes_the_numbers_of_the_messages(run, tmp_path):
    recording = Recording(run)
    x, yaw = series(recording, ["odom:odom_from_base.x", "odom:odom_from_base.yaw"], None, None)
    poses = [decode(Odometry, p)[0].odom_from_base for key, _, p in rows(run) if key == "odom"]
    assert x.values.tolist() == [pose.x for pose in poses]
    assert (x.unit, yaw.unit) == ("m", "rad")
    largest, third = series(recording, ["map:rows.max", "odom:covariance[4]"], None, None)
    assert largest.unit == "tiles"
    assert np.all(third.values == 1.0)


def test_plot_draws_a_picture_and_into_the_terminal(run, tmp_path, capsys):
    out = tmp_path / "p.png"
    assert _status(["recording", "plot", str(run), "odom:odom_from_base.x", "pose:quality", "--out", str(out)]) == 0
    with Image.open(out) as image:
        assert image.width == 2 * 660  # m and 1: two pairs of axes
    capsys.readouterr()
    assert _status(["recording", "plot", str(run), "odom:odom_from_base.x"]) == 0
    drawn = capsys.readouterr().out
    assert any(0x2800 < ord(c) <= 0x28FF for c in drawn)
    assert "odom:odom_from_base.x, m" in drawn


def test_a_range_without_an_echo_does_not_keep_the_others_from_being_drawn(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        for i, first in enumerate((1.0, np.inf, np.nan, 3.0)):
            scan = LaserScan(i, 0.0, 0.1, 0.1, 0.1, 10.0, np.array([first, 2.0], np.float32))
            writer.write("scan", LaserScan, encode(scan, Envelope("sim", "s", i, i)), i * NS_PER_S, i, i)
    assert _status(["recording", "plot", str(path), "scan:ranges[0]"]) == 0
    drawn = capsys.readouterr().out
    assert sum(0x2800 < ord(c) <= 0x28FF for c in drawn) == 2


def test_latency_is_from_stamp_and_from_sending_to_recording(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        for i in range(100):
            stamp, sent = i * NS_PER_S, i * NS_PER_S + 4_000_000
            payload = encode(Velocity(stamp, 0.0, 0.0, ""), Envelope("guard", "s", i, sent))
            writer.write("cmd/vel", Velocity, payload, sent + 1_000_000 * (1 + (i == 99)), sent, i)
    assert _status(["recording", "latency", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    row = told["topics"]["cmd/vel"]
    assert row["n"] == 100
    assert row["stamp"]["p50"] == pytest.approx(5.0)
    assert (row["sent"]["p50"], row["sent"]["p100"]) == pytest.approx((1.0, 2.0))
    assert told["chain"] == {}
    assert _status(["recording", "latency", str(path), "cmd/*"]) == 0
    assert topics.CMD_VEL.key in capsys.readouterr().out


def test_a_stack_on_a_saved_map_attaches_its_files(tmp_path):
    for name in ("graph.msgpack", "map.yaml", "map.pgm", "map.png"):
        (tmp_path / name).write_bytes(name.encode())
    on_map = OnMap(tmp_path, MapMode.LOCALISE, None)
    config = RecorderConfig(file=str(tmp_path / "a.mcap"), attach=tuple(on_map.files()))
    store = RecordingStore(config)
    store.begin(NS_PER_S, "x80", "robot: {}\n", [])
    store.close()
    attached = Recording(tmp_path / "a.mcap").attachments
    assert attached == {name: name.encode() for name in ("graph.msgpack", "map.yaml", "map.pgm")} | {
        CONFIG: b"robot: {}\n"
    }


@pytest.mark.parametrize("command", ["latency", "stability"])
def test_a_payload_that_cannot_be_read_costs_its_message_alone(tmp_path, capsys, command):
    recorded, damaged = path_of("driving"), tmp_path / "damaged.mcap"
    source = Recording(recorded)
    added = dict.fromkeys(("scan", "cmd/nav", "cmd/vel", "odom", "nav/status"))
    with Writer(damaged, source.about, source.attachments) as writer:
        for entry in source.entries(as_recorded=True):
            writer.copy(entry)
            if entry.key in added and added[entry.key] is None:
                added[entry.key] = replace(entry, payload=b"\xff\x00noise", sequence=10**6)
                writer.copy(added[entry.key])
    assert all(added.values())
    said = []
    for path in (recorded, damaged):
        assert _status(["recording", command, str(path), "--json"]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1]
