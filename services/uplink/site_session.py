# SPDX-License-Identifier: Apache-2.0
"""The session with the site's router: what goes out, what comes in, and this robot's name.

The callbacks run on Zenoh's threads: they file, and return. Zenoh itself finds a router again that was away. What is
sent meanwhile is lost: nothing waits, so nothing comes in a burst.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from services.uplink.outgoing import LAST
from shared.config import UserError
from shared.credentials import Credentials
from shared.crossing import INWARD_KEYS, OUTWARD_KEYS, SERVED_KEYS, SHARED_KEYS
from shared.runners.presence import announce
from shared.runners.transport import opened_site, oversize

URGENT = ("guard/status", "nav/status")


@dataclass(frozen=True, slots=True)
class SiteEvents:
    """Takers of what comes from the site, by keys without the robot's name.

    order: key and bytes of a message.  heard: the same of another robot's message, its key with that robot's name.
    ask: key, bytes, and a function that sends the reply; without a reply the asker's time runs out.  value: the last
    value of a key, empty where there is none.
    """

    order: Callable[[str, bytes], None]
    heard: Callable[[str, bytes], None]
    ask: Callable[[str, bytes, Callable[[bytes], None]], None]
    value: Callable[[str], bytes]


class SiteSession:
    """Opens at once. Raises UserError where no router answers, or another robot of this name is there."""

    def __init__(self, endpoint: str, credentials: Credentials, robot: str, events: SiteEvents) -> None:
        self._robot, self._events = robot, events
        self._session = opened_site(endpoint, credentials)
        self._declared: list[Any] = []
        try:
            self._token = announce(self._session, robot, is_shared=True)
        except UserError:
            self.close()
            raise
        self._publishers = {key: self._publisher(key) for key in OUTWARD_KEYS}
        for key in INWARD_KEYS:
            self._declared.append(self._session.declare_subscriber(self._full(key), partial(self._order, key)))
        for key in SHARED_KEYS:
            self._declared.append(self._session.declare_subscriber(f"*/{key}", self._heard))
        for key in SERVED_KEYS:
            serve = self._answer if key in OUTWARD_KEYS else self._ask
            self._declared.append(self._session.declare_queryable(self._full(key), partial(serve, key)))

    @property
    def is_up(self) -> bool:
        """Whether the router is there."""
        return bool(list(self._session.info.routers_zid()))

    def put(self, key: str, payload: bytes) -> None:
        """Sends a message to the site; a link that is full drops it."""
        self._publishers[key].put(payload)

    def close(self) -> None:
        """Ends it."""
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's own

    def _publisher(self, key: str) -> zenoh.Publisher:
        priority = zenoh.Priority.INTERACTIVE_HIGH if key in URGENT else zenoh.Priority.DATA
        bulk = any(key == last or key.startswith(f"{last}/") for last in LAST)
        return self._session.declare_publisher(
            self._full(key),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.BACKGROUND if bulk else priority,
        )

    def _full(self, key: str) -> str:
        return f"{self._robot}/{key}"

    def _order(self, key: str, sample: zenoh.Sample) -> None:
        if not oversize(sample.payload):
            self._events.order(key, sample.payload.to_bytes())

    def _heard(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if not key.startswith(self._full("")) and not oversize(sample.payload):
            self._events.heard(key, sample.payload.to_bytes())

    def _answer(self, key: str, query: zenoh.Query) -> None:
        with query:
            if value := self._events.value(key):
                query.reply(self._full(key), value)

    def _ask(self, key: str, query: zenoh.Query) -> None:
        payload = query.payload.to_bytes() if query.payload is not None else b""

        def reply(data: bytes) -> None:
            with query:
                query.reply(self._full(key), data)

        if oversize(payload):
            query.drop()  # type: ignore[no-untyped-call]  # zenoh's own
        else:
            self._events.ask(key, payload, reply)
