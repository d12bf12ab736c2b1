# SPDX-License-Identifier: Apache-2.0
"""For scripts that tests run in a process of their own: what was warmed compiles nothing any more."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


class _Ends(event.Listener):
    def on_start(self, event: Any) -> None:
        compiled = event.data["dispatcher"].py_func
        if compiled.__module__.startswith(("services", "shared")):
            raise SystemExit(f"compiled while driving: {compiled}")

    def on_end(self, event: Any) -> None:
        pass


@contextmanager
def nothing_compiles() -> Iterator[None]:
    """Ends the process with a word where a kernel of the stack is compiled inside."""
    with event.install_listener("numba:compile", _Ends()):
        yield
