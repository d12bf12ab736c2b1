# SPDX-License-Identifier: Apache-2.0
"""Single keys from the terminal."""

import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from shared.config import UserError


@contextmanager
def raw_terminal() -> Iterator[int]:
    """The terminal gives each key at once, without showing it, until the block ends. Raises UserError without one."""
    if not sys.stdin.isatty():
        raise UserError("teleop needs a keyboard: its input is no terminal", "run it in a terminal; over ssh: ssh -t")
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield descriptor
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
