# SPDX-License-Identifier: Apache-2.0
"""Checks whose imports and kernels do not stay in the launcher, from which all services are forked."""

import os
import sys
from collections.abc import Callable

from zenav.stack.fork_server import is_single_threaded


def begin_check(check: Callable[[], object]) -> Callable[[], None]:
    """Begins a check in a copy of this process. The returned function waits for its end, and raises what it raises.

    A check that failed there runs here once more, for its error. It runs only here where other threads could hold
    locks, which a copy would never get.
    """
    if sys.platform != "linux" or not is_single_threaded():
        return lambda: _run(check)
    pid = os.fork()
    if pid == 0:
        try:
            check()
            os._exit(0)
        finally:
            os._exit(1)

    def end() -> None:
        if os.waitpid(pid, 0)[1] != 0:
            _run(check)

    return end


def check_apart(check: Callable[[], object]) -> None:
    """Runs a check in a copy of this process. Raises what it raises."""
    begin_check(check)()


def _run(check: Callable[[], object]) -> None:
    check()
