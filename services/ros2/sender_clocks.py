# SPDX-License-Identifier: Apache-2.0
"""The age of a message by the clock of its publisher, which is another computer's.

The shortest delay of a publisher (shared/minimum_delay.py) counts as none. What is above it is how much later the
message came than others of the same publisher. So a burst of old commands after a broken link is recognised, however
wrong the clocks are.
"""

from shared.minimum_delay import MinimumDelay

MAX_PUBLISHERS = 64  # of which clocks are known; the oldest is forgotten


class SenderClocks:
    """Ages of messages by publisher."""

    def __init__(self) -> None:
        self._minima: dict[bytes, MinimumDelay] = {}

    def age(self, gid: bytes, sent: int, now: int) -> int:
        """ns by which a message is later than the fastest one of its publisher in the last 10 to 20 s, 0 or more.

        gid: of the publisher.  sent: ns on its clock.  now: ns on ours, when the message came.

        A clock that was set back makes messages look old until its old minimum is forgotten. The first message of a
        publisher has age 0.
        """
        difference = now - sent
        minimum = self._minima.pop(gid, None) or MinimumDelay(difference, now)
        minimum.add(difference, now)
        self._minima[gid] = minimum
        if len(self._minima) > MAX_PUBLISHERS:
            del self._minima[next(iter(self._minima))]
        return difference - minimum.value
