# SPDX-License-Identifier: Apache-2.0
"""A recording with Foxglove's schemas: an MCAP file that Foxglove and Lichtblick open. See zenav/foxglove/schemas.py.

The schemas and the bytes of their messages are foxglove-sdk's. The `mcap` package writes the file: the SDK's own writer
does not raise when the disk is full.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, cast

import mcap.writer

from shared import topics
from shared.codec import CodecError, decode
from shared.config import Robot, UserError
from shared.recording import Recording
from shared.topics import topic_of
from zenav.foxglove.schemas import MAP_ROW, MapPicture, MessageContext, SchemaRow, encode_message, encoding_of, rows_of
from zenav.recording.opening import recorded_robot_file

_CHUNK_BYTES = 1024 * 1024
_PROGRESS_EVERY = 1000  # messages


def to_foxglove(recording: Recording, out: Path, progress: Callable[[float], None]) -> tuple[Counter[str], list[str]]:
    """Writes the recording with Foxglove's schemas; counts by topic, and what was left out or is damaged, in lines.

    Log times are kept, and the times of sending. progress: gets the share that is done, 0 to 1. `out` appears when it
    is whole. Raises UserError where it cannot be written, or the recording holds nothing of this stack.
    """
    if out.exists() and out.samefile(recording.path):
        raise UserError(f"{out} is the recording itself", "choose another name")
    file = recorded_robot_file(recording)
    partial = out.with_name(f".{out.name}.part")
    try:
        with partial.open("wb") as stream:
            written = _written(stream, recording, file.robot if file else None, progress)
        partial.replace(out)
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "free the disk, or choose another place") from None
    finally:
        partial.unlink(missing_ok=True)
    return written


def _written(
    stream: IO[bytes], recording: Recording, robot: Robot | None, progress: Callable[[float], None]
) -> tuple[Counter[str], list[str]]:
    sheet, picture, left_out = _Sheet(stream, recording), MapPicture(), Counter[str]()
    n_entries = sum(1 for _ in recording.entries())
    at = sent = 0
    for i, entry in enumerate(recording.entries()):
        if i % _PROGRESS_EVERY == 0:
            progress(i / n_entries)
        topic = topic_of(entry.key)
        if topic is None:
            left_out[f"{entry.key}: not a topic of this stack"] += 1
            continue
        if topic is topics.JOURNAL:
            continue  # what its service took, for replay: nothing to see
        try:
            message, envelope = decode(topic.type, entry.payload)
        except CodecError as error:
            left_out[f"{entry.key}: {error}"] += 1
            continue
        at, sent = entry.log_time, entry.sent
        if topic is topics.MAP:
            picture.add(cast(Any, message))
            sheet.add(MAP_ROW, picture.due(at), at, sent)
        seen = MessageContext(envelope.publisher, robot)
        for row in rows_of(entry.key):
            sheet.add(row, row.make(message, seen), at, sent)
    sheet.add(MAP_ROW, picture.last(), at, sent)
    if not sheet.counts:
        raise UserError(f"{recording.path} holds no message of this stack", "name a recording of zenav's recorder")
    sheet.close()
    progress(1.0)
    untold = [f"{n} messages left out on {why}" for why, n in left_out.items()]
    if robot is None:
        untold.append("no configuration is recorded: the laser's place on the robot and the outline are missing")
    return sheet.counts, untold + recording.problems


class _Sheet:
    """The file that is written: a channel a topic, declared when its first message comes."""

    def __init__(self, stream: IO[bytes], recording: Recording) -> None:
        self.counts = Counter[str]()
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._mcap = mcap.writer.Writer(cast(Any, stream), chunk_size=_CHUNK_BYTES)
        self._mcap.start(profile="", library="zenav")
        if recording.about:
            self._mcap.add_metadata("zenav", recording.about)
        for name, text in recording.attachments.items():
            kind = "application/yaml" if name.endswith(".yaml") else "application/octet-stream"
            self._mcap.add_attachment(0, 0, name, kind, text)

    def add(self, row: SchemaRow, value: Any, log_time: int, sent: int) -> None:
        """Adds what a row shows; None shows nothing. Raises OSError."""
        if value is None:
            return
        if row.topic not in self._channels:
            encoding, schema = encoding_of(row.type)
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._mcap.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[row.topic] = self._mcap.register_channel(row.topic, encoding, self._schemas[schema.name])
        self._mcap.add_message(self._channels[row.topic], log_time, encode_message(value), sent)
        self.counts[row.topic] += 1

    def close(self) -> None:
        """Writes the index. Raises OSError."""
        self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap's own
