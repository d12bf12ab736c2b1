# SPDX-License-Identifier: Apache-2.0
"""Reader of recordings: the messages in the order of recording, also of a damaged file."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import IO

import mcap.records as mc
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from shared import topics
from shared.codec import CodecError, decode
from shared.config import UserError
from shared.messages import Journal
from shared.migrations import MIGRATIONS, unknown_version
from shared.recordings.frames import (
    DAMAGE,
    FRAME,
    MAGIC,
    MESSAGE,
    Block,
    Layout,
    layout,
    messages_in,
    records_of,
)
from shared.runners.journal import Life, events_of
from shared.schema import schema, schema_id
from shared.topics import SERVICES, key_of

CONFIG = "config.yaml"
"""The attachment with the effective configuration."""
ABOUT = "zenav"
"""The metadata record with robot, versions and commit."""
DROPS = "zenav.drops"
"""The metadata records with the messages that the recorder missed."""
LATCHED = ("latched", "yes")
"""Entry in the metadata of a channel of latched values."""
ENCODING = "zenav"
"""Encoding of the schemas that this stack writes."""


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel: the key without the robot's name, and the encoding of its messages.

    `latched`: contains values for late subscribers from before the file began, not publications of its time.
    """

    key: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    metadata: tuple[tuple[str, str], ...] = ()

    @property
    def latched(self) -> bool:
        return LATCHED in self.metadata


@dataclass(frozen=True, slots=True)
class Entry:
    """One recorded message. Times in ns on the stack's clock."""

    channel: Channel
    log_time: int
    sent: int
    sequence: int
    payload: bytes

    @property
    def key(self) -> str:
        return self.channel.key

    @property
    def latched(self) -> bool:
        """A value for late subscribers from before the file began: see Channel."""
        return self.channel.latched


@dataclass(frozen=True, slots=True)
class Drop:
    """`n` missed messages of one session on one key, from sequence `first` on. at: ns, time of the discovery."""

    at: int
    why: str
    key: str
    session: str
    first: int
    n: int


@dataclass(frozen=True, slots=True)
class Source:
    """A channel and its migrated form. refused: why this version cannot read it, else empty."""

    recorded: Channel
    channel: Channel
    change: Callable[[bytes], bytes] | None = None
    refused: str = ""


