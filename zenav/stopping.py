# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM as an event that loops wait on, so that everything is closed in order."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stopping() -> Iterator[threading.Event]:
    """The event is set by SIGINT and SIGTERM inside the block; the handlers of before come back after it."""
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
