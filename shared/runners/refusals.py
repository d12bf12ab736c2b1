# SPDX-License-Identifier: Apache-2.0
"""Messages that a live runner rejects before its service. It reports them to the service 20 times a second at most."""

from collections import deque
from collections.abc import Sized

from shared.rejections import RejectionCause
from shared.runners import transport
from shared.runners.host import Host
from shared.runners.inbox import CAPACITY

REPORT_PERIOD_NS = 50_000_000
"""Between two reports: a flood of bad messages must not fill the journal."""


class Refusals:
    """Counts of rejected messages by key and cause, until the next report."""

    def __init__(self) -> None:
        self._oversized: deque[tuple[str, str]] = deque(maxlen=CAPACITY)  # key, words: filed by Zenoh's threads
        self._unreported: dict[tuple[str, RejectionCause], tuple[int, str]] = {}
        self._reported_at = 0

    def oversized(self, key: str, payload: Sized) -> str:
        """Notes a message that is too large. Returns the fault in words, else an empty string. Thread-safe."""
        words = transport.oversize(payload)
        if words:
            self._oversized.append((key, words))
        return words

    def sequence(self, key: str, words: str) -> None:
        """Notes a message that is repeated, or older than one that was used."""
        self._note(key, RejectionCause.SEQUENCE, words)

    def report(self, host: Host, now: int) -> None:
        """Reports the new rejections to the service of `host`, which may stop because of them. now: ns."""
        while self._oversized:
            key, words = self._oversized.popleft()
            self._note(key, RejectionCause.SIZE, words)
        if self._unreported and not 0 <= now - self._reported_at < REPORT_PERIOD_NS:
            self._reported_at = now
            for (key, kind), (n, words) in self._unreported.items():
                host.rejected(key, kind, words, n, now)
            self._unreported.clear()

    def _note(self, key: str, kind: RejectionCause, words: str) -> None:
        self._unreported[key, kind] = self._unreported.get((key, kind), (0, ""))[0] + 1, words
