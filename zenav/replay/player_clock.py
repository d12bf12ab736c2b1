# SPDX-License-Identifier: Apache-2.0
"""What a recording says on the wire again, and when: which keys, under which names, at which pace, by which clock."""

import struct
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import msgpack
from mcap.exceptions import McapError
from mcap.reader import make_reader

from shared import topics
from shared.codec import CodecError, envelope_of
from shared.config import UserError, nearest
from shared.messages import EmergencyStop, Goal, MotorCommand, Recovery, Velocity
from shared.recording import Entry, Recording
from shared.topics import TOPICS

COMMANDS = frozenset(t.key for t in TOPICS if t.type in (Velocity, MotorCommand, Goal, Recovery, EmergencyStop))
"""The keys that a robot obeys."""
MAX_SILENCE_NS = 60_000_000_000
"""A longer silence is a jump of the recorder's clock: playback skips it."""
SKIPPED_SILENCE_NS = 1_000_000_000  # ns that are waited instead
MIN_RATE, MAX_RATE = 0.01, 100.0
RATE_FACTOR = 1.1  # what a key press makes of the rate


@dataclass(frozen=True, slots=True)
class PlaybackOptions:
    """What a person asked for. start, end: s from the recording's beginning; end 0 is its end."""

    keys: str = ""
    remap: tuple[str, ...] = ()
    rate: float = 1.0
    start: float = 0.0
    end: float = 0.0
    loop: bool = False
    paused: bool = False
    now: bool = False
    commands: bool = False


@dataclass(frozen=True, slots=True)
class RecordingContents:
    """What a recording holds: first and last time of logging (ns), and the keys."""

    first: int
    last: int
    keys: tuple[str, ...]

    @property
    def seconds(self) -> float:
        return (self.last - self.first) / 1e9


def contents(recording: Recording) -> RecordingContents:
    """From the file's index, or, where it has none, by reading all of it. Raises UserError where nothing is in it."""
    recorded = _indexed(recording.path) or _read(recording)
    if not recorded.keys:
        raise UserError(f"{recording.path} holds no messages", "name another recording")
    return recorded


def _indexed(path: Path) -> RecordingContents | None:
    try:
        with path.open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
    except (McapError, OSError, ValueError, OverflowError, MemoryError, struct.error, KeyError):  # damage
        return None
    statistics = summary.statistics if summary is not None else None
    if summary is None or statistics is None or not statistics.message_count:
        return None
    counts = statistics.channel_message_counts
    keys = {channel.topic for number, channel in summary.channels.items() if counts.get(number)}
    return RecordingContents(statistics.message_start_time, statistics.message_end_time, tuple(sorted(keys)))


def _read(recording: Recording) -> RecordingContents:
    keys, first, last = set[str](), None, 0
    for entry in recording.entries():
        keys.add(entry.key)
        first = entry.log_time if first is None else min(first, entry.log_time)
        last = max(last, entry.log_time)
    return RecordingContents(first or 0, last, tuple(sorted(keys)))


def selected_keys(text: str, keys: Iterable[str]) -> list[str]:
    """Which keys are meant by `scan,odom,health`, where a family stands for all of its keys; all where it is empty.

    Raises UserError on a word that means none.
    """
    there = sorted(keys)
    if not text:
        return there
    selected = dict[str, None]()
    for word in filter(None, text.split(",")):
        matching = [key for key in there if key == word or key.startswith(f"{word}/")]
        if not matching:
            raise UserError(f"the recording has no topic {word}", nearest(word, tuple(there)))
        selected |= dict.fromkeys(matching)
    return list(selected)


