# SPDX-License-Identifier: Apache-2.0
"""`zenav recording info`: what a recording holds, how regularly, and what is wrong with it.

An hour's file takes part of a second: counts come from its index, silences from the log_times that stand beside each
chunk. A file without an index is read from begin to end.
"""

import json
import sys
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from shared import topics
from shared.config import UserError
from shared.migrations import MIGRATIONS
from shared.recording import Recording
from shared.recordings.frames import indexes_after
from shared.types import NS_PER_S, Int64s
from zenav.console.table import show_table
from zenav.recording.opening import open_recording
from zenav.recording.selection import begin_of, end_of

PERIODS, MIN_GAP_S = 5, 1.0  # a silence is a gap from so many of the topic's periods, and so many s
LAST = 2**63 - 1  # ns: what claims to be later is damage, or a clock's
_ROWS = np.dtype([("channel", "<u2"), ("place", "<u8")])


@dataclass
class TopicInfo:
    """One key. gaps: silences longer than its rate explains, how many and the longest in s."""

    key: str
    type: str
    n: int = 0
    hz: float = 0.0
    expected_hz: float = 0.0
    gaps: int = 0
    longest_gap: float = 0.0
    missed: int = 0
    note: str = ""


@dataclass
class RecordingInfo:
    """The result of `info`. Times in s; begin: ns on the stack's clock."""

    path: str
    size: int
    begin: int
    seconds: float
    messages: int
    indexed: bool
    about: dict[str, str]
    attachments: dict[str, int]
    parts: list[str]
    topics: list[TopicInfo] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def show_info(paths: list[Path], as_json: bool) -> int:
    """Writes what each recording holds; 1 where something is wrong with one."""
    rows = [recording_info(path) for path in paths]
    for row in rows:
        if as_json:
            sys.stdout.write(json.dumps(asdict(row)) + "\n")
        else:
            _write(row)
    return 1 if any(row.problems for row in rows) else 0


def recording_info(path: Path) -> RecordingInfo:
    """The summary of a recording. Raises UserError where the file is none."""
    recording = open_recording(path)
    rows = {source.recorded.key: TopicInfo(source.recorded.key, "") for source in recording.sources.values()}
    if recording.statistics is not None:
        times = _by_index(recording, rows)
    else:
        times = _by_reading(recording, rows)
    _name(recording, rows)
    end = end_of(recording)
    for key, row in rows.items():
        topic = topics.topic_of(key)
        row.expected_hz = topic.hz if topic else 0.0
        row.hz, row.gaps, row.longest_gap = times.get(key, Silences()).summary(row.n, row.expected_hz, end)
        row.missed = sum(drop.n for drop in recording.drops if drop.key == key)
    begin = begin_of(recording)
    return RecordingInfo(
        path=str(path),
        size=path.stat().st_size,
        begin=begin,
        seconds=(end - begin) / NS_PER_S,
        messages=sum(row.n for row in rows.values()),
        indexed=recording.indexed,
        about=recording.about,
        attachments={name: len(data) for name, data in recording.attachments.items()},
        parts=_parts(recording),
        topics=sorted(rows.values(), key=lambda row: row.key),
        problems=recording.problems,
    )


@dataclass
class Silences:
    """First and last log_time of a key, and every silence of MIN_GAP_S or more, (from, to) in ns."""

    first: int = 0
    last: int = 0
    long: list[tuple[int, int]] = field(default_factory=list)

    def summary(self, n: int, expected: float, end: int) -> tuple[float, int, float]:
        """Rate, and number and length of its gaps; nothing for a topic without a rate."""
        seconds = (self.last - self.first) / NS_PER_S
        hz = (n - 1) / seconds if n > 1 and seconds > 0 else 0.0
        if not expected or not n:
            return hz, 0, 0.0
        gaps = [(b - a) / NS_PER_S for a, b in (*self.long, (self.last, end))]
        gaps = [gap for gap in gaps if gap > max(PERIODS / expected, MIN_GAP_S)]
        return hz, len(gaps), max(gaps, default=0.0)


