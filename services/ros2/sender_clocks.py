# SPDX-License-Identifier: Apache-2.0
"""The age of a message by the clock of its publisher, which is another computer's.

The method is our own. Received minus sent is the difference of both clocks plus the delay. Its minimum over some
seconds stands for no delay. What is above it is how much later the message came than others of the same publisher. So a
burst of old commands after a broken link is recognised, however wrong the clocks are.
"""

from dataclasses import dataclass

from shared.types import NS_PER_S

WINDOW_NS = 10 * NS_PER_S  # a minimum is forgotten after one to two windows: clocks drift, and are set
MAX_PUBLISHERS = 64  # of which clocks are known; the oldest is forgotten


@dataclass(slots=True)
class _Minima:
    """The smallest difference in this window and in the one before, ns."""

    since: int
    present: int
    before: int


class SenderClocks:
    """Ages of messages by publisher."""

    def __init__(self) -> None:
        self._minima: dict[bytes, _Minima] = {}

    def age(self, gid: bytes, sent: int, now: int) -> int:
        """ns by which a message is later than the fastest one of its publisher in the last 10 to 20 s, 0 or more.

        gid: of the publisher.  sent: ns on its clock.  now: ns on ours, when the message came.

        A clock that was set back makes messages look old until its old minimum is forgotten. The first message of a
        publisher has age 0.
        """
        difference = now - sent
        minima = self._minima.pop(gid, None)
        if minima is None or not 0 <= now - minima.since < 2 * WINDOW_NS:
            minima = _Minima(now, difference, difference)
        elif now - minima.since >= WINDOW_NS:
            minima = _Minima(now, difference, minima.present)
        minima.present = min(minima.present, difference)
        self._minima[gid] = minima
        if len(self._minima) > MAX_PUBLISHERS:
            del self._minima[next(iter(self._minima))]
        return difference - min(minima.present, minima.before)
