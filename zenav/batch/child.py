# SPDX-License-Identifier: Apache-2.0
"""The process in which an item's work runs: `python -m zenav.batch.child PARENT_PID FILE_DESCRIPTOR`.

It takes (work, item) from its parent and returns a ChildReply, again and again. It ends with its parent, or when idle.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any

from zenav.batch.child_reply import ChildReply
from zenav.stack.process_guard import die_with_parent

MAX_IDLE_S = 60.0  # a worker of a cluster stays, but it need not keep the memory of its last recording


def serve(link: "Connection[Any, Any]") -> None:
    """Works until the parent closes the link, or sends nothing for a minute."""
    while link.poll(MAX_IDLE_S):
        try:
            work, item = link.recv()
        except EOFError:
            return
        try:
            reply = ChildReply(work(item))
        except MemoryError:
            reply = ChildReply(error="MemoryError", out_of_memory=True)
        except Exception as error:
            reply = ChildReply(error="".join(traceback.format_exception(error)[-2:]).strip())
        link.send(reply)


def main() -> None:
    die_with_parent(int(sys.argv[1]))
    sys.stdout = sys.stderr  # the parent's stdout is for its table
    with Connection(int(sys.argv[2])) as link:
        serve(link)


if __name__ == "__main__":
    main()