class Recording:
    """An open recording. Of a damaged file it gives the undamaged messages, and `problems`.

    - about: metadata of this stack, as robot and versions; metadata: that of other programs.
    - attachments: by name.   drops: messages that the recorder missed.
    - indexed: whether the index is complete, so that seeking and counting need no reading.
    - n_lost: known number of lost messages, complete when `problems` is.

    Raises UserError where the file is missing, empty or no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.drops: list[Drop] = []
        self.n_lost = 0
        self._problems: dict[int, str] = {}  # by place in the file, so that each is listed once
        self._schemas: dict[int, mc.Schema] = {}
        self._sources: dict[int, Source] = {}
        try:
            with path.open("rb") as file:
                self._layout = self._opened(file)
        except OSError as error:
            raise UserError(f"cannot read {path}: {error.strerror}", "check the path and its permissions") from None
        self._problems |= self._layout.problems
        self._harmless = set(self._layout.harmless)
        self.indexed = self._layout.statistics is not None
        for opcode, body, place in self._layout.notes:
            self._note(opcode, body, place)
        self._note_drops()

    @property
    def problems(self) -> list[str]:
        """Damaged or missing parts, as far as the file was read: complete after `entries` ran to its end."""
        return [text for _, text in sorted(self._problems.items())]

    @property
    def damage(self) -> list[str]:
        """The problems that lose recorded data."""
        return [text for place, text in sorted(self._problems.items()) if place not in self._harmless]

    @property
    def profile(self) -> str:
        """The profile in the header: the program that the file is for."""
        return self._layout.profile

    @property
    def blocks(self) -> list[Block]:
        """The blocks with its messages, in order."""
        return self._layout.blocks

    @property
    def sources(self) -> dict[int, Source]:
        """The channels by number; complete where it is `indexed`, else as far as it was read."""
        return self._sources

    @property
    def statistics(self) -> mc.Statistics | None:
        """The index's own, where it is `indexed`."""
        return self._layout.statistics

    def entries(
        self,
        keys: Iterable[str] | None = None,
        begin: int | None = None,
        end: int | None = None,
        as_recorded: bool = False,
    ) -> Iterator[Entry]:
        """The messages of some keys, or of all, in the order in which they were recorded.

        begin, end: ns, the log_times from `begin` to before `end`.   as_recorded: with their own schemas, else old ones
        are migrated to today's. Raises UserError at a message of this stack in a newer version.
        """
        wanted = None if keys is None else frozenset(keys)
        since, until = 0 if begin is None else begin, 2**64 if end is None else end
        numbers = {n for n, source in self._sources.items() if wanted is None or source.channel.key in wanted}
        with self.path.open("rb") as file:
            for block in self._layout.blocks:
                if block.end < since or block.begin >= until or not (wanted is None or block.holds(numbers)):
                    continue
                timed = block.begin < since or block.end >= until
                for entry in self._messages(self._records(file, block), block, wanted, as_recorded):
                    if not timed or since <= entry.log_time < until:
                        yield entry

    def entries_of(self, block: Block, keys: Iterable[str] | None = None, as_recorded: bool = False) -> list[Entry]:
        """The messages of some keys, or of all, in one of its `blocks`; none where that is damaged. As `entries`."""
        wanted = None if keys is None else frozenset(keys)
        with self.path.open("rb") as file:
            return list(self._messages(self._records(file, block), block, wanted, as_recorded))

    def lives(self) -> dict[str, list[Life]]:
        """By service, its sessions in the order in which they began, each with the events of its journals."""
        parts: dict[tuple[str, str], list[Journal]] = {}
        names = {key_of(topics.JOURNAL, name): name for name in SERVICES}
        for entry in self.entries(names):
            try:
                journal, _ = decode(Journal, entry.payload)
            except CodecError:
                continue  # a hole, reported where its events are missing
            parts.setdefault((names[entry.key], journal.session), []).append(journal)
        lives: dict[str, list[Life]] = {}
        for (name, session), journals in parts.items():
            lives.setdefault(name, []).append(Life(name, session, events_of(journals)))
        return lives

    def _opened(self, file: IO[bytes]) -> Layout:
        size = file.seek(0, 2)
        file.seek(0)
        if size == 0:
            hint = "its recorder was stopped before it wrote anything: record again"
            raise UserError(f"{self.path} is empty", hint)
        if file.read(len(MAGIC)) != MAGIC:
            raise UserError(f"{self.path} is no MCAP file", "name a recording, like recordings/x80-*.mcap")
        return layout(file, size)

    def _note(self, opcode: int, body: bytes, place: int) -> None:
        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Opcode.METADATA:
                metadata = mc.Metadata.read(stream)
                if metadata.name == ABOUT:
                    self.about |= metadata.metadata
                elif metadata.name == DROPS:
                    self.drops += drops_from(metadata.metadata)
                else:
                    self.metadata.append((metadata.name, metadata.metadata))
            elif opcode == Opcode.ATTACHMENT:
                attachment = mc.Attachment.read(stream)
                self.attachments[attachment.name] = attachment.data
            elif opcode == Opcode.SCHEMA:
                schema = mc.Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = mc.Channel.read(stream)
                of = self._schemas.get(channel.schema_id) or mc.Schema(0, b"", "", "")
                metadata = tuple(sorted(channel.metadata.items()))
                recorded = Channel(
                    key=channel.topic,
                    encoding=channel.message_encoding,
                    schema_name=of.name,
                    schema_encoding=of.encoding,
                    schema=of.data,
                    metadata=metadata,
                )
                self._sources[channel.id] = _as_today(recorded)
        except DAMAGE as error:
            self._problems[place] = f"a record at byte {place} is damaged: {error}"

    def _messages(
        self, records: bytes, block: Block, wanted: frozenset[str] | None, as_recorded: bool
    ) -> Iterator[Entry]:
        at, n_orphans, sources = 0, 0, self._sources
        while at + FRAME.size <= len(records):
            opcode, length = FRAME.unpack_from(records, at)
            at += FRAME.size
            end = at + length
            if end > len(records) or (opcode == Opcode.MESSAGE and length < MESSAGE.size):
                self._problems[block.place] = f"the chunk at byte {block.place} breaks off inside"
                return
            if opcode == Opcode.MESSAGE:
                number, sequence, log_time, sent = MESSAGE.unpack_from(records, at)
                source = sources.get(number)
                if source is None:
                    n_orphans += 1
                elif wanted is None or source.channel.key in wanted:
                    payload = records[at + MESSAGE.size : end]
                    if as_recorded:
                        yield Entry(source.recorded, log_time, sent, sequence, payload)
                    elif source.refused:
                        self._refuse(source)
                    else:
                        if source.change is not None:
                            payload = source.change(payload)
                        yield Entry(source.channel, log_time, sent, sequence, payload)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._note(opcode, records[at:end], block.place)
            at = end
        if n_orphans and block.place not in self._problems:
            self.n_lost += n_orphans
            self._problems[block.place] = f"{n_orphans} messages at byte {block.place} belong to channels that are lost"

    def _records(self, file: IO[bytes], block: Block) -> bytes:
        """The records of a block; none where it is damaged, which is noted."""
        try:
            return records_of(file, block)
        except DAMAGE as error:
            self._lose(file, block, f"is damaged: {error}")
            return b""

    def _lose(self, file: IO[bytes], block: Block, what: str) -> None:
        """Notes a chunk that cannot be read, once."""
        if block.place in self._problems:
            return
        try:
            n = messages_in(file, block)
        except DAMAGE:
            n = None
        self.n_lost += n or 0
        loss = f"{n} messages are lost" if n is not None else "how many messages it held is not known"
        self._problems[block.place] = f"a chunk of {block.length} bytes at byte {block.place} {what}: {loss}"

    def _refuse(self, source: Source) -> None:
        commit = self.about.get("commit", "")
        hint = f"use the version that recorded it{f': commit {commit}' if commit else ''}"
        raise UserError(f"{self.path}: {source.channel.key} is of another version: {source.refused}", hint)

    def _note_drops(self) -> None:
        """Adds the drops to the problems: equal bytes are promised up to the first one."""
        places: dict[tuple[int, str], Counter[str]] = {}
        for drop in self.drops:
            places.setdefault((drop.at, drop.why), Counter())[drop.key] += drop.n
        zero = min((block.begin for block in self._layout.blocks), default=0)
        for i, ((at, why), counts) in enumerate(sorted(places.items())):
            counted = ", ".join(f"{n} {key}" for key, n in counts.most_common())
            self._harmless.add(-len(places) + i)
            self._problems[-len(places) + i] = (
                f"{(at - zero) / 1e9:.1f} s after the start the recorder had missed {counts.total()} messages "
                f"({why}): {counted}; a replay is equal to the byte up to there"
            )


