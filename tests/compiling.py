# SPDX-License-Identifier: Apache-2.0
"""For scripts that tests run in a process of their own: what was warmed compiles nothing any more."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event
from numba.core.dispatcher import Dispatcher


class _Ends(event.Listener):
    def on_start(self, event: Any) -> None:
        compiled = event.data["dispatcher"].py_func
        if compiled.__module__.startswith(("services", "shared")):
            raise SystemExit(f"compiled while driving: {compiled}")

    def on_end(self, event: Any) -> None:
        pass


def _signatures() -> set[str]:
    """Every kernel of the stack with the signatures that it has in this process, compiled or loaded."""
    return {
        f"{name}.{kernel}{signature}"
        for name, module in list(sys.modules.items())
        if name.startswith(("services.", "shared."))
        for kernel, value in vars(module).items()
        if isinstance(value, Dispatcher)
        for signature in value.signatures
    }


@contextmanager
def nothing_compiles() -> Iterator[None]:
    """Ends the process with a word where a kernel of the stack is compiled inside, or loaded from the cache.

    A kernel that is loaded from the cache was compiled by something else: with an empty cache it would compile here.
    """
    before = _signatures()
    with event.install_listener("numba:compile", _Ends()):
        yield
    late = sorted(_signatures() - before)
    if late:
        raise SystemExit("not warmed, but used while driving:\n" + "\n".join(late))
