# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/wire.md, made from the code between markers; all else in the page is left as it is.

<!-- made: NAME -->
what is made
<!-- end -->
"""

import json
import re
from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import Any

from shared import messages, requests
from shared.codec import DTYPES, fields_of
from shared.messages import Message
from shared.rejections import duration
from shared.runners.admission import SILENT_AFTER
from shared.runners.inbox import CAPACITY
from shared.runners.live_runner import MAX_REQUESTS
from shared.runners.transport import (
    BASE_PORT,
    MAX_DOMAIN,
    MAX_MESSAGE,
    MAX_PAYLOAD,
    PORTS_A_STACK,
    StackAddress,
    session_settings,
)
from shared.stamps import FUTURE
from shared.topics import LATCHED_KEYS, SERVICES, topic_of
from zenav.console.table import markdown_table

MARKED = re.compile(r"(<!-- made: ([\w-]+) -->\n).*?(<!-- end -->\n)", re.DOTALL)
ROUTER = "tcp/127.0.0.1:7447"
MIB = 2**20


def filled_page(text: str) -> str:
    """The page with its tables made again. text: of docs/wire.md."""
    return MARKED.sub(lambda mark: mark[1] + BLOCKS[mark[2]]() + mark[3], text)


def message_classes() -> list[type[Message]]:
    """Every message, request and reply class, in the order of their sources."""
    values = [*vars(messages).values(), *vars(requests).values()]
    found = [v for v in values if isinstance(v, type) and issubclass(v, Message) and v is not Message]
    return list(dict.fromkeys(found))


def session_json(where: StackAddress, name: str) -> str:
    """The session's configuration as Zenoh reads it from a file, in a code block."""
    tree: dict[str, Any] = {}
    for path, value in session_settings(where, name).items():
        *folders, last = path.split("/")
        place = tree
        for folder in folders:
            place = place.setdefault(folder, {})
        place[last] = value
    text = json.dumps(tree, indent=2)
    short = re.sub(r"\{\s+(\"period_init_ms[^}]*?)\s+\}", lambda m: "{" + " ".join(m[1].split()) + "}", text)
    return f"```json\n{short}\n```\n"


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    return "".join(f"{line}\n" for line in markdown_table(head, list(rows)))


def _ports() -> str:
    return _table(("service", "port"), [(f"`{name}`", str(StackAddress().port(name))) for name in SERVICES])


def _dtypes() -> str:
    about = {"f": "float", "i": "signed integer", "u": "unsigned integer"}
    return _table(
        ("code", "dtype", "a value"),
        [(str(code), f"`{t.name}`", f"{about[t.kind]}, {t.itemsize} bytes") for code, t in DTYPES.items()],
    )


def _optional() -> str:
    rows = []
    for class_ in message_classes():
        names = [f"`{field.name}`" for field in fields_of(class_) if not field.required]
        if names:
            rows.append((f"[{class_.__name__}](messages.md#{class_.__name__.lower()})", " ".join(names)))
    return _table(("message", "may be left out"), rows)


def _enumerations() -> str:
    kinds = dict.fromkeys(field.kind for class_ in message_classes() for field in fields_of(class_))
    found = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, StrEnum)]
    return _table(
        ("enumeration", "values"), [(kind.__name__, ", ".join(f"`{value}`" for value in kind)) for kind in found]
    )


def _latched() -> str:
    rows = {topic.key: topic for topic in map(topic_of, LATCHED_KEYS) if topic is not None}
    return _table(
        ("key", "answered by"),
        [
            (f"`{key}/NAME`" if row.by == "*" else f"`{key}`", "each service" if row.by == "*" else _names(row.by))
            for key, row in rows.items()
        ],
    )


def _names(by: str) -> str:
    services = [name for name in by.split() if name != "operator"]
    return ", ".join(f"`{name}`" for name in services)


def _limits() -> str:
    return _table(
        ("what", "limit", "beyond it"),
        [
            (
                "a message, a request or a reply", f"{MAX_PAYLOAD // MIB} MiB",
                "a message is dropped and counted; a request is refused: `too_large`",
            ),
            ("what Zenoh passes on", f"{MAX_MESSAGE // MIB} MiB", "dropped without an error"),
            ("requests that wait in one service", str(MAX_REQUESTS), "refused: `busy`"),
            ("messages of one key that wait in a service", str(CAPACITY), "the oldest is dropped and counted"),
            ("poses of a route", str(requests.MAX_ROUTE_POSES), "refused: `bad_request`"),
            ("a stamp ahead of the stack's clock", duration(FUTURE), "not used, and counted"),
            ("silence until another session may publish", duration(SILENT_AFTER), "ignored, and counted as intruder"),
            ("number of a stack", str(MAX_DOMAIN), f"its ports begin at {BASE_PORT} + {PORTS_A_STACK} * number"),
        ],
    )  # fmt: skip


BLOCKS: dict[str, Callable[[], str]] = {
    "peer": lambda: session_json(StackAddress(), "sim"),
    "client": lambda: session_json(StackAddress(router=ROUTER), "sim"),
    "ports": _ports,
    "dtypes": _dtypes,
    "optional": _optional,
    "enumerations": _enumerations,
    "latched": _latched,
    "limits": _limits,
}
