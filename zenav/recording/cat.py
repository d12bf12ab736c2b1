# SPDX-License-Identifier: Apache-2.0
"""`zenav recording cat`: messages as JSON lines, or what is attached, onto stdout."""

import json
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import msgpack

from shared import topics
from shared.codec import CodecError, decode
from shared.config import UserError, nearest
from shared.recording import Entry
from zenav.console.message_text import json_value
from zenav.recording.opening import open_recording
from zenav.recording.selection import keys_in, time_range


def cat(path: Path, patterns: list[str], begin: float | None, end: float | None, number: int, attached: str) -> int:
    """Writes up to `number` messages (0: all) of the keys that match, or the attachment of that name.

    1 where something of the recording could not be read.
    """
    recording = open_recording(path)
    if attached:
        if attached not in recording.attachments:
            raise UserError(f"{path} has no {attached} attached", nearest(attached, tuple(recording.attachments)))
        sys.stdout.buffer.write(recording.attachments[attached])
        return 0
    since, until = time_range(recording, begin, end)
    entries = recording.entries(keys_in(recording, patterns), since, until)
    for entry in islice(entries, number or None):
        sys.stdout.write(json.dumps(entry_json(entry)) + "\n")
    for problem in recording.problems:
        sys.stderr.write(f"{problem}\n")
    return 1 if recording.problems else 0


def entry_json(entry: Entry) -> dict[str, Any]:
    """A message as JSON: key, time of recording (ns), fields, publisher, session, sequence and send time (ns).

    A message that this version does not know has the problem, its size and, of msgpack and JSON, its content.
    """
    head = {"key": entry.key, "log_time": entry.log_time} | ({"latched": True} if entry.latched else {})
    topic = topics.topic_of(entry.key)
    try:
        if topic is None or entry.channel.encoding != "msgpack":
            raise CodecError("no topic of this version")
        message, envelope = decode(topic.type, entry.payload)
    except CodecError as error:
        return head | {"problem": str(error), "size": len(entry.payload)} | _foreign(entry)
    about = {"publisher": envelope.publisher, "session": envelope.session, "sequence": envelope.sequence}
    fields: dict[str, Any] = json_value(message)
    return head | fields | {"@": about | {"sent": envelope.sent}}


def _foreign(entry: Entry) -> dict[str, Any]:
    if entry.channel.encoding == "json":
        try:
            return {"message": json.loads(entry.payload)}
        except (ValueError, RecursionError):
            return {}
    if entry.channel.encoding != "msgpack":
        return {}
    try:
        return {"message": _plain(msgpack.unpackb(entry.payload, strict_map_key=False))}
    except Exception:  # msgpack raises a dozen kinds on foreign bytes; the size is shown
        return {}


def _plain(value: Any) -> Any:
    """What msgpack knows as what JSON knows."""
    if isinstance(value, dict):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, bytes):
        return value.hex()
    return value if value is None or isinstance(value, (str, int, float, bool)) else str(value)
