# SPDX-License-Identifier: Apache-2.0
"""Starts a service that ends with its launcher: `python -P -m zenav.stack.process_guard LAUNCHER_PID MODULE ...`.

The child asks for it itself, before it imports anything: no code runs between fork and exec of a launcher with threads.
"""

import ctypes
import os
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1


def die_with_parent(parent: int) -> None:
    """From now on this process is killed when its parent, whose number was `parent`, is gone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # it died meanwhile


def main() -> None:
    launcher, module = int(sys.argv[1]), sys.argv[2]
    die_with_parent(launcher)
    sys.argv[:] = [module, *sys.argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
