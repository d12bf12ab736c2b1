# SPDX-License-Identifier: Apache-2.0
"""`zenav recording merge`: one recording out of several parts, or of several that were taken side by side."""

import sys
from collections import deque
from collections.abc import Iterable, Iterator
from heapq import merge as merged_by
from itertools import repeat
from pathlib import Path

from shared.config import UserError
from shared.recording import CONFIG, Drop, Entry, Recording
from shared.types import NS_PER_S
from zenav.recording.new_recording import new_recording
from zenav.recording.opening import open_recording
from zenav.recording.selection import begin_of, check_new_recording, end_of

MessageIdentity = tuple[str, bool, int, int, bytes]
"""What is alike where two recordings hold one message: key, whether it is latched, sequence, time of sending, bytes."""
MAX_TIME_APART_NS = 10 * NS_PER_S  # between what two recorders say when it came


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
        for entry, again in _with_repeats(_in_order(recordings)):
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

    A later part repeats latched messages. They are left out where the part before it is there, and has all of them.
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
        yield from merged_by(*streams, key=lambda found: found[0].log_time)


def _with_repeats(entries: Iterable[tuple[Entry, int]]) -> Iterator[tuple[Entry, bool]]:
    """Each message, and whether another recording held it: two recorders take one within a moment."""
    recent: deque[tuple[int, MessageIdentity]] = deque()
    first: dict[MessageIdentity, int] = {}
    for entry, i in entries:
        while recent and recent[0][0] < entry.log_time - MAX_TIME_APART_NS:
            first.pop(recent.popleft()[1], None)
        same = entry.key, entry.latched, entry.sequence, entry.sent, entry.payload
        yield entry, first.get(same, i) != i
        if same not in first:
            first[same] = i
            recent.append((entry.log_time, same))


def _new(recording: Recording, follows: bool) -> Iterator[Entry]:
    begin = begin_of(recording)
    missed = {drop.key for drop in recording.drops if drop.at <= begin}  # between the part before it and this one
    return (
        entry
        for entry in recording.entries(as_recorded=True)
        if not (follows and entry.latched and entry.key not in missed)
    )


def _follows(before: Recording, after: Recording) -> bool:
    a, b = before.about, after.about
    if not a.get("recording") or a.get("recording") != b.get("recording"):
        return False
    return a.get("part", "").isdigit() and b.get("part") == str(int(a["part"]) + 1)


def _attachments(recordings: list[Recording]) -> dict[str, bytes]:
    """All of them; another one of the same name has its recording's name before its own."""
    found: dict[str, bytes] = {}
    for recording in recordings:
        for name, content in recording.attachments.items():
            if found.setdefault(name, content) != content:
                found[f"{recording.path.stem}-{name}"] = content
    if CONFIG in found and f"{recordings[-1].path.stem}-{CONFIG}" in found:
        sys.stderr.write("their configurations differ: a replay takes the first one's\n")
    return found


def _drops(recordings: list[Recording]) -> list[Drop]:
    return sorted((drop for recording in recordings for drop in recording.drops), key=lambda drop: drop.at)
