# SPDX-License-Identifier: Apache-2.0
"""`zenav recording repair|trim|merge`: a new recording out of old ones. Bytes of messages are never changed."""

import os
import sys
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from heapq import merge as merged_by
from itertools import repeat
from pathlib import Path

from shared.config import UserError
from shared.recording import CONFIG, Drop, Entry, Recording, Writer
from shared.recordings.latched_state import LatchedState
from shared.recordings.reader import LATCHED
from shared.types import NS_PER_S
from zenav.recording.opening import open_recording
from zenav.recording.selection import OUT_HINT, begin_of, check_new_recording, end_of, keys_in, time_range

Same = tuple[str, bool, int, int, bytes]
"""What is alike where two recordings hold one message: key, whether it is latched, sequence, time of sending, bytes."""
APART = 10 * NS_PER_S  # at most, between what two recorders say when it came


@contextmanager
def new_recording(
    out: Path, source: Recording, about: dict[str, str], attachments: dict[str, bytes]
) -> Iterator[Writer]:
    """A copy of another recording that takes its name when it is whole. Raises UserError where the disk refuses."""
    part = out.with_name(f"{out.name}.writing")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with Writer(part, about, attachments, profile=source.profile) as writer:
            for name, values in source.metadata:
                writer.note(name, values)
            yield writer
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(out)
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", OUT_HINT) from None
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


# --- repair ---------------------------------------------------------------------------------------------------------


def repair(path: Path, out: Path | None) -> int:
    """Gives a recording that was not closed, or is damaged, its index back; in its place, or into `out`.

    Where something is lost, the damaged file stays beside it as NAME.damaged. 1 where something is lost.
    """
    recording = open_recording(path)
    if out is not None:
        check_new_recording(out, path)
    n = 0
    to = out or path.with_name(f"{path.name}.repaired")
    with new_recording(to, recording, recording.about, recording.attachments) as writer:
        writer.note_drops(recording.drops)
        for entry in recording.entries(as_recorded=True):
            writer.copy(entry)
            n += 1
    lost = bool(recording.damage)
    if out is None:
        _take_place(path, lost)
    sys.stdout.write(f"{out or path}: {n} messages, with an index\n")
    for problem in recording.problems:
        sys.stderr.write(f"{problem}\n")
    if lost:
        loss = f"{recording.n_lost} messages are known to be lost" if recording.n_lost else "something is lost"
        backup = "" if out else f"; the damaged file is {path}.damaged"
        sys.stderr.write(f"{loss}{backup}\n")
    return 1 if lost else 0


def _take_place(path: Path, lost: bool) -> None:
    repaired = path.with_name(f"{path.name}.repaired")
    try:
        if lost:
            os.link(path, _free(path.with_name(f"{path.name}.damaged")))
        repaired.replace(path)
    except OSError as error:
        raise UserError(f"cannot replace {path}: {error.strerror}", f"the repaired one is {repaired}") from None


def _free(path: Path) -> Path:
    """The path, or the first of its like that is not taken."""
    n, free = 1, path
    while free.exists():
        n, free = n + 1, path.with_name(f"{path.name}-{n + 1}")
    return free


# --- trim -----------------------------------------------------------------------------------------------------------


def trim(path: Path, out: Path, begin: float | None, end: float | None, patterns: list[str]) -> int:
    """Writes the part from `begin` to `end` (s since the start), of all topics or some, so that it still replays.

    The part keeps the configuration, the latched messages of its beginning, and the journals. A journal comes once a
    second, for the second before it. So the rest of the last second is written, but does not replay.
    """
    check_new_recording(out, path)
    recording = open_recording(path)
    keys = keys_in(recording, patterns)
    since, until = time_range(recording, begin, end)
    first = begin_of(recording) if since is None else since
    latched, n = LatchedState(), 0
    about = recording.about | {"trimmed": f"{(first - begin_of(recording)) / NS_PER_S:g} s on, from {path.name}"}
    with new_recording(out, recording, about, recording.attachments) as writer:
        writer.note_drops(drop for drop in recording.drops if first <= drop.at and (until is None or drop.at < until))
        begun = since is None
        for entry in recording.entries(as_recorded=True):
            if keys is not None and entry.key not in keys and not entry.key.startswith("journal/"):
                continue
            if not begun and entry.log_time >= first:
                begun = True
                n += _begin(writer, latched, first, recording)
            if not begun:
                latched.take(entry.key, entry.payload)
            elif until is None or entry.log_time < until:
                writer.copy(entry)
                n += 1
    sys.stdout.write(f"{out}: {n} messages, {out.stat().st_size / 1e6:.1f} MB\n")
    for problem in recording.problems:
        sys.stderr.write(f"{problem}\n")
    return 0


