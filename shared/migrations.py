# SPDX-License-Identifier: Apache-2.0
"""Conversion of messages in old recordings: one row for each former schema, with an old recording as its test.

A new field with a default needs no row: the schema's id stays. A removed field, a new field without a default and
another type of a field need one. A row converts the message's msgpack map, with its envelope.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgpack

from shared import messages
from shared.codec import fields_of
from shared.messages import FollowStatus, Goal, Message
from shared.schema import schema_id

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Migration:
    """Conversion from one schema to the present one of `type`."""

    type: type[Message]
    change: Callable[[Tree], Tree]

    def __call__(self, payload: bytes) -> bytes:
        """The payload in the present schema. A payload of another schema is returned unchanged."""
        try:
            tree = msgpack.unpackb(payload)
            return bytes(msgpack.packb(self.change(tree)))
        except Exception:  # msgpack raises a dozen kinds on foreign bytes; their decoder reports it
            return payload


def without(*names: str) -> Callable[[Tree], Tree]:
    """A conversion that removes these fields."""
    return lambda tree: {name: value for name, value in tree.items() if name not in names}


def without_recovery(tree: Tree) -> Tree:
    """A goal of the time when a recovery was a goal with a kind. A recovery becomes an inactive goal.

    It cannot become a `Recovery`: a recording's journals name each message by its key.
    """
    renamed = {"active" if name == "kind" else name: value for name, value in without("amount")(tree).items()}
    return renamed | {"active": tree["kind"] == "drive"}


MIGRATIONS: dict[str, Migration] = {
    # local_ctrl published its computation time; now health contains it for every service
    "FollowStatus-ee5971bf": Migration(FollowStatus, without("solve_time")),
    # goals and recoveries were one message; since then they are two, on two topics
    "Goal-4cd8f1ba": Migration(Goal, without_recovery),
}
"""By the id of the former schema."""


@cache
def today() -> dict[str, type[Message]]:
    """The message classes of this version by name."""
    classes = (value for value in vars(messages).values() if isinstance(value, type) and issubclass(value, Message))
    return {class_.__name__: class_ for class_ in classes if class_ is not Message}


def unknown_version(name: str, schema: bytes) -> str:
    """Why this version cannot read messages of a schema, in words; empty where it can, or knows no such message.

    name: the schema's id.   schema: its text with the fields.
    """
    type_ = today().get(name.rpartition("-")[0])
    if type_ is None or name in MIGRATIONS:
        return ""
    if name != schema_id(type_):
        return f"{name}; this version knows {schema_id(type_)}"
    try:
        recorded = {str(row["name"]) for row in json.loads(schema)["fields"]}
    except (ValueError, TypeError, KeyError, IndexError, RecursionError):
        return ""  # the id says enough
    new = sorted(recorded - {row.name for row in fields_of(type_)})
    return f"{name} with {', '.join(new)}, which this version does not know" if new else ""
