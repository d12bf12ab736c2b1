# SPDX-License-Identifier: Apache-2.0
"""A debug topic that a service publishes only while a client watches (`requests.Watch`)."""

from shared.requests import Reply, Watch
from shared.service import Answer


class WatchedTopic:
    """Until when a client watches, and when the next message is due. Times are ns. period: between two messages."""

    def __init__(self, period: int) -> None:
        self._period = period
        self._until = self._next = 0

    def watch(self, request: Watch, now: int) -> Answer[Reply]:
        """Begins to publish from `now` on, or ends it."""
        self._until = now + round(request.seconds * 1e9)
        self._next = min(self._next, now)
        yield from ()
        return Reply(now, True, "", "")

    def is_due(self, now: int) -> bool:
        """Whether a message is due at `now`: then the next one is due a period later."""
        if now >= self._until or now < self._next:
            return False
        self._next = now + self._period
        return True
