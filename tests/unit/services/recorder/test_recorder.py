# SPDX-License-Identifier: Apache-2.0
"""The recorder takes every payload, flushes each second, and says what it could not record."""

import errno
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from services.recorder.message_losses import OVERLOAD, MessageLosses
from services.recorder.recording_store import RecorderConfig, RecordingStore
from services.recorder.retention import StoredRecording, recordings_to_remove
from services.recorder.service import RecorderService
from shared import topics
from shared.codec import Envelope, decode, encode
from shared.config import UserError, load_robot
from shared.messages import EmergencyStop, LogLine, MapUpdate
from shared.reasons import DISK_FULL, NOT_RECORDED
from shared.recording import CONFIG, Drop, Recording, Writer
from shared.requests import SetSettings
from shared.service import Log
from shared.types import NS_PER_S
from tests.disks import no_file_longer_than

ROBOT = load_robot("x80sv").robot
START = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC

Make = Callable[..., RecorderService]


@pytest.fixture
def recorder() -> Iterator[Make]:
    """Makes recorders with these settings; their files are closed after the test."""
    with ExitStack() as stack:

        def make(kind: type[RecordingStore] = RecordingStore, **settings: object) -> RecorderService:
            config = RecorderConfig.model_validate(settings)
            store = kind(config)
            stack.callback(store.close)
            return RecorderService(config, ROBOT, store)

        yield make


def take(service: RecorderService, n: int, key: str = "estop", first: int = 0, at: int = START) -> list[bytes]:
    """Messages of one session, `n` from number `first`, at `at` (ns)."""
    payloads = []
    for i in range(first, first + n):
        envelope = Envelope("operator", "s", i, START + i)
        payloads.append(encode(EmergencyStop(START + i, True, "x" * 100), envelope))
        service.now = at
        service.raw(key, payloads[-1], envelope, at)
    return payloads


def flushed(service: RecorderService) -> list[Log]:
    return [out for out in service.flush() if isinstance(out, Log)]


def payloads_in(path: Path) -> list[bytes]:
    return [entry.payload for entry in Recording(path).entries()]


