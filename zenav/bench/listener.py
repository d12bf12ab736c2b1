# SPDX-License-Identifier: Apache-2.0
"""Waits for a process that a benchmark has started."""

import socket
import threading
import time
from contextlib import suppress

from shared.config import UserError

READY_S = 20.0


def wait_for_listener(address: str) -> None:
    """Returns when something listens at HOST:PORT. Raises UserError after READY_S."""
    host, _, port = address.rpartition(":")
    limit = time.monotonic() + READY_S
    while True:
        with suppress(OSError), socket.create_connection((host, int(port)), 1.0):
            return
        if time.monotonic() > limit:
            raise UserError(f"nothing listens at {address}", "is the port taken?")
        threading.Event().wait(0.1)