def renamed_keys(assignments: Iterable[str], keys: Iterable[str]) -> dict[str, str]:
    """By key, the key that it is played as: from words like `scan=scan/rear`. Raises UserError."""
    names, there = dict[str, str](), tuple(keys)
    for assignment in assignments:
        old, equals, new = assignment.partition("=")
        if not equals or not new or new.strip("/") != new or set(new) & set("*$?# ") or "//" in new:
            raise UserError(f"{assignment!r} renames nothing", "write OLD=NEW, like --remap scan=scan/rear")
        if old not in there:
            raise UserError(f"--remap {assignment}: {old} is not played", nearest(old, there))
        before, after = topics.topic_of(old), topics.topic_of(new)
        if before is not None and after is not None and before.type is not after.type:
            what = f"{old} carries {before.type.__name__}, {new} {after.type.__name__}"
            raise UserError(what, "choose a key that carries the same, or one that no service knows")
        names[old] = new
    return names


def silences(recording: Recording, first: int) -> list[tuple[int, int]]:
    """Where the recorder's clock jumped: (last time of logging before, first one after), ns, in their order.

    first: ns, of the recording. All topics count. Only blocks that may hold a jump are read.
    """
    found: list[tuple[int, int]] = []
    latest = first
    for block in recording.blocks:
        if block.end - latest <= MAX_SILENCE_NS:
            latest = max(latest, block.end)
            continue
        for entry in recording.entries_of(block, as_recorded=True):
            if entry.log_time - latest > MAX_SILENCE_NS:
                found.append((latest, entry.log_time))
            latest = max(latest, entry.log_time)
    return found


def timed_entries(
    entries: Iterable[Entry], first: int, jumps: Sequence[tuple[int, int]], notes: list[str]
) -> Iterator[tuple[int, Entry]]:
    """Each entry with its place: ns since the recording's beginning, never backwards, silences shortened.

    jumps: as from `silences`.   notes: gets a line for each that was shortened.
    """
    latest, passed, left = first, 0, deque(jumps)
    for entry in entries:
        latest = max(latest, entry.log_time)
        while left and latest >= left[0][1]:
            begin, end = left.popleft()
            place = (begin - first - passed) / 1e9
            notes.append(f"{(end - begin) / 1e9:.0f} s of silence at {place:.1f} s are passed over")
            passed += end - begin - SKIPPED_SILENCE_NS
        within = max(latest - left[0][0] - SKIPPED_SILENCE_NS, 0) if left else 0  # logged before the clock jumped back
        yield latest - first - passed - within, entry


class Playhead:
    """Where playing is. Places are ns since the recording's beginning, `now` is ns on a clock that never jumps."""

    def __init__(self, now: int, rate: float = 1.0, paused: bool = False, place: int = 0) -> None:
        self._now, self._place = now, place
        self.rate, self.paused = rate, paused

    def place(self, now: int) -> int:
        """The place that playing has reached at `now`."""
        return self._place if self.paused else self._place + round((now - self._now) * self.rate)

    def wait(self, place: int, now: int) -> float:
        """s until this place is reached; infinite while it is paused."""
        return inf if self.paused else (place - self.place(now)) / 1e9 / self.rate

    def due(self, place: int) -> int:
        """When (ns) this place was or will be reached, unless somebody pauses or changes the rate before."""
        return self._now + round((place - self._place) / self.rate)

    def set_rate(self, now: int, rate: float | None = None, paused: bool | None = None) -> None:
        """From now on at another rate, or paused or not."""
        self._place, self._now = self.place(now), now
        self.rate = self.rate if rate is None else min(max(rate, MIN_RATE), MAX_RATE)
        self.paused = self.paused if paused is None else paused

    def step_to(self, place: int, now: int) -> None:
        """Right to this place, which is now."""
        self._place, self._now = place, now


def restamped(payload: bytes, later: int, life: str) -> bytes:
    """A message's bytes with its two times, `stamp` and `sent`, `later` ns later, in a session of its own.

    life: is added to the session's name. All else stays to the bit. Raises CodecError where it is no message.
    """
    publisher, session, sequence, sent = envelope_of(payload)
    tree: dict[str, Any] = msgpack.unpackb(payload)
    tree["@"] = (publisher, f"{session}{life}", sequence, sent + later)
    if type(tree.get("stamp")) is not int:
        raise CodecError("stamp: missing")
    tree["stamp"] += later
    return bytes(msgpack.packb(tree))
