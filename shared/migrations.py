# SPDX-License-Identifier: Apache-2.0
"""Messages of old recordings as today's: one row a schema that was, with a recording of its time as its test.

A field that came with a default needs no row: its schema's id is the same. Everything else does: a field that went,
came without a default, or has another type. A row takes the message's msgpack map, envelope and all, to today's.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgpack

from shared import messages
from shared.codec import fields_of, schema_id
from shared.messages import FollowStatus, Message

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Migration:
    """From one schema to today's of `type`."""

    type: type[Message]
    change: Callable[[Tree], Tree]

    def __call__(self, payload: bytes) -> bytes:
        """The payload as today's; what is no message of the old schema is left as it is."""
        try:
            tree = msgpack.unpackb(payload)
            return bytes(msgpack.packb(self.change(tree)))
        except Exception:  # msgpack raises a dozen kinds on foreign bytes; whoever decodes them tells it
            return payload


def without(*names: str) -> Callable[[Tree], Tree]:
    """Leaves out fields that are no more."""
    return lambda tree: {name: value for name, value in tree.items() if name not in names}


MIGRATIONS: dict[str, Migration] = {
    # local_ctrl told how long it had computed; since then health tells it for every service
    "FollowStatus-ee5971bf": Migration(FollowStatus, without("solve_time")),
}
"""By the id of the old schema."""


@cache
def today() -> dict[str, type[Message]]:
    """The message classes of this version by name."""
    found = (value for value in vars(messages).values() if isinstance(value, type) and issubclass(value, Message))
    return {class_.__name__: class_ for class_ in found if class_ is not Message}


def unknown_version(name: str, schema: bytes) -> str:
    """Why this version cannot read messages of a schema, in words; empty where it can, or knows no such message at all.

    name: the schema's id.   schema: its text, which tells its fields.
    """
    type_ = today().get(name.rpartition("-")[0])
    if type_ is None or name in MIGRATIONS:
        return ""
    if name != schema_id(type_):
        return f"{name}; this version knows {schema_id(type_)}"
    try:
        told = {str(row["name"]) for row in json.loads(schema)["fields"]}
    except (ValueError, TypeError, KeyError, IndexError, RecursionError):
        return ""  # the id says enough
    new = sorted(told - {row.name for row in fields_of(type_)})
    return f"{name} with {', '.join(new)}, which this version does not know" if new else ""
