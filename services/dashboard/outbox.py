# SPDX-License-Identifier: Apache-2.0
"""What waits for one page: of a topic the newest message only, and small events in order. A slow page waits alone."""

from collections import OrderedDict, deque

MAX_EVENTS = 200
"""messages of topics with keep="all"; then the oldest are dropped."""
MAX_REPLIES = 500
"""replies and notes; a page that leaves so many unread is closed."""


class OutboxFullError(Exception):
    """The page does not read what it asked for."""


class Outbox:
    """Frames (bytes) for one page. Replies come first, then events, then the newest messages, oldest key first."""

    def __init__(self) -> None:
        self._replies: deque[bytes] = deque()
        self._events: deque[bytes] = deque(maxlen=MAX_EVENTS)
        self._latest: OrderedDict[str, bytes] = OrderedDict()

    def add_reply(self, frame: bytes) -> None:
        """A frame that must not be lost. Raises OutboxFullError."""
        if len(self._replies) >= MAX_REPLIES:
            raise OutboxFullError
        self._replies.append(frame)

    def add_event(self, frame: bytes) -> None:
        """A frame in a row of events."""
        self._events.append(frame)

    def set_latest(self, key: str, frame: bytes) -> None:
        """A frame that replaces an unread one of its key."""
        self._latest[key] = frame

    def drop(self, keys: set[str]) -> None:
        """Forgets unread messages of keys that the page wants no more."""
        for key in keys & self._latest.keys():
            del self._latest[key]

    def next(self) -> bytes | None:
        """The next frame to send; None: nothing waits."""
        if self._replies:
            return self._replies.popleft()
        if self._events:
            return self._events.popleft()
        return self._latest.popitem(last=False)[1] if self._latest else None
