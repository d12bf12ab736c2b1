# SPDX-License-Identifier: Apache-2.0
"""The reference pages that are made from the code: `python -m zenav.docs` writes them, a test holds them fresh."""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import inspect
import json
import sys
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from shared import messages, recording_requests, requests
from shared.codec import fields_of
from shared.config import Robot, Section
from shared.crossing import crossing_text
from shared.messages import Message
from shared.reasons import REASONS
from shared.requests import REQUESTS
from shared.roles import REQUEST_ROLES
from shared.schema import schema
from shared.settings import BY_NAME
from shared.topics import TOPICS
from zenav.client.api_page import api_page
from zenav.console.setting_text import bounds_text
from zenav.console.table import markdown_table
from zenav.stack.service_loader import existing_services, service_class
from zenav.wire.golden import golden_text
from zenav.wire.page import filled_page

DOCS = Path(__file__).resolve().parent.parent / "docs"
Rows = list[tuple[str, ...]]
MADE = "<!-- made from the code by `make docs`; edit the code instead -->\n"


def main() -> None:
    """Writes every page, and the figures of the others."""
    from zenav.bench.figure_pages import PAGES as MEASURED  # it needs `table`
    from zenav.bench.figure_pages import write_pages
    from zenav.bench.published import load_published

    for name, page in PAGES.items():
        (DOCS / name).write_text(page(), encoding="utf-8")
        sys.stdout.write(f"docs/{name}\n")
    write_pages(load_published())
    sys.stdout.write("".join(f"{page}, its figures\n" for page in MEASURED))


def messages_page() -> str:
    """Topics, messages, requests and reasons."""
    lines = ["# Messages\n", MADE]
    lines += [
        "Keys stand under the robot's name: `x80/scan`. A message is a msgpack map of its fields, and under `@` the",
        "envelope. [wire.md](wire.md) has the bytes and the rules. Fields are checked where a message arrives; one",
        "that does not hold is dropped and counted in `health`.\n",
        "## Topics\n",
    ]
    rows: Rows = [
        (
            f"`{topic.key}/NAME`" if topic.by == "*" else f"`{topic.key}`",
            f"[{topic.type.__name__}](#{topic.type.__name__.lower()})",
            "each service" if topic.by == "*" else topic.by.replace(" ", ", "),
            f"{topic.hz:g}" if topic.hz else "event",
            topic.keep + (", latched" if topic.latched else ""),
            f"{topic.within * 1e3:g}",
            crossing_text(topic),
        )
        for topic in TOPICS
    ]
    head = "key", "message", "published by", "Hz", "kept unread", "within, ms", "to a site, Hz"
    lines += markdown_table(head, rows)
    lines += [
        "",
        "`latched`: a late joiner gets the last value at once (of the map: all of it). `to a site`: the most that",
    ]
    lines += ["crosses a robot's link at rest / driving / watched ([fleet.md](fleet.md#a-site)); empty: it stays.\n"]
    lines += ["## Requests\n"]
    rows = [
        (
            f"`{row.key}`",
            f"[{row.request.__name__}](#{row.request.__name__.lower()})",
            f"[{row.reply.__name__}](#{row.reply.__name__.lower()})",
            row.by,
            str(REQUEST_ROLES.get(row.key, "")),
            "yes" if row.crosses else "",
        )
        for row in REQUESTS
    ]
    lines += markdown_table(("key", "request", "reply", "answered by", "a page asks it as", "a site asks it"), rows)
    lines += ["", "## Why the robot stands\n"]
    rows = [(f"`{code}`", reason.text, reason.hint, reason.severity) for code, reason in REASONS.items()]
    lines += markdown_table(("code", "text", "hint", "severity"), rows)
    lines += ["", "## Every message\n", "Each begins with `stamp`: when it was true, ns on the stack's clock.\n"]
    for class_ in (*classes(messages), *classes(requests), *classes(recording_requests)):
        lines += message_section(class_)
    return "\n".join(lines).rstrip("\n") + "\n"


def classes(module: Any) -> list[type[Message]]:
    """The message classes of a module, in the order of its source."""
    return [
        value
        for value in vars(module).values()
        if inspect.isclass(value)
        and issubclass(value, Message)
        and value.__module__ == module.__name__
        and value is not Message
    ]


