# SPDX-License-Identifier: Apache-2.0
"""The frames of a page (docs/page.md) and the arguments of its operations, from bytes to checked values."""

from typing import Any

import msgpack

from services.dashboard.field_checks import (
    Fields,
    FrameError,
    boolean,
    identifier,
    item_name,
    mapping,
    number,
    one_of,
    pose,
    recording_name,
    text,
    texts,
    whole_number,
)
from shared import topics
from shared.codec import CodecError, Envelope, decode
from shared.crossing import OUTWARD_KEYS
from shared.requests import MAX_VALUE_LENGTH, REQUESTS, Request
from shared.roles import REQUEST_ROLES
from shared.topics import KEYS, topic_of
from shared.unknown_fields import unknown_fields

MAX_FRAME = 64 * 1024
"""bytes of a frame of a page."""
MAX_NAME = 40  # characters
MAX_SPEED, MAX_TURN_RATE = 20.0, 50.0  # m/s, rad/s: the bounds of shared/messages.py
MAX_MARK = 200  # characters
MARK = "mark by "
"""Begin of the log line that a mark becomes."""
MAX_REPLAY_S = 1e7  # s from the begin of a recording

HIDDEN = (topics.JOURNAL, topics.RX, topics.TX, topics.PORT, topics.PLUG)
"""What a page cannot show: bytes of other services, and its own."""
PAGE_KEYS = tuple(key for key in KEYS if topic_of(key) not in HIDDEN)
"""Keys (without the robot's name) that a page may want."""
SITE_KEYS = tuple(key for key in PAGE_KEYS if key in OUTWARD_KEYS)
"""The same of a page of a site: what crosses."""

FRAMES = {
    "want": Fields({"keys": texts(len(PAGE_KEYS))}, {"debug": boolean}),
    "teleop": Fields(
        {"v": number(-MAX_SPEED, MAX_SPEED), "w": number(-MAX_TURN_RATE, MAX_TURN_RATE), "n": whole_number}
    ),
    "let_go": Fields(),
    "stop": Fields(),
    "stop_all": Fields(),
    "release": Fields(),
    "ask": Fields({"id": identifier, "request": text(64)}, {"args": mapping}),
    "do": Fields({"id": identifier, "op": text(32)}, {"args": mapping}),
    "name": Fields({"name": text(MAX_NAME)}),
    "ping": Fields({"id": identifier}),
}
"""By type `t`: the other fields."""

OPERATIONS = {
    "maps": Fields(),
    "map_save": Fields({"name": item_name}),
    "map_load": Fields({"name": item_name, "mode": one_of("map", "localize", "continue")}, {"pose": pose}),
    "map_rename": Fields({"name": item_name, "to": item_name}),
    "map_delete": Fields({"name": item_name}),
    "places": Fields({}, {"map": text(64)}),
    "place_set": Fields({"name": item_name, "pose": pose}, {"map": text(64)}),
    "place_delete": Fields({"name": item_name}, {"map": text(64)}),
    "set_pose": Fields({"pose": pose}),
    "recordings": Fields(),
    "recording_mark": Fields({"text": text(MAX_MARK)}),
    "recording_delete": Fields({"name": recording_name}),
    "replay_open": Fields({"name": recording_name}),
    "replay_at": Fields(
        {"name": recording_name, "t": number(0, MAX_REPLAY_S)},
        {"since": number(0, MAX_REPLAY_S), "first": whole_number},
    ),
    "settings": Fields(),
    "setting_set": Fields({"name": text(MAX_VALUE_LENGTH), "value": text(MAX_VALUE_LENGTH)}),
}
"""By `op`: the arguments."""


def unpacked_frame(data: bytes) -> tuple[str, dict[Any, Any]]:
    """Type and other fields of a frame, not yet checked. Raises FrameError, never anything else."""
    if len(data) > MAX_FRAME:
        raise FrameError(f"a frame of {len(data)} bytes, where {MAX_FRAME} are the limit")
    try:
        tree = msgpack.unpackb(data)
    except Exception as error:  # msgpack raises a dozen kinds on foreign bytes: all mean the same here
        raise FrameError(f"a frame that is not msgpack: {type(error).__name__}") from None
    if type(tree) is not dict or type(tree.get("t")) is not str:
        raise FrameError("a frame without a type")
    return tree.pop("t"), tree


def checked_frame(kind: str, values: dict[Any, Any]) -> dict[str, Any]:
    """The fields of a frame of this type. Raises FrameError."""
    fields = FRAMES.get(kind)
    if fields is None:
        raise FrameError(f"{kind[:32]!r} is no type of frame")
    return fields.checked(values, kind)


def checked_operation(op: str, arguments: dict[Any, Any]) -> dict[str, Any]:
    """The arguments of an operation. Raises FrameError."""
    fields = OPERATIONS.get(op)
    if fields is None:
        raise FrameError(f"{op!r} is no operation")
    checked = fields.checked(arguments, op)
    if checked.get("map"):
        item_name(checked["map"])
    return checked


def request_named(key: str) -> Request[Any, Any] | None:
    """The request of a key that pages may ask, or None."""
    return next((row for row in REQUESTS if row.key == key and key in REQUEST_ROLES), None)


def request_payload(row: Request[Any, Any], arguments: dict[Any, Any], now: int) -> bytes:
    """A request as bytes, stamped `now` (ns) and checked as any request is. Raises FrameError."""
    if "@" in arguments or "stamp" in arguments:
        raise FrameError("stamp is filled in by the server")
    try:
        payload = bytes(msgpack.packb({**arguments, "stamp": now, "@": Envelope("dashboard", "", 0, now)}))
        decode(row.request, payload)
        if names := unknown_fields(row.request, payload):
            raise FrameError(f"unknown field {names[0]!r}")
    except (CodecError, ValueError, TypeError, OverflowError) as error:
        raise FrameError(str(error)) from None
    return payload
