# SPDX-License-Identifier: Apache-2.0
"""Which fields of a payload does this version not know? The codec ignores them, so that messages can grow."""

from collections.abc import Iterator
from typing import Any, get_args, get_origin

import msgpack

from shared.codec import fields_of
from shared.messages import Message


def unknown_fields(type_: type[Message], payload: bytes) -> tuple[str, ...]:
    """Names of the fields that a message class does not have, dotted in nested messages; each once.

    payload: bytes that the codec accepts as this class.
    """
    return tuple(dict.fromkeys(_unknown(type_, msgpack.unpackb(payload), "")))


def unknown_text(names: tuple[str, ...]) -> str:
    """Words for the fields that are ignored."""
    return f"unknown field{'s' if len(names) > 1 else ''} {', '.join(names)} ignored"


def _unknown(type_: type[Message], tree: dict[str, Any], prefix: str) -> Iterator[str]:
    fields = {field.name: field.kind for field in fields_of(type_)}
    for name, value in tree.items():
        if name in fields:
            yield from _in_value(fields[name], value, f"{prefix}{name}.")
        elif name != "@" or prefix:
            yield f"{prefix}{name}"


def _in_value(kind: Any, value: Any, prefix: str) -> Iterator[str]:
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else inner
        for each, item in zip(kinds, value):
            yield from _in_value(get_args(each)[0] if hasattr(each, "__metadata__") else each, item, prefix)
    elif isinstance(kind, type) and issubclass(kind, Message):
        yield from _unknown(kind, value, prefix)
