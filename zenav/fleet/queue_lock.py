# SPDX-License-Identifier: Apache-2.0
"""One dispatcher for a queue: a lock on a file beside it, which ends with the process."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from shared.config import UserError


@contextmanager
def queue_lock(queue: Path) -> Iterator[None]:
    """Held while the block runs. Raises UserError where another process has it."""
    path = queue.with_name(queue.name + ".lock")
    try:
        file = path.open("w")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}", "name another file: --queue FILE") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(f"another process gives out the tasks of {queue}", "end that one first") from None
        yield
