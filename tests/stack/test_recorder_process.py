# SPDX-License-Identifier: Apache-2.0
"""The recorder as a process, treated badly: killed, stopped, on a full disk. What it took until then is there."""

import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from services.recorder.message_losses import OVERLOAD
from shared import topics
from shared.config import UserError
from shared.messages import EmergencyStop, Health
from shared.reasons import DISK_FULL
from shared.recording import CONFIG, Recording
from shared.topics import Publication
from tests.stack.processes import ROBOT, StackProcesses, wait
from zenav.__main__ import _status
from zenav.client import Client
from zenav.stack.launch import Launcher, free_stack, service_command

PACE = 0.004  # s: a link drops what is put faster than its thread runs on a busy machine


@contextmanager
def recorder(folder: Path, *settings: str) -> Iterator[StackProcesses]:
    """The recorder's process alone, heard by a tool that publishes in the place of others."""
    told: list[tuple[str, str]] = []
    with free_stack() as claim:
        chosen = [f"recorder.folder={folder / 'recordings'}", *settings]
        commands = {"recorder": service_command("recorder", "x80sv", str(claim.where.domain), chosen)}
        launcher = Launcher(commands, folder, lambda name, line: told.append((name, line)))
        with launcher, Client(ROBOT.name, claim.where) as client:
            stack = StackProcesses(launcher, client, claim.where, told)
            client.listen(topics.HEALTH, lambda health, _: stack.hear(health))
            launcher.start_all(lambda name: name in stack.healths)
            stack.until(lambda: "recorder" in stack.healths, 60)
            publish(stack, 1)
            stack.until(lambda: health(stack).state.startswith("recording"))
            yield stack


def health(stack: StackProcesses) -> Health:
    return stack.healths["recorder"]


