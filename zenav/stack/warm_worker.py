# SPDX-License-Identifier: Apache-2.0
"""Compiles kernels for `zenav/stack/warm.py`, in a process of its own: JSON lines in and out.

In: {"service", "robot", "settings"}. Out: {"kernel", "seconds"} for each kernel that was compiled, and {"done", "wall"}
after each service. seconds: of CPU, without the kernels that it calls. The argument is the process that it ends with.
"""

import shared.repeatable  # noqa: F401  # before numpy; numba compiles for the machine that it names

# isort: split
import json
import sys
import time
from typing import Any

from numba.core import event

from shared.config import UserError, configured
from shared.kernel_cache import serialize_saves
from zenav.stack.process_guard import die_with_parent
from zenav.stack.service_loader import build_service


class _Timer(event.Listener):
    """Writes a line for each kernel of the stack, with the time of what numba compiles for it."""

    def __init__(self) -> None:
        self.open: list[list[float]] = []  # of the kernels being compiled: CPU at the begin, CPU of the inner ones

    def on_start(self, event: Any) -> None:
        self.open.append([time.process_time(), 0.0])

    def on_end(self, event: Any) -> None:
        begun, inner = self.open.pop()
        spent = time.process_time() - begun
        function = event.data["dispatcher"].py_func
        if not function.__module__.startswith(("services.", "shared.")):
            return  # numba's own: part of the kernel that needs it
        if self.open:
            self.open[-1][1] += spent
        _tell(kernel=f"{function.__module__}.{function.__name__}", seconds=spent - inner)


def main() -> None:
    """Warms service after service, until stdin ends.

    A refused configuration is reported, and ends it. Any other error ends it with its traceback.
    """
    die_with_parent(int(sys.argv[1]))
    serialize_saves()
    with event.install_listener("numba:compile", _Timer()):
        for line in sys.stdin:
            task = json.loads(line)
            begun = time.monotonic()
            try:
                file = configured(task["robot"], task["settings"])
                build_service(task["service"], file, file.robot).warm_up()
            except UserError as error:
                _tell(refused=error.what, hint=error.hint)
                return
            _tell(done=task["service"], wall=time.monotonic() - begun)


def _tell(**line: Any) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
