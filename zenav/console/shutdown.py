# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and a closed terminal as a flag that loops wait on, so that everything is closed in order."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import TIMEOUT_MAX


class StopFlag:
    """Set once, and for good. `set` may come from a signal handler that interrupts `wait`.

    A threading.Event may not: its lock is not reentrant, so a handler that sets it can wait for itself for ever.
    SimpleQueue's `put` is made for handlers.
    """

    def __init__(self) -> None:
        self._asked = False
        self._wake: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        """Ends this and every later wait."""
        self._asked = True
        self._wake.put(None)

    def is_set(self) -> bool:
        return self._asked

    def wait(self, seconds: float) -> bool:
        """Whether it is set, as soon as it is, or after so many seconds. For one waiting thread."""
        if not self._asked:
            with suppress(Empty):
                self._wake.get(timeout=min(seconds, TIMEOUT_MAX))
        return self._asked


@contextmanager
def stop_on_signal() -> Iterator[StopFlag]:
    """It is set by SIGINT, SIGTERM and SIGHUP inside the block; the handlers of before come back after it.

    SIGHUP stays ignored where it was: that is what nohup does.
    """
    stop = StopFlag()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