def _begin(writer: Writer, latched: LatchedState, at: int, recording: Recording) -> int:
    """Writes what was latched at `at` (ns), each with the schema that it was recorded with."""
    channels = {source.recorded.key: source.recorded for source in recording.sources.values()}
    values = latched.values()
    for value in values:
        channel = replace(channels[value.key], metadata=(LATCHED,))
        writer.copy(Entry(channel, at, value.envelope.sent, value.envelope.sequence, value.payload))
    return len(values)


# --- merge ----------------------------------------------------------------------------------------------------------


def merge(paths: list[Path], out: Path) -> int:
    """One recording out of several: parts one after the other; those that were taken side by side by their times.

    What two of them hold is there once.
    """
    if len(paths) < 2:
        raise UserError("merging takes two recordings or more", "zenav recording merge A.mcap B.mcap --out C.mcap")
    for path in paths:
        check_new_recording(out, path)
    recordings = sorted((open_recording(path) for path in paths), key=begin_of)
    robots = dict.fromkeys(name for r in recordings if (name := r.about.get("robot")))
    if len(robots) > 1:
        raise UserError(f"these are recordings of {' and '.join(robots)}", "merge those of one robot")
    about = {name: text for name, text in recordings[0].about.items() if name not in ("part", "recording")}
    about["merged"] = ", ".join(recording.path.name for recording in recordings)
    n = n_twice = 0
    with new_recording(out, recordings[0], about, _attachments(recordings)) as writer:
        writer.note_drops(_drops(recordings))
        for entry, again in _known(_in_order(recordings)):
            if again:
                n_twice += 1
            else:
                writer.copy(entry)
                n += 1
    if n_twice:
        sys.stderr.write(f"{n_twice} messages stood in two of them\n")
    sys.stdout.write(f"{out}: {n} messages, {out.stat().st_size / 1e6:.1f} MB\n")
    for recording in recordings:
        for problem in recording.problems:
            sys.stderr.write(f"{recording.path}: {problem}\n")
    return 0


def _in_order(recordings: list[Recording]) -> Iterator[tuple[Entry, int]]:
    """The messages of all recordings, each with its recording's index.

    A later part repeats latched messages. They are left out where the part before it is there.
    """
    streams: list[Iterable[tuple[Entry, int]]] = []
    ends, alone = [end_of(recording) for recording in recordings], True
    for i, recording in enumerate(recordings):
        alone &= i == 0 or begin_of(recording) >= ends[i - 1]
        streams.append(zip(_new(recording, _follows(recordings[i - 1], recording) if i else False), repeat(i)))
    if alone:
        for stream in streams:
            yield from stream
    else:
        yield from merged_by(*streams, key=lambda item: item[0].log_time)


def _known(entries: Iterable[tuple[Entry, int]]) -> Iterator[tuple[Entry, bool]]:
    """Each message, and whether another recording held it: two recorders take one within a moment."""
    recent: deque[tuple[int, Same]] = deque()
    first: dict[Same, int] = {}
    for entry, i in entries:
        while recent and recent[0][0] < entry.log_time - APART:
            first.pop(recent.popleft()[1], None)
        same = entry.key, entry.latched, entry.sequence, entry.sent, entry.payload
        yield entry, first.get(same, i) != i
        if same not in first:
            first[same] = i
            recent.append((entry.log_time, same))


def _new(recording: Recording, follows: bool) -> Iterator[Entry]:
    return (entry for entry in recording.entries(as_recorded=True) if not (follows and entry.latched))


def _follows(before: Recording, after: Recording) -> bool:
    a, b = before.about, after.about
    if not a.get("recording") or a.get("recording") != b.get("recording"):
        return False
    return a.get("part", "").isdigit() and b.get("part") == str(int(a["part"]) + 1)


def _attachments(recordings: list[Recording]) -> dict[str, bytes]:
    """All of them; another one of the same name has its recording's name before its own."""
    attachments: dict[str, bytes] = {}
    for recording in recordings:
        for name, content in recording.attachments.items():
            if attachments.setdefault(name, content) != content:
                attachments[f"{recording.path.stem}-{name}"] = content
    if CONFIG in attachments and f"{recordings[-1].path.stem}-{CONFIG}" in attachments:
        sys.stderr.write("their configurations differ: a replay takes the first one's\n")
    return attachments


def _drops(recordings: list[Recording]) -> list[Drop]:
    return sorted((drop for recording in recordings for drop in recording.drops), key=lambda drop: drop.at)