def message_section(class_: type[Message]) -> list[str]:
    """One message: its words, then its fields."""
    rows: Rows = []
    types = {row["name"]: row["type"] for row in json.loads(schema(class_))["fields"]}
    for field in fields_of(class_)[1:]:
        bounds = f"{field.within.low:g} .. {field.within.high:g}" if field.within else ""
        if field.within and field.within.nan:
            bounds += ", or NaN"
        if field.within and field.within.inf:
            bounds += ", or +inf"
        if field.nonzero:
            bounds += ", not 0"
        if isinstance(field.kind, type) and issubclass(field.kind, StrEnum):
            bounds = ", ".join(field.kind)
        kind = types[field.name] + (f" ({field.shape.axes})" if field.shape else "")
        rows.append((f"`{field.name}`", kind, "" if field.unit == "1" else field.unit, bounds))
    head = [f"### {class_.__name__}\n", inspect.cleandoc(class_.__doc__ or ""), ""]
    return head + ([*markdown_table(("field", "type", "unit", "bounds"), rows), ""] if rows else [])


def configuration_page() -> str:
    """Every setting of every section."""
    lines = [
        "# Configuration\n",
        MADE,
        "One YAML file a robot (`shared/robots/x80sv.yaml`): `robot` says what the hardware is, each other section is",
        "one service's. A section or a setting that is left out has its default; a wrong name is an error that says",
        "which name is meant. `zenav config show` prints what holds. Settings with an entry under `at run time` may",
        "change while the robot runs, by [zenav config set](runtime_settings.md). `lower`: never above the first",
        "value.\n",
    ]
    models: dict[str, type[Section]] = {
        "robot": Robot,
        **{name: service_class(name).config_type for name in existing_services()},
    }
    for name, model in models.items():
        lines += [f"## {name}\n"]
        if model.__doc__ and model is not Section:
            lines += [inspect.cleandoc(model.__doc__), ""]
        rows: Rows = [
            (
                f"`{key}`",
                kind_of(field),
                default_of(field),
                bounds_text(field),
                run_time_mark(f"{name}.{key}"),
                field.description or "",
            )
            for key, field in settings(model)
        ]
        head = "setting", "type", "default", "bounds", "at run time", "what it is"
        lines += markdown_table(head, rows) if rows else ["No settings."]
        lines += [""]
    return "\n".join(lines).rstrip("\n") + "\n"


def run_time_mark(name: str) -> str:
    """Whether a setting may change while the robot runs: yes, `lower`, or empty."""
    row = BY_NAME.get(name)
    return "" if row is None else "lower" if row.is_limit else "yes"


def settings(model: type[Section], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Every setting of a section and of the sections inside it: (key, field); a list's items stand under `[]`."""
    for name, field in model.model_fields.items():
        inner = section_of(field)
        if inner is None or inner is not field.annotation:
            yield prefix + name, field
        if inner is not None:
            yield from settings(inner, f"{prefix}{name}[]." if is_list(field) else f"{prefix}{name}.")


def section_of(field: FieldInfo) -> type[Section] | None:
    """The section that a field is, may be, or holds a list of; None for plain values."""
    for kind in (field.annotation, *get_args(field.annotation)):
        if inspect.isclass(kind) and issubclass(kind, Section):
            return kind
    return None


def is_list(field: FieldInfo) -> bool:
    """Whether a field holds any number of values."""
    return get_origin(field.annotation) in (tuple, list)


def kind_of(field: FieldInfo) -> str:
    """A field's type, as people read it."""
    inner = section_of(field)
    if inner is not None:
        return f"list of {inner.__name__}" if is_list(field) else f"{inner.__name__} or none"
    if get_origin(field.annotation) is Literal:
        return ", ".join(get_args(field.annotation))
    return inspect.formatannotation(field.annotation).removeprefix("shared.").replace(" | None", " or none")


def default_of(field: FieldInfo) -> str:
    """A field's default as YAML would have it; `required` where there is none."""
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value in (None, ()):
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def wire_page() -> str:
    """The page of the wire protocol with its tables made again."""
    return filled_page((DOCS / "wire.md").read_text(encoding="utf-8"))


PAGES: dict[str, Callable[[], str]] = {
    "messages.md": messages_page,
    "configuration.md": configuration_page,
    "wire.md": wire_page,
    "wire/golden.json": golden_text,
    "api.md": api_page,
}

if __name__ == "__main__":
    main()
