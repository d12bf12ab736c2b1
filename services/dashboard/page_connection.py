# SPDX-License-Identifier: Apache-2.0
"""One connected page in the shell: what it wants, what waits for it, and the task that sends it."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import msgpack

from services.dashboard.map_tiles import MapTiles, TileFeed
from services.dashboard.outbox import Outbox, OutboxFullError
from services.dashboard.web_guard import PageUser
from shared import topics
from shared.topics import topic_of

EVENT_KEYS = frozenset(t.key for t in (topics.LOG, topics.ESTOP, topics.GOAL, topics.RECOVERY, topics.ZONES))
"""Topics of small, rare messages: a page gets each of them."""
TILES_EVERY_S = 0.25
SEND_LIMIT_S = 10.0  # for one frame: a page that does not read for so long is gone
PAUSE_S = 0.02  # between two rounds of sending: messages of one moment leave together


class PageConnection:
    """One page. `send_all` runs until `end`."""

    def __init__(self, client: int, tiles: MapTiles, user: PageUser) -> None:
        self.client, self.user = client, user
        self.keys: frozenset[str] = frozenset()
        self.end_reason = ""
        self._outbox, self._feed = Outbox(), TileFeed(tiles)
        self._wakeup = asyncio.Event()
        self._tiles_at = float("-inf")

    def want(self, keys: frozenset[str]) -> None:
        """The topics that it shows from now on."""
        self._outbox.drop(set(self.keys - keys))
        if topics.MAP.key in keys - self.keys:
            self._feed.restart()
        self.keys = keys
        self.wake()

    def take(self, t: str, frame: bytes) -> None:
        """A frame of the core, of type `t`."""
        if t in ("drivers", "clients", "fleet"):
            self._outbox.set_latest(t, frame)
            self.wake()
        else:
            self._add_reply(frame)

    def reply(self, fields: dict[str, Any]) -> None:
        """A frame that must not be lost."""
        self._add_reply(bytes(msgpack.packb(fields)))

    def message(self, key: str, frame: bytes) -> None:
        """A message of a topic."""
        topic = topic_of(key)
        if topic is not None and topic.key in EVENT_KEYS:
            self._outbox.add_event(frame)
        else:
            self._outbox.set_latest(key, frame)
        self.wake()

    def wake(self) -> None:
        """Something may wait for it."""
        self._wakeup.set()

    def end(self, reason: str) -> None:
        """Lets `send_all` end."""
        self.end_reason = self.end_reason or reason
        self.wake()

    async def send_all(self, send: Callable[[bytes], Awaitable[None]]) -> str:
        """Sends what waits, until the end; returns its reason. Raises TimeoutError where the page does not read."""
        while not self.end_reason:
            await self._wakeup.wait()
            self._wakeup.clear()
            await self._send_waiting(send)
            for frame in self._tiles():
                await self._send(send, frame)
                await self._send_waiting(send)
            await asyncio.sleep(PAUSE_S)
        return self.end_reason

    async def _send_waiting(self, send: Callable[[bytes], Awaitable[None]]) -> None:
        while not self.end_reason and (frame := self._outbox.next()) is not None:
            await self._send(send, frame)

    async def _send(self, send: Callable[[bytes], Awaitable[None]], frame: bytes) -> None:
        async with asyncio.timeout(SEND_LIMIT_S):
            await send(frame)

    def _tiles(self) -> Iterator[bytes]:
        if topics.MAP.key not in self.keys or not self._feed.is_behind:
            return
        loop = asyncio.get_running_loop()
        wait = self._tiles_at + TILES_EVERY_S - loop.time()
        if wait > 0:
            loop.call_later(wait, self.wake)
            return
        self._tiles_at = loop.time()
        for fields in self._feed.frames():
            yield bytes(msgpack.packb(fields))

    def _add_reply(self, frame: bytes) -> None:
        try:
            self._outbox.add_reply(frame)
        except OutboxFullError:
            self.end("the page does not read its replies")
        self.wake()
