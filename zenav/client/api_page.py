# SPDX-License-Identifier: Apache-2.0
"""docs/api.md: the Python API for programs of users, from the docstrings and types of `zenav.client`."""

import inspect
import re
from collections.abc import Iterator
from typing import Any

import zenav.client

INTRODUCTION = """\
# The Python API

<!-- made from the code by `make docs`; edit the code instead -->

`zenav.client` drives a robot whose stack runs. Its calls are synchronous and typed. Lengths are m, times s, angles
degrees.

```python
from zenav.client import connect

with connect() as robot:
    robot.explore()
    result = robot.goto(2.0, -1.0, 90)
    print(result.text, robot.pose())
```

An error that the user can fix is a `shared.config.UserError`: `what` and `hint`. The program
[explore_and_visit.py](../examples/explore_and_visit.py) shows most of it. `robot.client` is the `Client` below, the
session for all topics and requests of [messages.md](messages.md). Programs in other languages use [the wire](wire.md).
"""


def api_page() -> str:
    """The content of docs/api.md."""
    lines = [INTRODUCTION]
    for name in zenav.client.__all__:
        lines += _entry(name, getattr(zenav.client, name))
    return "\n".join(lines).rstrip("\n") + "\n"


def _entry(name: str, value: Any) -> Iterator[str]:
    yield f"## {name}\n"
    if inspect.isfunction(value):
        yield f"    {name}{_signature(value)}\n"
    yield f"{_text(value)}\n"
    if not inspect.isclass(value):
        return
    for member, function in vars(value).items():
        if inspect.isfunction(function) and not member.startswith("_"):
            yield f"### {name}.{member}\n"
            yield f"    {member}{_signature(function)}\n"
            yield f"{_text(function)}\n"


def _signature(function: Any) -> str:
    """Parameters and types as they are called, without `self` and module names."""
    signature = inspect.signature(function)
    text = str(signature.replace(parameters=[p for p in signature.parameters.values() if p.name != "self"]))
    return re.sub(r"(?:\b[a-z_]\w*\.)+(?=[A-Za-z])|~", "", text)


def _text(value: Any) -> str:
    return inspect.cleandoc(value.__doc__ or "").replace("\n    ", "\n")
