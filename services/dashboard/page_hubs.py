# SPDX-License-Identifier: Apache-2.0
"""The hubs of a page's server: one for its robot, or at a site one for each robot that a page shows; and the fleet.

All methods run on the loop of the shell's thread.
"""

import asyncio
import re
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import count
from typing import Any

import msgpack

from services.dashboard.fleet_feed import FleetFeed, Rows
from services.dashboard.page_connection import PageConnection
from services.dashboard.page_hub import LINGER_S, PageHub
from services.dashboard.web_guard import PageUser

MAX_STOPS = 256
"""orders of STOP and of its release at once, each on a thread: more than there can be pages. None waits for another."""
ROBOT_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
MakeHub = Callable[[str, Any], PageHub]
"""Makes the hub of a robot with the numbers of its connections."""
MakeFeed = Callable[[Callable[[Rows], None]], FleetFeed]


class PageHubs:
    """robot: that a page of a site shows first; empty where there is one robot.  make_feed: None without a router."""

    def __init__(self, robot: str, make_hub: MakeHub, make_feed: MakeFeed | None) -> None:
        self._make_hub, self._make_feed = make_hub, make_feed
        self._loop, self._numbers = asyncio.get_running_loop(), count(1)
        self._robot, self._is_site = robot, bool(robot)
        self.first = make_hub(robot, self._numbers)
        self._hubs: dict[str, PageHub] = {robot: self.first}
        self._feed: FleetFeed | None = None
        self._rows = b""  # the newest frame
        self._under_way: set[tuple[tuple[str, ...], bool]] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._stopping = ThreadPoolExecutor(MAX_STOPS, thread_name_prefix="stop")

    async def opened(self, user: PageUser, robot: str) -> tuple[PageHub, PageConnection]:
        """A page has connected, which shows a robot."""
        hub = self._hub(robot)
        page = await hub.opened(user)
        if self._feed is None and self._make_feed is not None:
            self._feed = self._make_feed(self._hear)
        if self._rows:
            page.take("fleet", self._rows)
        return hub, page

    def closed(self, hub: PageHub, page: PageConnection) -> None:
        """A page is gone. The feed ends with the last one, and a hub some time after its last one."""
        hub.closed(page)
        if not hub.is_in_use:
            self._loop.call_later(LINGER_S, self._remove_unused)
        if self._feed is not None and not any(hub.pages for hub in self._hubs.values()):
            self._feed.close()
            self._feed, self._rows = None, b""

    def take(self, order: dict[str, Any]) -> None:
        """A frame or an order of the core."""
        client = order.get("client")
        if "stop" in order:
            self._start(self._stop(order))
            return
        for hub in list(self._hubs.values()):
            if client is None or any(page.client == client for page in hub.pages):
                hub.take(order)
                if "ask" in order:
                    return

    def end_session(self, digest: str, reason: str) -> None:
        """Closes the pages of a session."""
        for hub in self._hubs.values():
            hub.end_session(digest, reason)

    async def close(self) -> None:
        """Ends everything."""
        if self._feed is not None:
            self._feed.close()
        for task in self._tasks:
            task.cancel()
        self._stopping.shutdown(wait=False, cancel_futures=True)
        for hub in self._hubs.values():
            await hub.close()
        await self.first.tools.close()

    def _hub(self, robot: str) -> PageHub:
        known = self._hubs.get(robot)
        if known is not None or not self._is_site or not ROBOT_NAME.fullmatch(robot):
            return known or self.first
        hub = self._hubs[robot] = self._make_hub(robot, self._numbers)
        return hub

    def _remove_unused(self) -> None:
        for robot, hub in list(self._hubs.items()):
            if hub is not self.first and not hub.is_in_use:
                del self._hubs[robot]
                self._start(hub.close())

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _stop(self, order: dict[str, Any]) -> None:
        key = tuple(order["stop"] or ()), order["pressed"]
        if self._feed is None or key in self._under_way:  # a page repeats STOP until it is confirmed
            return
        self._under_way.add(key)
        try:
            await self._confirm(self._feed, order)
        finally:
            self._under_way.discard(key)

    async def _confirm(self, feed: FleetFeed, order: dict[str, Any]) -> None:
        work = partial(feed.stop, order["stop"], order["pressed"], order["by"])
        confirmed, failed = await self._loop.run_in_executor(self._stopping, work)
        word = "STOP is pressed on" if order["pressed"] else "STOP is released on"
        fields = {"t": "note", "level": "info", "text": f"{word} {', '.join(confirmed)}", "hint": ""}
        if failed or not confirmed:
            text = f"STOP is not confirmed: {', '.join(failed) or 'no robot is heard'}"
            fields = {"t": "note", "level": "error", "text": text, "hint": "switch them off by hand"}
        answers = {"answers": "stop_all"} if order["stop"] is None else {}
        self._reply(order["client"], fields | answers)

    def _reply(self, client: int, fields: dict[str, Any]) -> None:
        for hub in self._hubs.values():
            for page in hub.pages:
                if page.client == client:
                    page.reply(fields)

    def _hear(self, rows: Rows) -> None:
        """On the thread of the feed."""
        frame = bytes(msgpack.packb({"t": "fleet", "robots": rows}))
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._send, frame)

    def _send(self, frame: bytes) -> None:
        self._rows = frame
        for hub in self._hubs.values():
            for page in hub.pages:
                page.take("fleet", frame)
