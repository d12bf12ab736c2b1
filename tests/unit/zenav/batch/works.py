# SPDX-License-Identifier: Apache-2.0
"""Works of the tests, which the child processes of a batch import."""

import os
import signal
import time
from pathlib import Path

import numpy as np


def double(item: int) -> int:
    return 2 * item


def pid(_: object) -> int:
    return os.getpid()


def misbehave(item: str) -> str:
    """What the item says: raise, die, hang, eat, and anything else comes back."""
    if item == "raise":
        raise ValueError("bad data")
    if item == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "hang":
        time.sleep(600)  # noqa: TID251  # what hangs
    if item == "eat":
        held = np.ones(600_000_000, np.uint8)
        time.sleep(600)  # noqa: TID251  # keeps it
        return str(held[0])
    return item


def die_once(marker: str) -> str:
    """The first try kills its process."""
    path = Path(marker)
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "came through"
