# SPDX-License-Identifier: Apache-2.0
"""Messages as JSON, with the JSON schema that their annotations give, so that every number can be plotted.

Foxglove's reading of JSON schemas: no `null` types and no arrays in arrays; `{sec, nsec}` titled `time` is a time; a
string with base64 content is bytes. Nothing measured (NaN) is left out, and null among an array's numbers.
"""

import json
from base64 import b64encode
from collections.abc import Callable
from enum import StrEnum
from functools import cache
from math import isfinite
from typing import Any, cast, get_args, get_origin

import numpy as np

from shared.codec import Field, fields_of
from shared.geometry import Pose2
from shared.messages import Health, Message, RobotIntent

TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}
POSE = {"type": "object", "properties": {axis: {"type": "number"} for axis in ("x", "y", "yaw")}}
COLUMNS: dict[tuple[type[Message], str], tuple[str, ...]] = {
    (Health, "rates"): ("topic", "hz", "age"),
    (Health, "rejected"): ("key", "why", "n"),
    (RobotIntent, "heard"): ("robot", "claim"),
}
"""What the parts of a tuple are called."""


def time_of(ns: int) -> dict[str, int]:
    """A time as Foxglove writes it; a number of ns would lose its last digits in JavaScript."""
    sec, nsec = divmod(ns, 10**9)
    return {"sec": sec, "nsec": nsec}


def document(message: Message) -> dict[str, Any]:
    """The message as JSON's types."""
    fields: dict[str, Any] = {}
    type_: Any = type(message)  # a class of dataclasses, which `cache` does not take for hashable
    for name, turn in _turners(type_):
        value = turn(getattr(message, name))
        if value is not None:
            fields[name] = value
    return fields


def compact(document: dict[str, Any]) -> bytes:
    """JSON text without spaces. Raises ValueError where a number is not finite."""
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode()


def json_schema(type_: type[Message]) -> dict[str, Any]:
    """The JSON schema of a message class; each field's description is its unit."""
    properties = {field.name: {**_kind(type_, field), "description": field.unit} for field in fields_of(type_)}
    text = " ".join((type_.__doc__ or "").split())
    return {"type": "object", "title": f"zenav.{type_.__name__}", "description": text, "properties": properties}


def _kind(type_: type[Message], field: Field) -> dict[str, Any]:
    if field.kind is int and field.unit == "ns":
        return TIME
    return _schema_of(field.kind, COLUMNS.get((type_, field.name), ()))


def _schema_of(kind: Any, columns: tuple[str, ...] = ()) -> dict[str, Any]:
    plain: dict[Any, dict[str, Any]] = {
        Pose2: POSE,
        bool: {"type": "boolean"},
        int: {"type": "integer"},
        float: {"type": "number"},
        str: {"type": "string"},
        bytes: {"type": "string", "contentEncoding": "base64"},
    }
    if kind in plain:
        return plain[kind]
    if get_origin(kind) is np.ndarray:
        return {"type": "array", "items": {"type": "number"}}
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if inner[-1] is Ellipsis:
            return {"type": "array", "items": _schema_of(_bare(inner[0]), columns)}
        named = zip(columns, inner, strict=True)
        return {"type": "object", "properties": {name: _schema_of(_bare(part)) for name, part in named}}
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return {"type": "string"}
    return json_schema(kind)


@cache
def _turners(type_: Any) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    return tuple((field.name, _turner(type_, field)) for field in fields_of(cast(type[Message], type_)))


def _turner(type_: type[Message], field: Field) -> Callable[[Any], Any]:
    """What makes JSON of a field's values; None is nothing measured."""
    if field.kind is int and field.unit == "ns":
        return time_of
    return _turner_of(field.kind, COLUMNS.get((type_, field.name), ()))


def _turner_of(kind: Any, columns: tuple[str, ...] = ()) -> Callable[[Any], Any]:
    if kind is Pose2:
        return lambda pose: {"x": pose.x, "y": pose.y, "yaw": pose.yaw}
    if kind is float:
        return lambda number: float(number) if isfinite(number) else None
    if kind is bytes:
        return lambda data: b64encode(data).decode()
    if get_origin(kind) is np.ndarray:
        return _numbers
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if inner[-1] is Ellipsis:
            turn = _turner_of(_bare(inner[0]), columns)
            return lambda values: [turn(value) for value in values]
        turns = [(name, _turner_of(_bare(part))) for name, part in zip(columns, inner, strict=True)]
        return lambda values: {name: turn(value) for (name, turn), value in zip(turns, values, strict=True)}
    if isinstance(kind, type) and issubclass(kind, Message):
        return document
    return lambda value: value


def _numbers(array: Any) -> list[Any]:
    flat = np.ravel(array)
    if flat.dtype.kind == "f" and not np.isfinite(flat).all():
        return [number if isfinite(number) else None for number in flat.tolist()]
    return cast(list[Any], flat.tolist())


def _bare(kind: Any) -> Any:
    return get_args(kind)[0] if hasattr(kind, "__metadata__") else kind
