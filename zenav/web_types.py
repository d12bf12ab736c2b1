# SPDX-License-Identifier: Apache-2.0
"""The messages as TypeScript: `python -m zenav.web_types` writes web/src/messages.ts, a test holds it fresh.

The tables in it say how the bytes of a message (shared/codec.py) become these types.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import inspect
import sys
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np

from services.dashboard.frames import HIDDEN
from shared.codec import Field, fields_of
from shared.geometry import Pose2
from shared.messages import Message
from shared.topics import TOPICS, Topic

FILE = Path(__file__).resolve().parent.parent / "web" / "src" / "messages.ts"
ARRAYS = {
    "float32": ("f4", "Float32Array"),
    "float64": ("f8", "Float64Array"),
    "int8": ("i1", "Int8Array"),
    "uint8": ("u1", "Uint8Array"),
    "int32": ("i4", "Int32Array"),
}
"""By dtype: its name in the tables, and its type."""
PLAIN = {float: "number", int: "number", str: "string", bool: "boolean", bytes: "Uint8Array", Pose2: "Pose"}
SHOWN: tuple[Topic[Message], ...] = tuple(topic for topic in TOPICS if topic not in HIDDEN)

HEAD = """\
// SPDX-License-Identifier: Apache-2.0
// Made from shared/messages.py and shared/topics.py by `python -m zenav.web_types`; edit these instead.
// Stamps are ns on the stack's clock; lengths are m, angles rad, unless a field says otherwise.

/** A pose: m, m, rad. */
export type Pose = readonly [x: number, y: number, yaw: number];

/** An array of two axes, row by row. */
export interface Grid<A> {
  readonly rows: number;
  readonly columns: number;
  readonly values: A;
}

/** Under "@" in each message. `sent`: ns on the stack's clock. `sequence`: from 0, by key and session. */
export type Envelope = readonly [publisher: string, session: string, sequence: number, sent: number];
"""


def main() -> None:
    """Writes the file."""
    FILE.write_text(web_types(), encoding="utf-8")
    sys.stdout.write(f"{FILE.name}\n")


def web_types() -> str:
    """The content of messages.ts."""
    classes = list(dict.fromkeys(class_ for topic in SHOWN for class_ in with_parts(topic.type)))
    enums = list(dict.fromkeys(kind for class_ in classes for kind in enums_of(class_)))
    parts = [HEAD, *(enum_type(kind) for kind in enums), *(interface(class_) for class_ in classes)]
    keys = "".join(f'  "{topic.key}": {topic.type.__name__};\n' for topic in SHOWN)
    parts.append(
        '/** Message type of each key; families ("health/mapper") by their first part. */\n'
        f"export interface MessageOf {{\n{keys}}}\n"
    )
    parts.append("export type Key = keyof MessageOf;\n")
    parts.append(arrays_table())
    parts.append(fields_table(classes))
    return "\n".join(parts)


def with_parts(class_: type[Message]) -> Iterator[type[Message]]:
    """A message class after the message classes of its fields."""
    for field in fields_of(class_):
        item = item_of(field.kind)
        if inspect.isclass(item) and issubclass(item, Message):
            yield from with_parts(item)
    yield class_


def enums_of(class_: type[Message]) -> Iterator[type[StrEnum]]:
    """The enums of a message's fields."""
    for field in fields_of(class_):
        if inspect.isclass(field.kind) and issubclass(field.kind, StrEnum):
            yield field.kind


def enum_type(kind: type[StrEnum]) -> str:
    """An enum as a union of its texts."""
    return (
        comment(kind) + f"export type {kind.__name__} = {' | '.join(f'{chr(34)}{value}{chr(34)}' for value in kind)};\n"
    )


def interface(class_: type[Message]) -> str:
    """A message as an interface. An array with a default may be missing: it is not sent while it is empty."""
    rows = []
    for field in fields_of(class_):
        optional = "?" if is_array(field) and not field.required else ""
        unit = "" if field.unit in ("1", "") else f"  /** {field.unit} */\n"
        rows.append(f"{unit}  readonly {field.name}{optional}: {type_text(field.kind, axes_of(field))};\n")
    return comment(class_) + f"export interface {class_.__name__} {{\n{''.join(rows)}}}\n"


