# SPDX-License-Identifier: Apache-2.0
"""`zenav recording trim`: a part of a recording, by time and topics."""

import sys
from dataclasses import replace
from pathlib import Path

from shared.recording import Entry, Recording, Writer
from shared.recordings.latched_state import LatchedState
from shared.recordings.reader import LATCHED
from shared.types import NS_PER_S
from zenav.recording.new_recording import new_recording
from zenav.recording.opening import open_recording
from zenav.recording.selection import begin_of, check_new_recording, keys_in, time_range


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
    held, n = LatchedState(), 0
    about = recording.about | {"trimmed": f"{(first - begin_of(recording)) / NS_PER_S:g} s on, from {path.name}"}
    with new_recording(out, recording, about, recording.attachments) as writer:
        writer.note_drops(drop for drop in recording.drops if first <= drop.at and (until is None or drop.at < until))
        begun = since is None
        for entry in recording.entries(as_recorded=True):
            if not begun and entry.log_time >= first:
                begun = True
                n += _begin(writer, held, first, recording)
            if keys is not None and entry.key not in keys and not entry.key.startswith("journal/"):
                continue
            if not begun:
                held.take(entry.key, entry.payload)
            elif until is None or entry.log_time < until:
                writer.copy(entry)
                n += 1
    sys.stdout.write(f"{out}: {n} messages, {out.stat().st_size / 1e6:.1f} MB\n")
    for problem in recording.problems:
        sys.stderr.write(f"{problem}\n")
    return 0


def _begin(writer: Writer, held: LatchedState, at: int, recording: Recording) -> int:
    """Writes what was latched at `at` (ns), each with the schema that it was recorded with."""
    channels = {source.recorded.key: source.recorded for source in recording.sources.values()}
    values = held.values()
    for value in values:
        channel = replace(channels[value.key], metadata=(LATCHED,))
        writer.copy(Entry(channel, at, value.envelope.sent, value.envelope.sequence, value.payload))
    return len(values)
