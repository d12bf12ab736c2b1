# SPDX-License-Identifier: Apache-2.0
"""The black box: bounded, removed when all is well, never in the way, whatever the disk does."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from shared import topics
from shared.codec import Envelope, encode
from shared.config import UserError
from shared.messages import WheelState
from shared.recording import Recording, Writer
from shared.runners import blackbox
from shared.runners.blackbox import CRASHES, BlackBox, Taken, crash_line, crash_of

NOW = 1_700_000_000_000_000_000


def filled(folder: Path, n: int = 100, at_once: int = 10, name: str = "odometry", slowly: bool = False) -> BlackBox:
    """A box that was given n messages."""
    box = BlackBox(folder, name, "x80", "robot: {}")
    for i in range(n):
        envelope = Envelope("base_driver", "s", i, NOW + i)
        payload = encode(WheelState(NOW + i, 0, float(i), 0.0, 0.0, 0.0), envelope)
        box.take(Taken(topics.WHEELS.key, WheelState, payload, envelope, NOW + i, False))
        if i % at_once == 0:
            box.hand_over()
            while slowly and not box._waiting.empty():
                threading.Event().wait(0.001)
    return box


def test_what_was_taken_last_is_in_the_crash(tmp_path):
    path = filled(tmp_path).close(NOW + 99)
    assert path is not None
    assert path.name == "crash-odometry-20231114-221320.mcap"
    recording = Recording(path)
    assert [entry.sequence for entry in recording.entries()] == list(range(100))
    assert recording.attachments["config.yaml"] == b"robot: {}"
    assert recording.problems == []


def test_an_end_in_order_leaves_nothing(tmp_path):
    box = filled(tmp_path, slowly=True)
    assert list(tmp_path.glob("life-odometry-*.part"))
    assert box.close(None) is None
    assert list(tmp_path.iterdir()) == []


def test_only_the_last_crashes_are_kept(tmp_path):
    for i in range(CRASHES + 3):
        filled(tmp_path).close(NOW + i * 10**9)
    filled(tmp_path, name="mapper").close(NOW)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == CRASHES + 1
    assert names[-1] == "crash-odometry-20231114-221327.mcap"


def test_a_long_life_is_two_files_and_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(blackbox, "SEGMENT", 2_000)
    path = filled(tmp_path, 5000, 50, slowly=True).close(NOW)
    assert path is not None
    (before,) = tmp_path.glob("*-before.mcap")
    assert len(list(tmp_path.iterdir())) == 2
    sequences = [entry.sequence for p in (before, path) for entry in Recording(p).entries()]
    assert sequences == list(range(sequences[0], 5000))


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_stays(tmp_path):
    (tmp_path / "life-odometry-999999999.part").write_bytes(b"x")
    (tmp_path / "life-odometry-1.part").write_bytes(b"x")
    (tmp_path / "life-mapper-999999999.part").write_bytes(b"x")
    filled(tmp_path, slowly=True).close(None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["life-mapper-999999999.part", "life-odometry-1.part"]


def full(writer: Writer, *_: object, **__: object) -> None:
    if hasattr(writer, "_file"):
        writer._file.close()
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("method", ["__init__", "write", "close"])
def test_a_full_disk_is_no_second_crash_and_leaves_nothing(tmp_path, monkeypatch, method, caplog):
    monkeypatch.setattr(Writer, method, full)
    box = filled(tmp_path)
    assert box.close(NOW) is None
    assert "could not be recorded" in caplog.text
    monkeypatch.undo()
    assert not list(tmp_path.glob("*.mcap"))


def test_a_folder_that_cannot_be_made_is_no_second_crash(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    assert filled(tmp_path / "file" / "folder").close(NOW) is None


def test_the_last_of_the_disk_is_left_to_others(tmp_path, monkeypatch):
    monkeypatch.setattr(blackbox, "RESERVE", 10**18)
    assert filled(tmp_path).close(NOW) is None
    assert list(tmp_path.iterdir()) == []


def stuck(gate: threading.Event) -> Callable[..., None]:
    def write(*_: object) -> None:
        gate.wait(30)

    return write


def test_a_disk_that_hangs_holds_up_neither_life_nor_death(tmp_path, monkeypatch):
    gate = threading.Event()
    monkeypatch.setattr(Writer, "write", stuck(gate))
    monkeypatch.setattr(blackbox, "PATIENCE", 0.05)
    box = filled(tmp_path, 5000, 10)
    assert box._waiting.qsize() <= blackbox.LATEST + 1
    assert box.close(NOW) is None
    gate.set()
    box._thread.join(10)
    assert box.close(None) is None


def test_words_of_a_crash_are_one_line_and_the_same_live_and_replayed():
    error = UserError("two\nlines", "hint")
    error.add_note("replaying mapper (a-1): event 7 at 123 ns")
    assert crash_of(error) == crash_line(error, 123)
    assert "\n" not in crash_of(error)
    assert crash_of(ValueError("x")) == ""
