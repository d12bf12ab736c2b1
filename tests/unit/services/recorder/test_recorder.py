# SPDX-License-Identifier: Apache-2.0
"""The recorder takes every payload, flushes each second, and says what it could not record."""

import errno
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from services.recorder.service import RecorderService
from services.recorder.store import RecorderConfig, RecordingStore
from shared import topics
from shared.codec import Envelope, encode
from shared.config import UserError, load_robot
from shared.messages import EmergencyStop, LogLine
from shared.recording import CONFIG, Recording
from shared.service import Log

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


def take(service: RecorderService, n: int, key: str = "estop") -> list[bytes]:
    payloads = []
    for i in range(n):
        envelope = Envelope("operator", "s", i, START + i)
        payloads.append(encode(EmergencyStop(START + i, True, "x" * 100), envelope))
        service.now = START + i
        service.raw(key, payloads[-1], envelope, START + i)
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


class FullStore(RecordingStore):
    """A disk that is full after some messages."""

    room = 10

    def write(self, *row: object) -> None:
        self.room -= 1
        if self.room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        super().write(*row)  # type: ignore[arg-type]


def test_a_full_disk_ends_the_recording_and_not_the_recorder(recorder, tmp_path):
    service = recorder(FullStore, file=str(tmp_path / "a.mcap"))
    payloads = take(service, 10)
    list(service.flush())
    take(service, 7)
    assert [(log.level, log.text) for log in flushed(service)] == [("ERROR", "recording ended: disk full")]
    assert flushed(service) == []  # told once
    assert service.state() == "disk full: recording ended, 7 messages not recorded"
    assert payloads_in(tmp_path / "a.mcap") == payloads


def test_a_recording_ends_at_its_largest_size(recorder, tmp_path):
    service = recorder(file=str(tmp_path / "a.mcap"), max_size=0.01)
    for i in range(20):
        envelope = Envelope("mapper", "s", i, i)
        service.raw("log/mapper", encode(LogLine(i, "INFO", noise(i)), envelope), envelope, START + i)
        list(service.flush())
    assert "max_size of 0.01 MB is reached" in service.state()
    assert 0 < len(payloads_in(tmp_path / "a.mcap")) < 20


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
    assert service.state() == "No such file or directory: recording ended, 2 messages not recorded"
