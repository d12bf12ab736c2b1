# SPDX-License-Identifier: Apache-2.0
"""JSON Schema (2020-12) of messages, requests and the envelope, from the annotations of their fields.

It describes messages as JSON: what `zenav topic echo --json` writes and `zenav topic pub` takes. `x-unit` is a field's
unit. `x-dtype` and `x-shape` are those of an array, which is one bin on the wire (docs/wire.md).
"""

import json
import sys
from enum import StrEnum
from typing import Any, get_args, get_origin

import numpy as np

from shared.codec import MAX_COORDINATE, MAX_YAW, Field, fields_of, wire_dtype
from shared.config import UserError, nearest
from shared.geometry import Pose2
from shared.messages import Message, Within
from shared.requests import REQUESTS
from shared.schema import schema_id
from shared.topics import TOPICS, topic_of
from zenav.wire.page import message_classes

DRAFT = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]

ENVELOPE: Schema = {
    "description": "[publisher, session, sequence, sent]: sequence from 0, by key and session; sent: ns",
    "type": "array",
    "prefixItems": [{"type": "string"}, {"type": "string"}, {"type": "integer"}, {"type": "integer", "x-unit": "ns"}],
    "items": False,
    "minItems": 4,
}
POSE: Schema = {
    "type": "array",
    "prefixItems": [
        {"type": "number", "minimum": -limit, "maximum": limit} for limit in (MAX_COORDINATE, MAX_COORDINATE, MAX_YAW)
    ],
    "items": False,
    "minItems": 3,
}
PLAIN: dict[Any, Schema] = {
    bool: {"type": "boolean"},
    str: {"type": "string"},
    bytes: {"type": "string", "contentEncoding": "base16", "pattern": "^([0-9a-f]{2})*$"},
    Pose2: POSE,
}


def document() -> Schema:
    """The schemas of all messages, and which topic and request has which."""
    return {
        "$schema": DRAFT,
        "$id": "urn:zenav:wire",
        "description": "Messages of zenav as JSON; docs/wire.md has their bytes",
        "$defs": {"envelope": ENVELOPE, **{class_.__name__: message_schema(class_) for class_ in message_classes()}},
        "x-topics": [
            {"key": row.key, "message": _reference(row.type), "by": list(row.publishers), "family": row.by == "*",
             "hz": row.hz, "latched": row.latched}
            for row in TOPICS
        ],
        "x-requests": [
            {"key": row.key, "request": _reference(row.request), "reply": _reference(row.reply),
             "by": list(row.services), "family": row.by == "*"}
            for row in REQUESTS
        ],
    }  # fmt: skip


def message_schema(class_: type[Message]) -> Schema:
    """The schema of one message class. Messages in it are references to `$defs`."""
    return {
        "type": "object",
        "description": " ".join((class_.__doc__ or "").split()),
        "x-schema-id": schema_id(class_),
        "properties": {
            "@": {"$ref": "#/$defs/envelope"},
            **{field.name: _field_schema(field) for field in fields_of(class_)},
        },
        "required": [field.name for field in fields_of(class_) if field.required],
    }


def show_schema(name: str, as_json: bool) -> None:
    """Writes the schemas of all messages, or of the one with this name, topic or request. Raises UserError."""
    found = [class_for(name)] if name else message_classes()
    if as_json:
        tree = {"$schema": DRAFT, **message_schema(found[0])} if name else document()
        sys.stdout.write(json.dumps(tree, indent=1) + "\n")
        return
    for class_ in found:
        sys.stdout.write(f"{schema_id(class_)}: {' '.join((class_.__doc__ or '').split())}\n")
        for field in fields_of(class_):
            words = {k: v for k, v in _field_schema(field).items() if k != "x-unit"}
            sys.stdout.write(f"  {field.name} ({field.unit}): {json.dumps(words)}\n")


def class_for(name: str) -> type[Message]:
    """The message class of a name, of a topic's key or of a request's. Raises UserError with the nearest name."""
    classes = {class_.__name__: class_ for class_ in message_classes()}
    asked = {row.key: row.request for row in REQUESTS}
    topic = topic_of(name)
    found = classes.get(name) or asked.get(name) or (topic.type if topic else None)
    if found is None:
        raise UserError(f"{name} is not a message", nearest(name, (*classes, *(row.key for row in TOPICS), *asked)))
    return found


def _field_schema(field: Field) -> Schema:
    schema = _schema(field.kind, field.within)
    if field.shape is not None:
        schema = _array_schema(field)
    if field.nonzero:
        schema = {**schema, "not": {"const": 0}}
    return {**schema, **({"x-unit": field.unit} if field.unit not in ("", "1") else {})}


def _schema(kind: Any, within: Within | None) -> Schema:
    if kind in PLAIN:
        return PLAIN[kind]
    if kind is float or kind is int:
        return _number("number" if kind is float else "integer", within)
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if inner[-1] is Ellipsis:
            return {"type": "array", "items": _item(inner[0])}
        items = [_item(each) for each in inner]
        return {"type": "array", "prefixItems": items, "items": False, "minItems": len(items)}
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return {"enum": [str(value) for value in kind]}
    if isinstance(kind, type) and issubclass(kind, Message):
        return {"$ref": _reference(kind)}
    if get_origin(kind) is np.ndarray:
        return {}  # its shape makes the schema
    raise TypeError(f"{kind} has no JSON Schema")


def _item(kind: Any) -> Schema:
    marks: tuple[Any, ...] = getattr(kind, "__metadata__", ())
    within = next((mark for mark in marks if isinstance(mark, Within)), None)
    return _schema(get_args(kind)[0] if marks else kind, within)


def _array_schema(field: Field) -> Schema:
    dtype, axes = wire_dtype(field.kind), field.shape.axes.split() if field.shape else []
    schema = _number("number" if dtype.kind == "f" else "integer", field.within)
    for axis in reversed(axes):
        length = {"minItems": int(axis), "maxItems": int(axis)} if axis.isdigit() else {}
        schema = {"type": "array", "items": schema, **length}
    return {**schema, "x-dtype": dtype.name, "x-shape": " ".join(axes)}


def _number(name: str, within: Within | None) -> Schema:
    if within is None:
        return {"type": name}
    empty = within.nan or within.inf
    return {"type": [name, "null"] if empty else name, "minimum": within.low, "maximum": within.high}


def _reference(class_: type[Message]) -> str:
    return f"#/$defs/{class_.__name__}"
