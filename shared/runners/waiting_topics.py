# SPDX-License-Identifier: Apache-2.0
"""Messages that wait for a service's next event. Zenoh stores them in a ring, and no Python code runs on their arrival.

To wake a process costs more than to handle most messages (docs/decisions.md).
"""

from collections.abc import Iterator

import zenoh

from shared.messages import Message
from shared.runners.inbox import CAPACITY
from shared.topics import Topic


class WaitingTopics:
    """The rings of one service's session. A full one drops its oldest message; with keep="latest" it holds one."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._session, self._robot = session, robot
        self._rings: dict[str, zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]] = {}

    def add(self, topic: Topic[Message]) -> None:
        """Subscribes to a topic."""
        capacity = CAPACITY if topic.keep == "all" else 1
        key = f"{self._robot}/{topic.key}"
        self._rings[topic.key] = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(capacity))

    def take(self) -> Iterator[tuple[str, zenoh.ZBytes]]:
        """The key and payload of each message that waits; of a topic in the order of arrival."""
        for key, ring in self._rings.items():
            for _ in range(CAPACITY):  # not for ever, where they come faster than they are handled
                if (sample := ring.try_recv()) is None:
                    break
                yield key, sample.payload