def _by_index(recording: Recording, rows: dict[str, TopicInfo]) -> dict[str, Silences]:
    """Message counts and silences of each key, without reading a message."""
    statistics, blocks, silences_by_key = recording.statistics, recording.blocks, dict[str, Silences]()
    counts = statistics.channel_message_counts if statistics else {}
    for number, source in recording.sources.items():
        if not source.recorded.latched:
            rows[source.recorded.key].n += counts.get(number, 0)
    if any(block.channels is None for block in blocks):
        return silences_by_key
    begins = np.array([min(block.begin, LAST) for block in blocks], np.int64)
    ends = np.array([min(block.end, LAST) for block in blocks], np.int64)
    channels = np.frombuffer(b"".join(block.channels or b"" for block in blocks), _ROWS)["channel"]
    sizes = np.array([len(block.channels or b"") // _ROWS.itemsize for block in blocks], np.int64)
    holders = np.repeat(np.arange(len(blocks)), sizes)
    with recording.path.open("rb") as file:
        read: dict[int, dict[int, bytes]] = {}

        def times(block: int, number: int) -> Int64s:
            if block not in read:
                read[block] = indexes_after(file, blocks[block])
            return np.sort(np.frombuffer(read[block].get(number, b""), np.int64)[::2])

        for number, source in recording.sources.items():
            at = holders[channels == number]
            if not len(at) or source.recorded.latched:
                continue
            topic = topics.topic_of(source.recorded.key)
            min_gap = max(PERIODS / topic.hz, MIN_GAP_S) * NS_PER_S if topic and topic.hz else np.inf
            ahead, behind = times(int(at[0]), number), times(int(at[-1]), number)
            if not len(ahead) or not len(behind):
                continue
            silences = silences_by_key.setdefault(source.recorded.key, Silences(int(ahead[0]), int(behind[-1])))
            silences.first, silences.last = min(silences.first, int(ahead[0])), max(silences.last, int(behind[-1]))
            # the chunks' whole lengths lie between them: what speaks in both may have been silent for so long
            for i in np.flatnonzero(ends[at[1:]] - begins[at[:-1]] > min_gap).tolist():
                pair = np.append(times(int(at[i]), number)[-1:], times(int(at[i + 1]), number)[:1])
                silences.long += _between(pair, min_gap)
            for block in at[ends[at] - begins[at] > min_gap].tolist():
                silences.long += _between(times(block, number), min_gap)
    return silences_by_key


def _by_reading(recording: Recording, rows: dict[str, TopicInfo]) -> dict[str, Silences]:
    stamps: dict[str, list[int]] = {}
    for entry in recording.entries(as_recorded=True):
        stamps.setdefault(entry.key, [])
        if not entry.latched:
            stamps[entry.key].append(entry.log_time)
    silences_by_key = {}
    for key, times in stamps.items():
        rows.setdefault(key, TopicInfo(key, "")).n = len(times)
        if times:
            sorted_times = np.sort(np.array([min(time, LAST) for time in times], np.int64))
            long = _between(sorted_times, MIN_GAP_S * NS_PER_S)
            silences_by_key[key] = Silences(int(sorted_times[0]), int(sorted_times[-1]), long)
    return silences_by_key


def _between(times: Int64s, min_gap: float) -> list[tuple[int, int]]:
    """The silences between sorted times that are longer than `min_gap`, ns."""
    where = np.flatnonzero(np.diff(times) > min_gap)
    return [(int(times[i]), int(times[i + 1])) for i in where]


def _name(recording: Recording, rows: dict[str, TopicInfo]) -> None:
    """Types, and what this version makes of them."""
    for source in recording.sources.values():
        key, name = source.recorded.key, source.recorded.schema_name
        row = rows.setdefault(key, TopicInfo(key, ""))  # of a file that was cut off: perhaps without a message
        row.type = name.rpartition("-")[0] or name
        if name in MIGRATIONS:
            row.note = "old: migrated when it is read"
        elif source.refused:
            row.note = "another version's: this one cannot read it"
        elif topics.topic_of(row.key) is None:
            row.note = "no topic of this version"


def _parts(recording: Recording) -> list[str]:
    """The names of the files beside it that are parts of the same recording, in order; itself among them."""
    name, number = recording.about.get("recording"), recording.about.get("part", "")
    if not name or not number.isdigit():
        return []
    names = {int(number): recording.path.name}
    for path in recording.path.parent.glob(f"{_plain(name)}*{recording.path.suffix}"):
        if path.name == recording.path.name:
            continue
        try:
            about = Recording(path).about
        except UserError:
            continue
        if about.get("recording") == name and about.get("part", "").isdigit():
            names[int(about["part"])] = path.name
    return [names[n] for n in sorted(names)] if len(names) > 1 else []


def _plain(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def _write(info: RecordingInfo) -> None:
    about = dict(info.about)
    lines = {
        "recording": f"{info.path}, {info.size / 1e6:.1f} MB, {info.seconds:.1f} s, {info.messages} messages",
        "recorded": _date(info.begin),
        "robot": about.pop("robot", ""),
        "commit": about.pop("commit", ""),
        "machine": ", ".join(about.pop(name) for name in ("host", "processor", "libc") if name in about),
        "part": f"{about.pop('part', '')} of {', '.join(info.parts)}" if info.parts else about.pop("part", "") and "",
        "attached": ", ".join(f"{name} ({size} bytes)" for name, size in info.attachments.items()),
        "index": "" if info.indexed else "none: zenav recording repair makes it",
    }
    lines["made from"] = "; ".join(about.pop(name) for name in ("merged", "trimmed") if name in about)
    for name in ("recording", "replayed"):
        about.pop(name, None)
    lines["versions"] = ", ".join(f"{name} {value}" for name, value in about.items())
    for name, text in lines.items():
        if text:
            sys.stdout.write(f"{name:<10} {text}\n")
    for problem in info.problems:
        sys.stdout.write(f"{'problem':<10} {problem}\n")
    columns = ["topic", "type", "messages", "Hz", "expected", "gaps", "longest, s", "missed", ""]
    rows = [
        [
            row.key, row.type, str(row.n), f"{row.hz:.1f}" if row.hz else "-",
            f"{row.expected_hz:g}" if row.expected_hz else "-", str(row.gaps or "-"),
            f"{row.longest_gap:.1f}" if row.gaps else "-", str(row.missed or "-"), row.note,
        ]
        for row in info.topics
    ]  # fmt: skip
    show_table("", columns if any(row.note for row in info.topics) else columns[:-1], info_rows(rows, info))


def _date(ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(ns / NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC" if ns else ""
    except (ValueError, OverflowError, OSError):
        return f"{ns} ns, which no calendar has"


def info_rows(rows: list[list[str]], info: RecordingInfo) -> list[list[Any]]:
    """The table's rows, without the column of notes where all are empty."""
    return rows if any(row.note for row in info.topics) else [row[:-1] for row in rows]
