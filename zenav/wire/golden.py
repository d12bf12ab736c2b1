# SPDX-License-Identifier: Apache-2.0
"""Golden bytes: one message of each class with its bytes and its values, for readers in other languages."""

import json
from enum import StrEnum
from typing import Any, get_args, get_origin

import numpy as np

from shared import sample_messages as samples
from shared.codec import Envelope, Field, encode, fields_of, wire_dtype
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import TILE_CELLS, Message, OtherRobots, Within
from shared.requests import REQUESTS, GiveMap
from shared.topics import TOPICS
from zenav.console.message_text import json_value
from zenav.wire.page import message_classes

STAMP = 1_700_000_000_123_456_789
"""ns; over 2^53, which a reader must not round."""
SENT = STAMP + 250_000
POSE = Pose2(1.5, -2.25, 0.5)
LENGTHS = {"k": 3, "n": 4, "r": 2, "c": 3}
"""Of the named axes; others have 2."""


def golden_text() -> str:
    """The content of docs/wire/golden.json: a line a message."""
    rows = []
    for class_ in message_classes():
        message, envelope = sample(class_), Envelope(publisher_of(class_), "golden", 7, SENT)
        value = {"@": list(envelope), **json_value(message)}
        row = {"bytes": encode(message, envelope).hex(), "value": value}
        rows.append(f"{json.dumps(class_.__name__)}: {json.dumps(row, separators=(',', ':'))}")
    return "{\n" + ",\n".join(rows) + "\n}\n"


def sample(class_: type[Message]) -> Message:
    """A message of a class: that of shared/sample_messages.py, or one made from its declared fields."""
    made = {type(message): message for message in _from_samples()}
    return made.get(class_) or _made(class_)


def publisher_of(class_: type[Message]) -> str:
    """A sender of messages of a class: a service, or `operator`."""
    publishers = [row.publishers[0] for row in TOPICS if row.type is class_]
    replying = [row.services[0] for row in REQUESTS if row.reply is class_]
    return next(iter((*publishers, *replying)), "operator")


def _from_samples() -> tuple[Message, ...]:
    laser = load_robot("x80sv").robot.laser
    ranges = np.where(np.arange(laser.n_beams) % 5 == 0, np.nan, 0.5 + 0.25 * (np.arange(laser.n_beams) % 32))
    cells = (np.arange(TILE_CELLS**2) % 102 - 1).astype(np.int8)
    return (
        samples.odometry(STAMP, POSE, 0.25),
        samples.base_odometry(STAMP, POSE, 0.25),
        samples.pose_estimate(STAMP, POSE),
        samples.scan(STAMP, laser, ranges),
        samples.range_readings(STAMP, 3),
        samples.map_update(STAMP, cells),
        samples.zones(STAMP, 1.0, 2.0),
        samples.goal(STAMP, 3, POSE),
        samples.path(STAMP, 3, 2.0),
        OtherRobots(STAMP, ("blue",), np.full(1, 0.3, np.float32), 0.25, *np.zeros((2, 1, 3), np.float32)),
        GiveMap(STAMP, 5, 0, 1, b"\x00\x01\xfe\xff"),
    )


def _made(class_: type[Message]) -> Message:
    make: Any = class_
    message: Message = make(**{field.name: _field(field) for field in fields_of(class_)})
    if problem := message.problem():
        raise ValueError(f"{class_.__name__}: {problem}: give it a sample in {__name__}")
    return message


def _field(field: Field) -> Any:
    if field.name == "stamp":
        return STAMP
    if field.shape is None:
        return _value(field.kind, field.within, field.name)
    shape = [int(axis) if axis.isdigit() else LENGTHS.get(axis, 2) for axis in field.shape.axes.split()]
    dtype = wire_dtype(field.kind)
    step = 0.25 if dtype.kind == "f" else 1
    values = _clipped(step * (1 + np.arange(np.prod(shape)) % 64), field.within)
    if field.within is not None and field.within.nan:
        values[-1] = np.nan
    return values.reshape(shape).astype(dtype)


def _value(kind: Any, within: Within | None, name: str) -> Any:
    if kind is float or kind is int:
        return kind(_clipped(np.array([0.5 if kind is float else 3]), within)[0])
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        return tuple(_item(each, name) for each in (inner[:1] if inner[-1] is Ellipsis else inner))
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return list(kind)[-1]
    if isinstance(kind, type) and issubclass(kind, Message):
        return sample(kind)
    plain = {bool: True, str: f"{name} \u00e4", bytes: b"\x00\x01\xfe\xff", Pose2: POSE}
    return plain[kind]


def _item(kind: Any, name: str) -> Any:
    marks: tuple[Any, ...] = getattr(kind, "__metadata__", ())
    within = next((mark for mark in marks if isinstance(mark, Within)), None)
    return _value(get_args(kind)[0] if marks else kind, within, name)


def _clipped(values: Any, within: Within | None) -> Any:
    return np.clip(values, within.low, within.high) if within is not None else values
