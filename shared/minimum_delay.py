# SPDX-License-Identifier: Apache-2.0
"""The shortest delay of messages from another computer lately, by clocks that differ, drift, and are set.

The method is our own. Received minus sent is the difference of both clocks plus the delay. Its minimum over some
seconds counts as no delay.
"""

from shared.types import NS_PER_S

WINDOW_NS = 10 * NS_PER_S
"""ns; a minimum is forgotten after one to two windows."""


class MinimumDelay:
    """The smallest difference of this window and of the one before, ns."""

    def __init__(self, difference: int, now: int) -> None:
        """difference: ns, received minus sent, of the first message, which came at `now` (ns)."""
        self._since, self._present, self._before = now, difference, difference

    @property
    def value(self) -> int:
        """ns."""
        return min(self._present, self._before)

    def add(self, difference: int, now: int) -> None:
        """Takes the difference of a message (ns) that came at `now` (ns)."""
        if not 0 <= now - self._since < 2 * WINDOW_NS:
            self._since, self._present, self._before = now, difference, difference
        elif now - self._since >= WINDOW_NS:
            self._since, self._present, self._before = now, difference, self._present
        self._present = min(self._present, difference)
