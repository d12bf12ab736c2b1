# SPDX-License-Identifier: Apache-2.0
"""Queue between Zenoh's callbacks and a service's loop: one bounded slot for each key, which never blocks."""

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

CAPACITY = 1024  # messages a key with keep="all": 20 s of a 50 Hz topic


@dataclass(slots=True)
class Slot:
    """One key's waiting items."""

    key: str
    keep: Literal["latest", "all"]
    capacity: int
    items: deque[Any]
    dropped: int = 0


class Inbox:
    """Items in the order of arrival. In a slot with keep="latest" a new item replaces an unread one, and comes last.

    In the place of the unread one it would overtake what arrived before it. After a pause of the process, a scan would
    come before the odometry of a second.
    """

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._order: deque[Slot] = deque()
        self._open = True

    def slot(self, key: str, keep: Literal["latest", "all"], capacity: int = CAPACITY) -> Slot:
        """A new slot for a key's items."""
        return Slot(key, keep, capacity, deque())

    def file(self, slot: Slot, item: Any) -> bool:
        """Files an item; False when something was dropped for it."""
        with self._ready:
            if slot.keep == "latest" and slot.items:
                slot.items[0] = item
                slot.dropped += 1
                self._order.remove(slot)
                self._order.append(slot)
                return False
            if len(slot.items) >= slot.capacity:
                slot.items.popleft()
                slot.items.append(item)
                slot.dropped += 1
                return False
            slot.items.append(item)
            self._order.append(slot)
            self._ready.notify()
            return True

    def take(self, timeout: float) -> tuple[Slot, Any] | None:
        """The next item, waiting at most `timeout` s; None when there is none."""
        with self._ready:
            if not self._order and timeout > 0 and self._open:
                self._ready.wait(timeout)
            if not self._order:
                return None
            slot = self._order.popleft()
            return slot, slot.items.popleft()

    def take_waiting(self) -> Iterator[tuple[Slot, Any]]:
        """The items that wait now, one by one; none that comes meanwhile."""
        for _ in range(len(self._order)):
            if (item := self.take(0)) is not None:
                yield item

    def close(self) -> None:
        """Later calls of `take` do not wait; one that waits ends by its timeout. A signal handler may call it."""
        self._open = False
