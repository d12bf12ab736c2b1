# SPDX-License-Identifier: Apache-2.0
"""Checks whose imports and kernels do not stay in the launcher, from which all services are forked."""

import os
import sys
from collections.abc import Callable

from zenav.stack.fork_server import is_single_threaded


def check_apart(check: Callable[[], object]) -> None:
    """Runs a check in a copy of this process. Raises what it raises, for which it runs here once more.

    It runs only here where other threads could hold locks, which a copy would never get.
    """
    if sys.platform == "linux" and is_single_threaded():
        pid = os.fork()
        if pid == 0:
            try:
                check()
                os._exit(0)
            finally:
                os._exit(1)
        if os.waitpid(pid, 0)[1] == 0:
            return
    check()
