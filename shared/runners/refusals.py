# SPDX-License-Identifier: Apache-2.0
"""What a live runner rejects before its service sees it: it tells the service a few times a second."""

from collections import deque
from collections.abc import Sized

from shared.rejections import Kind
from shared.runners import transport
from shared.runners.host import Host
from shared.runners.inbox import CAPACITY

TELL = 50_000_000
"""ns between two tellings: a flood must not fill the journal."""


class Refusals:
    """Counts of rejected messages, by key and kind, until the service is told."""

    def __init__(self) -> None:
        self._oversized: deque[tuple[str, str]] = deque(maxlen=CAPACITY)  # key, words: filed by Zenoh's threads
        self._untold: dict[tuple[str, Kind], tuple[int, str]] = {}
        self._told_at = 0

    def oversized(self, key: str, payload: Sized) -> str:
        """Notes a message that is too large, and returns what is wrong in words; empty where it is not. Any thread."""
        words = transport.oversize(payload)
        if words:
            self._oversized.append((key, words))
        return words

    def sequence(self, key: str, words: str) -> None:
        """Notes a message that was sent before one that was used, or is one of them."""
        self._note(key, Kind.SEQUENCE, words)

    def tell(self, host: Host, now: int) -> None:
        """Tells the service of `host` what was noted since the last time: it may stand because of that. now: ns."""
        while self._oversized:
            key, words = self._oversized.popleft()
            self._note(key, Kind.SIZE, words)
        if self._untold and not 0 <= now - self._told_at < TELL:
            self._told_at = now
            for (key, kind), (n, words) in self._untold.items():
                host.rejected(key, kind, words, n, now)
            self._untold.clear()

    def _note(self, key: str, kind: Kind, words: str) -> None:
        self._untold[key, kind] = self._untold.get((key, kind), (0, ""))[0] + 1, words
