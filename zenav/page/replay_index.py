# SPDX-License-Identifier: Apache-2.0
"""The newest message of each key at a time of a recording, from the blocks that can hold it and from no others."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import accumulate

from shared.recording import Entry, Recording
from shared.recordings.frames import Block

MAX_BLOCKS = 64
"""blocks whose messages are held: some 100 kB each."""
By = dict[str, list[Entry]]


@dataclass(slots=True)
class _Holders:
    """The blocks that hold a key, by their begin. begins, ends: ns, first and last log_time."""

    blocks: list[Block] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    last_ends: list[int] = field(default_factory=list)
    """The latest end of the blocks up to here."""


class ReplayIndex:
    """Where the messages of some keys are. begin, end: ns, first and last log_time; both 0 without a message.

    A key whose messages are another version's is left out. Times come from the index of the file. Without one, every
    message is read once, so wrong times in a damaged file do not count.
    """

    def __init__(self, recording: Recording, keys: Iterable[str]) -> None:
        self.recording = recording
        spans = _indexed_spans(recording) if recording.indexed else _read_spans(recording)
        refused = {source.recorded.key for source in recording.sources.values() if source.refused}
        self.keys = frozenset(keys) - refused
        self.begin = min((begin for begin, _, _, _ in spans), default=0)
        self.end = max((end for _, end, _, _ in spans), default=0)
        self.is_empty = not spans
        self._holders: dict[str, _Holders] = {}
        for begin, end, block, held in sorted(spans, key=lambda span: (span[0], span[2].place)):
            for key in held & self.keys:
                holders = self._holders.setdefault(key, _Holders())
                holders.blocks.append(block)
                holders.begins.append(begin)
                holders.ends.append(end)
        for holders in self._holders.values():
            holders.last_ends = list(accumulate(holders.ends, max))
        self._read: OrderedDict[Block, By] = OrderedDict()

    def newest(self, key: str, time: int) -> Entry | None:
        """The newest message of a key at or before `time` (ns); of one time the one that was recorded last."""
        holders, best, place = self._holders.get(key), None, -1
        if holders is None:
            return None
        for i in range(bisect_right(holders.begins, time) - 1, -1, -1):
            if best is not None and holders.last_ends[i] < best.log_time:
                break
            block = holders.blocks[i]
            entries = [entry for entry in self._messages(block).get(key, ()) if entry.log_time <= time]
            if not entries:
                continue
            found = max(enumerate(entries), key=lambda row: (row[1].log_time, row[0]))[1]
            if best is None or (found.log_time, block.place) > (best.log_time, place):
                best, place = found, block.place
        return best

    def between(self, key: str, begin: int, end: int) -> list[Entry]:
        """The messages of a key after `begin` until `end` (ns), by time."""
        holders = self._holders.get(key, _Holders())
        entries = [
            entry
            for i in range(bisect_right(holders.begins, end))
            if holders.ends[i] > begin
            for entry in self._messages(holders.blocks[i]).get(key, ())
            if begin < entry.log_time <= end
        ]
        return sorted(entries, key=lambda entry: entry.log_time)

    def _messages(self, block: Block) -> By:
        held = self._read.get(block)
        if held is None:
            held = self._read[block] = {}
            for entry in self.recording.entries_of(block, self.keys):
                held.setdefault(entry.key, []).append(entry)
            if len(self._read) > MAX_BLOCKS:
                self._read.popitem(last=False)
        self._read.move_to_end(block)
        return held


_Span = tuple[int, int, Block, set[str]]
"""First and last log_time (ns) of a block, and its keys."""


def _indexed_spans(recording: Recording) -> list[_Span]:
    sources = recording.sources.items()
    spans = []
    for block in recording.blocks:
        keys = {source.channel.key for number, source in sources if block.holds({number})}
        spans.append((block.begin, block.end, block, keys))
    return spans


def _read_spans(recording: Recording) -> list[_Span]:
    spans = []
    for block in recording.blocks:
        entries = recording.entries_of(block, as_recorded=True)
        if entries:
            times = [entry.log_time for entry in entries]
            spans.append((min(times), max(times), block, {entry.key for entry in entries}))
    return spans