def arrays_table() -> str:
    """The array fields of each key, which arrive as bytes."""
    rows = []
    for topic in SHOWN:
        found = list(array_paths(topic.type))
        if found:
            rows.append(f'  "{topic.key}": {{ ' + ", ".join(f'"{path}": "{kind}"' for path, kind in found) + " },\n")
    return (
        "/** Array fields of each key: dtype, and the number of axes over 1. `zones[].xs`: of each item of a list. */\n"
        "export const ARRAYS: { readonly [K in Key]?: Readonly<Record<string, string>> } = {\n" + "".join(rows) + "};\n"
    )


def array_paths(class_: type[Message], prefix: str = "") -> Iterator[tuple[str, str]]:
    """(path, kind) of each array in a message."""
    for field in fields_of(class_):
        if is_array(field):
            yield prefix + field.name, array_kind(field)
        else:
            item = item_of(field.kind)
            if inspect.isclass(item) and issubclass(item, Message):
                yield from array_paths(item, f"{prefix}{field.name}{'[].' if item is not field.kind else '.'}")


def fields_table(classes: list[type[Message]]) -> str:
    """The fields of each message with their kinds."""
    rows = []
    for class_ in classes:
        fields = ", ".join(f'{field.name}: "{kind_text(field)}"' for field in fields_of(class_))
        rows.append(f"  {class_.__name__}: {{ {fields} }},\n")
    return (
        "/** Fields of each message: number, string, boolean, bytes, pose, enum NAME, array DTYPE AXES, list of KIND,\n"
        " * or the name of a message. */\n"
        "export const FIELDS: Readonly<Record<string, Readonly<Record<string, string>>>> = {\n" + "".join(rows) + "};\n"
    )


def kind_text(field: Field) -> str:
    """The kind of a field in the table FIELDS."""
    return f"array {ARRAYS[dtype_of(field.kind)][0]} {axes_of(field)}" if is_array(field) else plain_kind(field.kind)


def plain_kind(kind: Any) -> str:
    """The kind of a value that is no array."""
    words = {float: "number", int: "number", str: "string", bool: "boolean", bytes: "bytes", Pose2: "pose"}
    if kind in words:
        return words[kind]
    if get_origin(kind) is tuple:
        items = [bare(item) for item in get_args(kind)]
        return f"list of {plain_kind(items[0])}" if items[-1] is Ellipsis else f"({', '.join(map(plain_kind, items))})"
    return f"enum {kind.__name__}" if issubclass(kind, StrEnum) else str(kind.__name__)


def type_text(kind: Any, axes: int = 1) -> str:
    """The TypeScript type of a value."""
    if get_origin(kind) is np.ndarray:
        name = ARRAYS[dtype_of(kind)][1]
        return name if axes == 1 else f"Grid<{name}>"
    if get_origin(kind) is tuple:
        items = [bare(item) for item in get_args(kind)]
        if items[-1] is Ellipsis:
            inner = type_text(items[0])
            return f"readonly ({inner})[]" if " " in inner else f"readonly {inner}[]"
        return f"readonly [{', '.join(map(type_text, items))}]"
    return PLAIN.get(kind) or str(kind.__name__)


def is_array(field: Field) -> bool:
    """Whether a field is an array, which is bytes on the wire."""
    return get_origin(field.kind) is np.ndarray


def array_kind(field: Field) -> str:
    """`f4`, or `i1 2` with two axes."""
    axes = axes_of(field)
    return ARRAYS[dtype_of(field.kind)][0] + (f" {axes}" if axes > 1 else "")


def axes_of(field: Field) -> int:
    """The number of axes of an array field."""
    return len(field.shape.axes.split()) if field.shape is not None else 1


def dtype_of(kind: Any) -> str:
    """The dtype's name of an NDArray[...]."""
    (scalar,) = get_args(get_args(kind)[1])
    return str(np.dtype(scalar).name)


def bare(kind: Any) -> Any:
    """A kind without its annotations."""
    return get_args(kind)[0] if hasattr(kind, "__metadata__") else kind


def item_of(kind: Any) -> Any:
    """The kind of the items of a list; the kind itself where it is no list."""
    return bare(get_args(kind)[0]) if get_origin(kind) is tuple else kind


def comment(class_: type[Any]) -> str:
    """The first paragraph of a docstring as a comment."""
    words = " ".join(inspect.cleandoc(class_.__doc__ or "").split("\n\n")[0].split())
    return f"/** {words} */\n"


if __name__ == "__main__":
    main()