def _as_today(recorded: Channel) -> Source:
    if recorded.schema_encoding != ENCODING:
        return Source(recorded, recorded)
    migration = MIGRATIONS.get(recorded.schema_name)
    if migration is None:
        refused = unknown_version(recorded.schema_name, recorded.schema)
        return Source(recorded, recorded, refused=refused)
    changed = replace(recorded, schema_name=schema_id(migration.type), schema=schema(migration.type))
    return Source(recorded, changed, migration)


def drops_from(record: dict[str, str]) -> list[Drop]:
    """The drops of a DROPS record, without lines that are not valid."""
    drops = []
    for name, value in record.items():
        key, _, session = name.partition(" ")
        first, _, n = value.partition(" ")
        if session and first.isdigit() and n.isdigit() and record.get("at", "").isdigit():
            drops.append(
                Drop(
                    at=int(record["at"]),
                    why=record.get("why", ""),
                    key=key,
                    session=session,
                    first=int(first),
                    n=int(n),
                )
            )
    return drops


def drops_record(drops: Iterable[Drop]) -> dict[str, str]:
    """A DROPS record of drops with one time and one reason."""
    record: dict[str, str] = {}
    for drop in drops:
        record |= {"at": str(drop.at), "why": drop.why, f"{drop.key} {drop.session}": f"{drop.first} {drop.n}"}
    return record
