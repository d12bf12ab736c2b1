# SPDX-License-Identifier: Apache-2.0
"""Where Zenoh's callbacks file bytes and a service's loop picks them up: one place a key, bounded, never blocking."""

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal

CAPACITY = 1024  # messages a key with keep="all": 20 s of a 50 Hz topic


@dataclass(slots=True)
class Place:
    """One key's waiting items."""

    key: str
    keep: Literal["latest", "all"]
    capacity: int
    items: deque[Any]
    dropped: int = 0


class Inbox:
    """Items in the order of their arrival; an unread older one of a keep="latest" key gives way to the newer."""

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._order: deque[Place] = deque()
        self._open = True

    def place(self, key: str, keep: Literal["latest", "all"], capacity: int = CAPACITY) -> Place:
        """A new place for a key's items."""
        return Place(key, keep, capacity, deque())

    def file(self, place: Place, item: Any) -> bool:
        """Files an item; False when something was dropped for it."""
        with self._ready:
            if place.keep == "latest" and place.items:
                place.items[0] = item
                place.dropped += 1
                return False
            if len(place.items) >= place.capacity:
                place.items.popleft()
                place.items.append(item)
                place.dropped += 1
                return False
            place.items.append(item)
            self._order.append(place)
            self._ready.notify()
            return True

    def take(self, timeout: float) -> tuple[Place, Any] | None:
        """The next item, waiting at most `timeout` s; None when there is none, or on `wake`."""
        with self._ready:
            if not self._order and timeout > 0 and self._open:
                self._ready.wait(timeout)
            if not self._order:
                return None
            place = self._order.popleft()
            return place, place.items.popleft()

    def close(self) -> None:
        """Ends all waiting: safe to call from a signal handler's thread."""
        self._open = False
