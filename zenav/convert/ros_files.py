# SPDX-License-Identifier: Apache-2.0
"""The files that ROS records: ROS 1 bags, rosbag2 folders, bare .mcap and .db3. Their content decides, not their name.

The `rosbags` package reads them. It refuses a file without index or metadata.yaml, or with damage. Such a file is read
from its beginning instead, message by message, and a note gives what is lost.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from shared.config import UserError
from shared.recording import Recording
from zenav.convert import ros1_rescue, sqlite_rescue

MAGICS = {
    b"#ROSBAG V": "ROS 1 bag",
    b"SQLite format 3\x00": "ROS 2 bag (sqlite3)",
    b"\x89MCAP0\r\n": "MCAP",
    b"\x28\xb5\x2f\xfd": "zstd",
}
LATEST = frozenset({"nav_msgs/msg/OccupancyGrid"})
"""Types of which the last message of a topic says all."""
ZSTD = b"\x28\xb5\x2f\xfd"
SLICE = 1 << 20  # bytes
MAX_MESSAGE = 1 << 26  # bytes of one that was compressed by itself
FREE_RATIO, FREE_BYTES = 100, 1 << 30  # a file may unpack to so many times its size, and to so many bytes at least

MAX_ERROR_LENGTH = 300  # characters of what rosbags says


class RawMessage(NamedTuple):
    """A message as it lies in a bag. received: ns, when the recorder took it."""

    topic: str
    type: str
    received: int
    data: bytes
    ros1: bool


@dataclass(slots=True)
class BagContent:
    """What was read: messages of the wanted types; every topic with its type and count; what people must know."""

    messages: list[RawMessage] = field(default_factory=list)
    topics: dict[str, tuple[str, int]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, other: "BagContent") -> None:
        """Takes in what another file of the same bag holds."""
        self.messages += other.messages
        self.notes += other.notes
        for topic, (type_, n) in other.topics.items():
            self.topics[topic] = type_, n + self.topics.get(topic, ("", 0))[1]


def kind_of(path: Path) -> str:
    """The file's format by its first bytes, or "" where they are none of MAGICS. Raises UserError."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "check the path and its permissions") from None
    if not head:
        raise UserError(f"{path} is empty", "its recorder was stopped before it wrote anything, or the copy failed")
    return next((kind for magic, kind in MAGICS.items() if head.startswith(magic)), "")


def read_bag(path: Path, wanted: frozenset[str]) -> BagContent:
    """Everything of some types (`sensor_msgs/msg/LaserScan`) in a file or a folder.

    Raises UserError where that is nothing that ROS records, or nothing in it can be read.
    """
    try:
        return _folder(path, wanted) if path.is_dir() else _file(path, wanted)
    except OSError as error:  # a file that was compressed or cut off is copied for reading
        hint = "check the disk, and the room for temporary files: the environment variable TMPDIR chooses their folder"
        raise UserError(f"cannot read {path}: {error.strerror or error}", hint) from None


def _folder(path: Path, wanted: frozenset[str]) -> BagContent:
    if (path / "metadata.yaml").is_file():
        try:
            return _by_rosbags(Reader2(path), wanted, ros1=False)
        except Exception as error:  # whatever the reader stumbles over: the files themselves may be sound
            bag = BagContent(
                notes=[f"{path.name}/metadata.yaml was not used ({_short(error)}): the files were read one by one"]
            )
    else:
        bag = BagContent(notes=[f"{path.name} has no metadata.yaml: its files were read one by one"])
    files = [file for file in sorted(path.iterdir()) if file.is_file() and file.stat().st_size and kind_of(file)]
    if not files:
        raise UserError(
            f"{path}: a folder without a bag in it", "give the folder that holds metadata.yaml and the bag's files"
        )
    for file in files:
        bag.add(_file(file, wanted))
    return bag


def _file(path: Path, wanted: frozenset[str]) -> BagContent:
    kind = kind_of(path)
    if kind in READERS:
        return _read(path, kind, wanted)
    if kind == "zstd":
        return _unpacked(path, wanted)
    raise UserError(
        f"{path} is no bag: it begins with none of their marks",
        "give a ROS 1 bag, a rosbag2 folder, or a .mcap or .db3 file",
    )


RescuedMessages = tuple[Iterable[RawMessage], list[str]]
"""Messages one by one, and what was lost, complete when they are through."""


def _read(path: Path, kind: str, wanted: frozenset[str]) -> BagContent:
    try:
        return _by_rosbags(READERS[kind](path), wanted, ros1=kind == "ROS 1 bag")
    except Exception as error:  # rosbags raises two dozen kinds on damage, from AssertionError to zlib.error
        cause = _short(error)
    messages, lost = RESCUES[kind](path)
    bag = BagContent()
    counts: Counter[tuple[str, str]] = Counter()

    def counted() -> Iterator[RawMessage]:
        for raw in messages:
            counts[raw.topic, raw.type] += 1
            if raw.type in wanted:
                yield raw

    bag.messages = _last_of_latest(counted())
    bag.topics = {topic: (type_, n) for (topic, type_), n in counts.items()}
    if not counts:
        raise UserError(f"{path}: nothing in it can be read: {'; '.join([cause, *lost])}", HINT)
    n, losses = sum(counts.values()), "; ".join(lost) or "nothing is missing"
    bag.notes.append(f"{path.name}: {cause}; read from its beginning instead: {n} messages; {losses}")
    return bag


