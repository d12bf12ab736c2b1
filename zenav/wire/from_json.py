# SPDX-License-Identifier: Apache-2.0
"""Messages from JSON, as `zenav topic echo --json` writes them, to their bytes on the wire."""

import json
from collections.abc import Iterator
from enum import StrEnum
from typing import Any, get_args, get_origin

import msgpack
import numpy as np

from shared.codec import CodecError, Envelope, Field, decode, fields_of, packed_array, wire_dtype
from shared.config import UserError, nearest
from shared.messages import Message


def payload_from_json(class_: type[Message], text: str, envelope: Envelope) -> bytes:
    """The bytes of a message. A stamp that is left out is the time at which it is sent; in nested messages it is 0.

    text: a JSON object; NaN is null, bytes are hexadecimal. Raises UserError where it is no valid message.
    """
    hint = f"its fields: zenav schema {class_.__name__}"
    try:
        tree = json.loads(text or "{}")
    except ValueError as error:
        raise UserError(f"not JSON: {error}", """quote it: '{"v": 0.1}'""") from None
    if not isinstance(tree, dict):
        raise UserError("a message is a JSON object", hint)
    tree.pop("@", None)
    try:
        fields = dict(_fields(class_, {"stamp": envelope.sent, **tree}))
        payload = bytes(msgpack.packb({"@": tuple(envelope), **fields}))
        decode(class_, payload)
    except CodecError as error:
        raise UserError(f"not a {class_.__name__}: {error}", hint) from None
    except (ValueError, TypeError, OverflowError) as error:
        raise UserError(f"not a {class_.__name__}: {error}", hint) from None
    return payload


def _fields(class_: type[Message], tree: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    declared = {field.name: field for field in fields_of(class_)}
    for name, value in tree.items():
        if name not in declared:
            raise UserError(f"{class_.__name__} has no field {name}", nearest(name, tuple(declared)))
        yield name, _value(declared[name].kind, value, declared[name])


def _value(kind: Any, value: Any, field: Field) -> Any:
    if get_origin(kind) is np.ndarray:
        return packed_array(_array(kind, value, field), wire_dtype(kind))
    if kind is bytes and isinstance(value, str):
        return bytes.fromhex(value)
    if kind is float and value is None:
        return float("nan")
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return value
    if isinstance(kind, type) and issubclass(kind, Message) and isinstance(value, dict):
        return dict(_fields(kind, {"stamp": 0, **value}))
    if get_origin(kind) is tuple and isinstance(value, list):
        inner = get_args(kind)
        kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else inner
        plain = [get_args(each)[0] if hasattr(each, "__metadata__") else each for each in kinds]
        return [_value(each, item, field) for each, item in zip(plain, value)] + value[len(plain) :]
    return value


def _array(kind: Any, value: Any, field: Field) -> Any:
    """The array of nested lists. Raises ValueError or TypeError where they are none of its dtype."""
    dtype = wire_dtype(kind)
    if not isinstance(value, list):
        raise ValueError(f"{field.name} is not a list of numbers")
    numbers = np.array(value, np.float64)  # null becomes NaN
    with np.errstate(invalid="ignore"):  # compared below
        array = numbers.astype(dtype)
    if dtype.kind != "f" and not np.array_equal(array, numbers):
        raise ValueError(f"{field.name} holds values that are no {dtype.name}")
    axes = field.shape.axes.split() if field.shape else []
    return array if array.size or not axes else array.reshape([0, *(int(n) if n.isdigit() else 0 for n in axes[1:])])