def publish(stack: StackProcesses, n: int, size: int = 100) -> None:
    for _ in range(n):
        text = os.urandom(size // 2).hex()  # nothing that a compressor could make smaller
        stack.client.publish(Publication(topics.ESTOP, EmergencyStop(stack.client.now(), True, text)))
        wait(PACE)


def parts(folder: Path) -> list[Path]:
    return sorted((folder / "recordings").glob("*.mcap"))


def stops(path: Path) -> list[int]:
    """The numbers of the messages on estop."""
    try:
        return [entry.sequence for entry in Recording(path).entries(["estop"]) if not entry.latched]
    except UserError:
        return []


def test_what_a_killed_recorder_took_until_a_second_ago_is_there_and_its_successor_goes_on(tmp_path):
    with recorder(tmp_path) as stack:
        publish(stack, 99)
        (first,) = parts(tmp_path)
        stack.until(lambda: publish(stack, 1) or len(stops(first)) > 100)
        before = stops(first)
        publish(stack, 1)
        os.kill(stack.pid("recorder"), signal.SIGKILL)
        assert stops(first)[: len(before)] == before
        stack.until(lambda: len(parts(tmp_path)) == 2)
        stack.until(lambda: publish(stack, 1) or len(stops(parts(tmp_path)[1])) >= 10)
    assert "not closed" in Recording(first).problems[-1]
    assert Recording(parts(tmp_path)[1]).indexed
    assert _status(["recording", "repair", str(first)]) in (0, 1)
    assert Recording(first).indexed
    assert stops(first)[: len(before)] == before


def test_a_stopped_recorder_leaves_its_file_readable_and_writes_down_what_it_missed(tmp_path):
    with recorder(tmp_path) as stack:
        (path,) = parts(tmp_path)
        stack.until(lambda: publish(stack, 1) or len(stops(path)) > 50)
        before = stops(path)
        pid = stack.pid("recorder")
        os.kill(pid, signal.SIGSTOP)
        try:
            assert stops(path)[: len(before)] == before
            for _ in range(40):
                publish(stack, 10, 50_000)  # more than links and buffers hold
        finally:
            os.kill(pid, signal.SIGCONT)
        stack.until(lambda: publish(stack, 1) or stops(path)[-1] > 450)
    recording, numbers = Recording(path), stops(path)
    drops = [drop for drop in recording.drops if drop.key == "estop"]
    assert numbers == sorted(set(numbers))
    assert len(numbers) + sum(drop.n for drop in drops) == numbers[-1] + 1
    assert {drop.why for drop in drops} == {OVERLOAD}
    assert "the recorder had missed" in recording.problems[0]


def test_a_recorder_that_splits_publishes_and_closes_whole_parts(tmp_path):
    with recorder(tmp_path, "recorder.split_time=1") as stack:
        stack.until(lambda: publish(stack, 1) or len(parts(tmp_path)) >= 3)
    found = parts(tmp_path)
    assert all(Recording(path).damage == [] and Recording(path).indexed for path in found)
    numbers = [number for path in found for number in stops(path)]
    missed = sum(drop.n for path in found for drop in Recording(path).drops if drop.key == "estop")
    assert numbers == sorted(set(numbers))
    assert len(numbers) + missed == numbers[-1] + 1
    for path in found:
        recording = Recording(path)
        assert recording.about["host"]
        assert recording.about["commit"]
        assert "recorder:" in recording.attachments[CONFIG].decode()
    for before, path in pairwise(found):
        pressed = stops(before)[-1:]  # a busy machine may have said nothing in the first part
        assert [entry.sequence for entry in Recording(path).entries(["estop"]) if entry.latched] == pressed
    assert len(stops(found[-2])) > 0


def test_parts_are_uploaded_beside_a_recorder_that_is_killed_and_started_again(tmp_path):
    there = tmp_path / "there"
    with recorder(tmp_path, "recorder.split_time=1", f"recorder.upload={there}") as stack:
        stack.until(lambda: publish(stack, 1) or len(list(there.glob("*.mcap"))) >= 1)
        stack.until(lambda: "upload: " in health(stack).state)
        os.kill(stack.pid("recorder"), signal.SIGKILL)
        killed = parts(tmp_path)[-1]
        stack.until(lambda: publish(stack, 1) or (there / killed.name).exists(), 60)
        stack.until(lambda: any(f"uploaded {killed.name}" in line for _, line in stack.told))
    copies = sorted(there.glob("*.mcap"))
    assert len(copies) >= 2
    assert [copy.read_bytes() for copy in copies] == [(tmp_path / "recordings" / c.name).read_bytes() for c in copies]
    assert _status(["recording", "find", "", str(there), "--json"]) == 0


def test_a_full_disk_is_a_reason_in_its_health_and_recording_goes_on_with_room(tmp_path):
    with recorder(tmp_path) as stack:
        pid = stack.pid("recorder")
        full = 40_000  # bytes: as a full disk, no file can grow beyond
        before = resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
        stack.until(lambda: publish(stack, 20, 2000) or health(stack).state.startswith(DISK_FULL.text))
        stack.until(lambda: any(DISK_FULL.hint in line for _, line in stack.told))  # the log line may come later
        assert stack.launcher.children["recorder"].n_restarts == 0
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
        stack.until(lambda: publish(stack, 1) or health(stack).state.startswith("recording"), 60)
        publish(stack, 5)
        wait(1.2)
    found = parts(tmp_path)
    recorded = [number for path in found for number in stops(path)]
    drops = [drop for path in found for drop in Recording(path).drops]
    assert recorded == sorted(set(recorded))
    assert DISK_FULL.code in {drop.why for drop in drops} <= {DISK_FULL.code, OVERLOAD}  # where others are busy
    assert sum(drop.n for drop in drops if drop.key == "estop") + len(recorded) == recorded[-1] + 1
    assert found[0].stat().st_size <= full


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("recorder.topics=[scna]", "scna is not a topic; did you mean `scan`"),
        ("recorder.attach=[no.yaml]", "cannot read no.yaml"),
        ("recorder.split_size=9000", "over half of the budget"),
    ],
)
def test_settings_that_cannot_be_are_told_in_one_line(tmp_path, setting, words):
    with pytest.raises(UserError, match=words), recorder(tmp_path, setting):
        pass