UNPACK_HINT = "if it is a bag, unpack it yourself: unzstd FILE"
HINT = "record it again, or copy it again from where it came"


def _by_rosbags(reader: Any, wanted: frozenset[str], ros1: bool) -> BagContent:
    """Raises whatever rosbags raises."""
    reader.open()
    try:
        if not all(isinstance(name, str) for c in reader.connections for name in (c.topic, c.msgtype)):
            raise ValueError("a topic without its name")
        topics = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        chosen = [c for c in reader.connections if c.msgtype in wanted]
        rows = reader.messages(chosen) if chosen else ()
        messages = _last_of_latest(RawMessage(c.topic, c.msgtype, t, _plain(bytes(data)), ros1) for c, t, data in rows)
        if not all(isinstance(raw.received, int) for raw in messages):
            raise ValueError("a message without its time")
    finally:
        with suppress(Exception):
            reader.close()
    return BagContent(messages, topics)


def _last_of_latest(messages: Iterable[RawMessage]) -> list[RawMessage]:
    """All messages; of LATEST, the last of each topic."""
    others: list[RawMessage] = []
    last: dict[str, RawMessage] = {}
    for raw in messages:
        if raw.type in LATEST:
            last[raw.topic] = raw
        else:
            others.append(raw)
    return others + list(last.values())


def _short(error: Exception) -> str:
    text = " ".join(str(error).split()).rstrip(".")
    return text[:MAX_ERROR_LENGTH] if text else f"its index makes no sense ({type(error).__name__})"


def _plain(data: bytes) -> bytes:
    """A message that was compressed by itself (rosbag2's mode `message`), unpacked; no CDR begins so."""
    if not data.startswith(ZSTD):
        return data
    with suppress(zstandard.ZstdError, MemoryError):
        if zstandard.frame_content_size(data) > MAX_MESSAGE:  # it decides how much is allocated
            return data
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_MESSAGE)
    return data


def _unpacked(path: Path, wanted: frozenset[str]) -> BagContent:
    """A file that was compressed as a whole (rosbag2's mode `file`), read as far as it unpacks."""
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / path.stem
        with path.open("rb") as source, plain.open("wb") as target, suppress(zstandard.ZstdError):
            for piece in zstandard.ZstdDecompressor().read_to_iter(source, read_size=SLICE):
                target.write(piece)
                if target.tell() > max(FREE_BYTES, FREE_RATIO * path.stat().st_size):
                    raise UserError(f"{path}: unpacks to over {FREE_RATIO} times its size", UNPACK_HINT)
        if plain.stat().st_size == 0 or kind_of(plain) in ("", "zstd"):
            raise UserError(f"{path}: what is compressed in it is no bag", HINT)
        return _file(plain, wanted)


def _rescued_ros1(path: Path) -> RescuedMessages:
    messages, lost = ros1_rescue.rescue_messages(path)
    return (RawMessage(topic, _normal(type_), received, data, True) for topic, type_, received, data in messages), lost


def _rescued_mcap(path: Path) -> RescuedMessages:
    lost: list[str] = []

    def messages() -> Iterator[RawMessage]:
        foreign: Counter[str] = Counter()
        recording = Recording(path)
        for entry in recording.entries():
            encoding = entry.channel.encoding
            if encoding in ("cdr", "ros1"):
                type_ = _normal(entry.channel.schema_name)
                yield RawMessage(entry.key, type_, entry.log_time, _plain(entry.payload), encoding == "ros1")
            else:
                foreign[encoding] += 1
        lost.extend(f"{n} messages are {encoding or 'of no encoding'}, not ROS's" for encoding, n in foreign.items())
        lost.extend(recording.problems)

    return messages(), lost


def _normal(type_: str) -> str:
    package, _, name = type_.partition("/")
    return type_ if "/" in name or not name else f"{package}/msg/{name}"


def _rescued_sqlite(path: Path) -> RescuedMessages:
    messages, lost = sqlite_rescue.rescue_messages(path)
    return (
        RawMessage(topic, _normal(type_), received, _plain(data), False) for topic, type_, received, data in messages
    ), lost


def _sqlite_reader(path: Path) -> Sqlite3Reader:
    sqlite_rescue.check(path)
    return Sqlite3Reader(path)


READERS: dict[str, Callable[[Path], Any]] = {
    "ROS 1 bag": Reader1,
    "ROS 2 bag (sqlite3)": _sqlite_reader,
    "MCAP": McapReader,
}
RESCUES: dict[str, Callable[[Path], RescuedMessages]] = {
    "ROS 1 bag": _rescued_ros1,
    "ROS 2 bag (sqlite3)": _rescued_sqlite,
    "MCAP": _rescued_mcap,
}
"""By kind: what reads a file from its beginning where its reader refuses."""