def test_what_was_taken_is_in_the_file_after_the_tick(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    assert flushed(service) == []
    payloads = take(service, 50)
    assert [log.level for log in flushed(service)] == ["INFO"]
    assert payloads_in(tmp_path / "a.mcap") == payloads
    assert service.state() == "recording, 50 messages"


def test_the_file_is_named_by_robot_and_start_and_never_overwritten(recorder, tmp_path):
    for _ in range(3):
        service = recorder(folder=str(tmp_path))
        take(service, 1)
        list(service.flush())
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["x80-20231114-221320-2.mcap", "x80-20231114-221320-3.mcap", "x80-20231114-221320.mcap"]
    assert [Recording(tmp_path / name).about["recording"] for name in names] == [n.removesuffix(".mcap") for n in names]


def test_the_file_holds_robot_and_configuration(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    service.robot_file = "robot:\n  name: x80\n"
    take(service, 1)
    recording = Recording(tmp_path / "a.mcap")
    assert recording.about["robot"] == "x80"
    assert recording.attachments[CONFIG].decode() == service.robot_file


def test_every_key_of_the_registry_is_recorded(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    keys = [topics.key_of(topic, "mapper") for topic in topics.TOPICS]
    for key in keys:
        take(service, 1, key)
    list(service.flush())
    assert [entry.key for entry in Recording(tmp_path / "a.mcap").entries()] == keys


def test_unknown_topics_are_left_out_and_counted(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    take(service, 3, "weather")
    take(service, 2)
    assert service.state() == "recording, 2 messages, 3 of unknown topics left out"


def test_a_closed_recording_has_its_index(tmp_path):
    config = RecorderConfig(file=str(tmp_path / "a.mcap"))
    store = RecordingStore(config)
    take(RecorderService(config, ROBOT, store), 5)
    store.close()
    assert Recording(tmp_path / "a.mcap").problems == []
    store.close()


class FullDisk(RecordingStore):
    """Refuses to write while `full`."""

    full_disk = False

    def write(self, *row: object) -> None:
        if self.full_disk:
            assert self._writer is not None
            self._writer._file.cut()
            raise OSError(errno.ENOSPC, "No space left on device")
        super().write(*row)  # type: ignore[arg-type]

    def begin(self, *row: object) -> None:
        if self.full_disk:
            raise OSError(errno.ENOSPC, "No space left on device")
        super().begin(*row)  # type: ignore[arg-type]


def test_a_full_disk_is_told_counted_and_recording_goes_on_when_there_is_room(recorder, tmp_path):
    service = recorder(FullDisk, file=str(tmp_path / "a.mcap"))
    payloads = take(service, 10)
    flushed(service)
    take(service, 3, first=10)  # not flushed: the disk takes them back
    service._store.full_disk = True
    take(service, 7, first=13)
    logs = flushed(service)
    assert [log.level for log in logs] == ["ERROR"]
    assert DISK_FULL.text in logs[0].text
    assert DISK_FULL.hint in logs[0].text
    assert service.state() == f"{DISK_FULL.text}, 10 not recorded"
    assert payloads_in(tmp_path / "a.mcap") == payloads
    take(service, 1, first=20, at=START + 2 * NS_PER_S)  # still full
    assert flushed(service) == []  # logged once

    service._store.full_disk = False
    later = take(service, 5, first=21, at=START + 5 * NS_PER_S)
    assert [log.level for log in flushed(service)] == ["INFO"]
    assert service.state() == "recording, 15 messages, 11 not recorded"
    part = Recording(tmp_path / "a.part002.mcap")
    entries = list(part.entries())
    assert [(e.latched, e.payload) for e in entries] == [
        (True, take(service, 1, first=20)[0]),
        *((False, p) for p in later),
    ]
    assert part.drops == [Drop(START + 5 * NS_PER_S, DISK_FULL.code, "estop", "s", 10, 11)]
    assert "11 estop" in part.problems[0]


def test_a_disk_that_stays_full_is_tried_ever_more_seldom(recorder, tmp_path):
    tried = []

    class Counting(FullDisk):
        full_disk = True

        def begin(self, now: int, *row: object) -> None:
            tried.append((now - START) // NS_PER_S)
            super().begin(now, *row)

    service = recorder(Counting, file=str(tmp_path / "a.mcap"))
    for second in range(100):
        take(service, 1, first=second, at=START + second * NS_PER_S)
    assert tried == [0, 1, 3, 7, 15, 31, 63, 95]
    assert not list(tmp_path.iterdir())


def test_a_clock_that_jumps_back_does_not_keep_it_from_trying(recorder, tmp_path):
    service = recorder(FullDisk, file=str(tmp_path / "a.mcap"))
    service._store.full_disk = True
    take(service, 1)
    service._store.full_disk = False
    take(service, 1, first=1, at=START - 3600 * NS_PER_S)
    flushed(service)
    assert service.state() == "recording, 1 messages, 1 not recorded"


def test_what_the_system_refuses_costs_a_second_and_not_the_recording(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    recorded: list[bytes] = []
    with no_file_longer_than(30_000):
        for second in range(40):
            recorded += shout(service, 5, first=5 * second, at=START + second * NS_PER_S)
            flushed(service)
    recorded += shout(service, 5, first=200, at=START + 100 * NS_PER_S)
    flushed(service)
    found = [payload for path in sorted(tmp_path.iterdir()) for payload in payloads_in(path)]
    drops = [drop for path in sorted(tmp_path.iterdir()) for drop in Recording(path).drops]
    assert len(list(tmp_path.iterdir())) > 2
    assert 20 < len(found) < 205
    assert [payload for payload in recorded if payload in found] == found
    assert sum(drop.n for drop in drops) == 205 - len(found)
    assert service.state() == f"recording, {len(found)} messages, {205 - len(found)} not recorded"


@pytest.mark.parametrize("n_tries", [1, 2])
def test_messages_that_were_missed_before_a_disk_error_are_in_the_next_part(recorder, tmp_path, monkeypatch, n_tries):
    """The disk takes the record of what is missing, and refuses the chunk after it: both are cut off."""

    def refuse(writer: Writer) -> None:
        writer._file.cut()
        raise OSError(errno.ENOSPC, "No space left on device")

    service = recorder(file=str(tmp_path / "a.mcap"))
    take(service, 5)
    flushed(service)
    for i in range(n_tries):
        take(service, 1, first=8 + i, at=START + 10 * i * NS_PER_S)  # the first one: three before it did not come
        with monkeypatch.context() as patch:
            patch.setattr(Writer, "flush", refuse)
            flushed(service)
    take(service, 1, first=8 + n_tries, at=START + 60 * NS_PER_S)
    flushed(service)
    drops = [drop for path in tmp_path.iterdir() for drop in Recording(path).drops]
    assert {drop.why: drop.n for drop in drops} == {OVERLOAD: 3, DISK_FULL.code: n_tries}
    assert service.state() == f"recording, 6 messages, {n_tries} not recorded, 3 missed"


def shout(service: RecorderService, n: int, first: int, at: int) -> list[bytes]:
    """Log lines of some kB that do not compress well."""
    payloads = []
    for i in range(first, first + n):
        envelope = Envelope("mapper", "s", i, at)
        payloads.append(encode(LogLine(at, "INFO", noise(i)), envelope))
        service.now = at
        service.raw("log/mapper", payloads[-1], envelope, at)
    return payloads


def noise(seed: int) -> str:
    """Some kB that do not compress well."""
    return f"{pow(seed + 3, 3000):x}"


def test_a_folder_that_cannot_be_made_is_told_at_the_start(recorder, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot make"):
        recorder(folder=str(tmp_path / "file" / "recordings"))


def test_a_folder_that_vanished_is_a_state(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "sub" / "a.mcap"))
    (tmp_path / "sub").rmdir()
    take(service, 2)
    assert service.state() == f"{NOT_RECORDED.text}, 2 not recorded"
    assert "No such file or directory" in flushed(service)[0].text


# --- what is recorded -----------------------------------------------------------------------------------------------


def test_a_choice_of_topics_is_recorded(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"), topics=("journal/*", "estop", "log/*"), exclude=("log/guard",))
    for key in ("estop", "journal/mapper", "log/mapper", "log/guard", "odom"):
        take(service, 1, key)
    flushed(service)
    assert [e.key for e in Recording(tmp_path / "a.mcap").entries()] == ["estop", "journal/mapper", "log/mapper"]


def test_a_pattern_that_names_no_topic_is_told_with_the_nearest():
    with pytest.raises(ValidationError, match="did you mean `scan`"):
        RecorderConfig(topics=("scna",))


def test_files_are_attached_to_every_part(recorder, tmp_path):
    (tmp_path / "map.yaml").write_bytes(b"image: map.pgm\n")
    service = recorder(folder=str(tmp_path), attach=(str(tmp_path / "map.yaml"),), split_time=1)
    service.robot_file = "robot: {}\n"
    for second in range(3):
        take(service, 1, first=second, at=START + second * NS_PER_S)
        flushed(service)
    parts = sorted(tmp_path.glob("*.mcap"))
    assert len(parts) == 3
    for part in parts:
        assert Recording(part).attachments == {"map.yaml": b"image: map.pgm\n", CONFIG: b"robot: {}\n"}


def test_an_attachment_that_is_not_there_is_told_at_the_start(recorder, tmp_path):
    with pytest.raises(UserError, match="cannot read"):
        recorder(folder=str(tmp_path), attach=(str(tmp_path / "no.yaml"),))


# --- what did not come ----------------------------------------------------------------------------------------------


def test_messages_that_never_came_are_counted_and_written_down(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    take(service, 3, first=40)  # it joined late: the first 40 are not missed
    take(service, 2, first=50, at=START + 10 * NS_PER_S)
    flushed(service)
    assert service.state() == "recording, 5 messages, 7 missed"
    recording = Recording(tmp_path / "a.mcap")
    assert recording.drops == [Drop(START + 10 * NS_PER_S, OVERLOAD, "estop", "s", 43, 7)]
    assert len(recording.problems) == 2  # and it is not closed
    assert "10.0 s after the start" in recording.problems[0]
    assert "7 estop" in recording.problems[0]


@pytest.mark.parametrize("full", [False, True])
def test_messages_that_were_missed_shortly_before_the_end_are_written_down(tmp_path, full):
    config = RecorderConfig(file=str(tmp_path / "a.mcap"))
    store = FullDisk(config)
    service = RecorderService(config, ROBOT, store)
    take(service, 3)
    flushed(service)
    store.full_disk = full
    take(service, 1, first=7)
    assert list(service.on_shutdown()) == []
    store.close()
    expected = [] if full else [Drop(START, OVERLOAD, "estop", "s", 3, 4)]
    assert Recording(tmp_path / "a.mcap").drops == expected


@given(st.lists(st.integers(0, 60), unique=True, max_size=60))
def test_what_is_missed_is_what_lies_between_the_first_and_the_last(came):
    losses = MessageLosses()
    for sequence in sorted(came):
        losses.record_received(("scan", "s"), sequence)
    expected = max(came) - min(came) + 1 - len(came) if came else 0
    assert losses.n_missed == expected
    assert sum(drop.n for drop in losses.take_drops(0)) == expected
    assert losses.take_drops(0) == []


def test_messages_out_of_their_order_are_not_missed_twice():
    losses = MessageLosses()
    for sequence in (0, 3, 1, 2, 4, 4):
        losses.record_received(("scan", "s"), sequence)
    assert losses.n_missed == 2


# --- the budget -----------------------------------------------------------------------------------------------------


def test_the_oldest_parts_go_first_and_marked_ones_never(recorder, tmp_path):
    service = recorder(folder=str(tmp_path), split_size=0.05, budget=0.3)
    (tmp_path / "notes.txt").write_text("of the user")
    (tmp_path / "other-20231114-221320.mcap").write_bytes(b"of another robot" * 10_000)
    for second in range(12):
        shout(service, 60, 60 * second, START + second * NS_PER_S)
        flushed(service)
        if second == 1:
            (tmp_path / "x80-20231114-221320.part002.mcap.keep").touch()
    parts = sorted(tmp_path.glob("x80-*.mcap"))
    numbers = [Recording(part).about["part"] for part in parts]
    assert numbers[0] == "2"
    assert numbers[1:] == [str(n) for n in range(int(numbers[1]), 14)]
    assert sum(part.stat().st_size for part in parts[1:]) <= 0.3e6
    assert len(numbers) >= 3
    assert (tmp_path / "notes.txt").exists()
    assert (tmp_path / "other-20231114-221320.mcap").exists()


def test_recordings_that_a_user_named_stay_whatever_the_budget(recorder, tmp_path):
    named = ["x80-2.mcap", "x80-20231101-whole.mcap", "x80-20231101-101500-docking.mcap"]
    given = ["x80-20231101-101500.mcap", "x80-20231101-101500-2.mcap", "x80-20231101-101500-2.part002.mcap"]
    for name in (*named, *given):
        (tmp_path / name).write_bytes(b"x" * 300_000)
    service = recorder(folder=str(tmp_path), split_size=0.05, budget=0.3)
    take(service, 1)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {*named, "x80-20231114-221320.mcap"}


def test_links_that_lead_nowhere_do_not_keep_the_others_from_being_removed(recorder, tmp_path):
    for minute in range(20):
        (tmp_path / f"x80-20231101-10{minute:02}00.mcap").write_bytes(b"x" * 100_000)
        (tmp_path / f"x80-20231102-10{minute:02}00.mcap").symlink_to(tmp_path / "nowhere")
    take(recorder(folder=str(tmp_path), split_size=0.05, budget=0.3), 1)
    assert sum(path.stat().st_size for path in tmp_path.iterdir() if path.exists()) <= 0.3e6


def test_a_lower_maximum_size_of_a_part_holds_for_the_open_one(recorder, tmp_path):
    service = recorder(folder=str(tmp_path))
    shout(service, 60, 0, START)
    flushed(service)
    assert len(list(tmp_path.glob("*.mcap"))) == 1
    service.name = "recorder"
    list(service.set_settings(SetSettings(START, ("recorder.split_size",), ("0.01",), False)))
    flushed(service)
    assert len(list(tmp_path.glob("*.mcap"))) == 2


recordings = st.lists(
    st.builds(
        StoredRecording,
        st.integers().map(lambda i: Path(str(i))),
        st.integers(0, 100),
        st.integers(0, 9),
        st.booleans(),
        st.booleans(),
    ),
    unique_by=lambda kept: kept.path,
)


@given(recordings, st.integers(0, 500))
def test_what_is_left_fits_the_budget_and_nothing_goes_needlessly(found, budget):
    gone = recordings_to_remove(found, budget)
    own = {kept.path: kept for kept in found if not kept.marked}
    assert set(gone) <= own.keys()
    left = sum(kept.size for kept in own.values() if kept.path not in gone)
    assert left <= budget
    if gone:
        assert left + own[gone[-1]].size > budget
        last_gone = max((not own[path].uploaded, own[path].changed) for path in gone)
        assert all((not r.uploaded, r.changed) >= last_gone for r in own.values() if r.path not in gone)


def test_uploaded_parts_go_first_and_one_that_is_not_is_reported(recorder, tmp_path):
    service = recorder(folder=str(tmp_path / "here"), split_size=0.05, budget=0.3, upload=str(tmp_path / "there"))
    service._store._upload.wake = lambda order: None  # no uploader: the test writes what it would
    logs = []
    for second in range(5):
        shout(service, 60, 60 * second, START + second * NS_PER_S)
        logs += flushed(service)
    first, second_part, *_ = sorted((tmp_path / "here").glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    stat = second_part.stat()
    record = {"size": stat.st_size, "changed": stat.st_mtime_ns}
    (tmp_path / "here" / f"{second_part.name}.uploaded").write_text(json.dumps(record))
    (tmp_path / "here" / f"{first.name}.uploaded").write_text(json.dumps({**record, "size": 1}))  # of another content
    for second in range(5, 7):
        shout(service, 60, 60 * second, START + second * NS_PER_S)
        logs += flushed(service)
    assert not second_part.exists()
    assert not (tmp_path / "here" / f"{second_part.name}.uploaded").exists()
    n_forced = service._store.n_removed_before_upload
    assert n_forced == sum("was removed before its upload" in log.text for log in logs)
    if n_forced:
        assert f"{n_forced} parts removed before their upload" in service.state()


@pytest.mark.parametrize(
    ("url", "words"),
    [("https://example.com/logs", "cannot be written to"), ("s3://logs", "not installed: s3fs"),
     ("gs://logs", "not installed: gcsfs")],
)  # fmt: skip
def test_an_upload_that_cannot_be_is_one_line_at_the_start(monkeypatch, tmp_path, url, words):
    monkeypatch.setattr("services.recorder.upload_process.find_spec", lambda name: name == "fsspec" or None)
    with pytest.raises(UserError, match=words) as error:
        RecordingStore(RecorderConfig(folder=str(tmp_path), upload=url))
    assert error.value.hint


def test_the_recorder_loads_no_library_of_a_store():
    code = "import sys, services.recorder.__main__; sys.stdout.write(' '.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "services.recorder.upload_process" in loaded
    assert not {"fsspec", "s3fs", "botocore", "pyarrow"} & set(loaded)


def test_a_part_that_is_over_half_of_the_budget_is_refused():
    with pytest.raises(ValidationError, match="half of the budget"):
        RecorderConfig(split_size=600, budget=1000)


# --- what was latched before it came --------------------------------------------------------------------------------


def test_what_is_kept_for_late_joiners_is_recorded_once_and_as_that(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"))
    envelope = Envelope("operator", "s", 7, START - NS_PER_S)
    kept = encode(EmergencyStop(START, True, "before"), envelope)
    for _ in range(2):
        service.raw("estop", kept, envelope, START, latched=True)
    (later,) = take(service, 1, first=8)
    service.raw("estop", kept, envelope, START + 1, latched=True)  # a late answer
    flushed(service)
    entries = list(Recording(tmp_path / "a.mcap").entries())
    assert [(e.latched, e.payload, e.sequence) for e in entries] == [(True, kept, 7), (False, later, 8)]
    assert service.state() == "recording, 1 messages"


def test_what_is_kept_stands_in_the_next_part_too(recorder, tmp_path):
    service = recorder(folder=str(tmp_path), split_time=1)
    take(service, 1, "log/guard")
    row = np.array([1, 2], np.int32)
    whole = MapUpdate(START, 1, 5, 0.05, row, row, np.zeros((2, 4096), np.int8))
    envelope = Envelope("mapper", "m", 5, START)
    service.raw("map", encode(whole, envelope), envelope, START, latched=True)
    take(service, 1, "log/guard", first=1, at=START + NS_PER_S)
    flushed(service)
    (kept,) = [entry for entry in Recording(sorted(tmp_path.iterdir())[1]).entries() if entry.latched]
    assert decode(MapUpdate, kept.payload)[0].rows.tolist() == [1, 2]
    assert (kept.sequence, kept.log_time) == (5, START + NS_PER_S)
