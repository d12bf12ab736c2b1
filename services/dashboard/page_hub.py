# SPDX-License-Identifier: Apache-2.0
"""The shell's middle: it passes frames of pages to the core, and the core's orders and the stack's messages to pages.

All methods run on the loop of the shell's thread, but for `deliver`, which Zenoh's threads call.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import Any, Protocol

import msgpack

from services.dashboard.map_tiles import MapTiles
from services.dashboard.page_connection import EVENT_KEYS, PageConnection
from services.dashboard.web_guard import PageUser
from shared import topics
from shared.codec import CodecError, decode
from shared.config import UserError
from shared.reasons import BUSY
from shared.runners.client import refusal
from shared.runners.stack_listener import Deliver
from shared.topics import topic_of

SESSION_ENDED = "the login has ended"
SERVER_ENDED = "the page's server ends"
LINGER_S = 5.0
"""for which the session stays open after the last page: a reload needs it again."""
MAX_INCOMING = 4096  # messages that wait for the loop; then the oldest are dropped
MAX_ASKS = 16  # requests that wait for services at once
WATCH_SESSIONS_S = 2.0  # between two looks whether the sessions of open pages still hold
REFUSALS_S = 1.0  # between two reports of refused requests: a flood of them is one line
OTHER_TELEOP_S = 0.1  # between two notices that another tool drives


class Link(Protocol):
    """services.dashboard.stack_link.StackLink, as far as it is needed here. Its methods block."""

    is_simulated: bool

    def connect(self) -> object: ...

    def close(self) -> None: ...

    def listen_to(self, keys: frozenset[str]) -> None: ...

    def ask(self, key: str, payload: bytes) -> dict[str, Any]: ...


class Tools(Protocol):
    """services.dashboard.tool_process.ToolProcess, as far as it is needed here."""

    async def run(self, op: str, arguments: dict[str, Any]) -> dict[str, Any]: ...

    async def close(self) -> None: ...


class Sessions(Protocol):
    """services.dashboard.login_store.LoginStore, as far as it is needed here."""

    def is_open(self, digest: str) -> bool: ...


MakeLink = Callable[[Deliver, Callable[[], None]], Link]


class PageHub:
    """The open pages of a loop.

    to_core: takes an event for the core.  make_link: from `deliver` and `other_teleop`.  csrf: the token of the pages
    of a session, by its digest.  version: of this program.  robot: of a site, that its pages show.  numbers: of
    connections, where there are several hubs.
    """

    def __init__(
        self,
        to_core: Callable[[dict[str, Any]], None],
        make_link: MakeLink,
        tools: Tools,
        sessions: Sessions,
        csrf: Callable[[str], str],
        version: str,
        robot: str = "",
        numbers: Iterator[int] | None = None,
    ) -> None:
        self.tools = tools
        self._sessions, self._csrf = sessions, csrf
        self.link = make_link(self.deliver, self.other_teleop)
        self._to_core, self._version = to_core, version
        self._loop = asyncio.get_running_loop()
        self._pages: dict[int, PageConnection] = {}
        self._robot, self._numbers = robot, numbers or count(1)
        self._tiles = MapTiles()
        self._last: dict[str, bytes] = {}  # by key: the frame of the newest message
        self._incoming: deque[tuple[str, bytes, bool]] = deque(maxlen=MAX_INCOMING)
        self._lock = threading.Lock()
        self._is_scheduled = False
        self._listening: frozenset[str] = frozenset()
        self._one = ThreadPoolExecutor(1, thread_name_prefix="link")  # opening, closing and subscribing, in order
        self._asking = ThreadPoolExecutor(4, thread_name_prefix="ask")
        self._n_asks = self._n_opening = 0
        self._closing: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._other_at = self._refused_at = float("-inf")
        self._n_refused = 0
        self._watching: asyncio.TimerHandle | None = None

    async def opened(self, user: PageUser) -> PageConnection:
        """A page has connected."""
        if self._closing is not None:
            self._closing.cancel()
            self._closing = None
        trouble = ""
        self._n_opening += 1
        try:
            await self._loop.run_in_executor(self._one, self.link.connect)
        except UserError as error:
            trouble = f"{error.what}: {error.hint}"
        finally:
            self._n_opening -= 1
        number = next(self._numbers)
        page = self._pages[number] = PageConnection(number, self._tiles, user)
        event = {"event": "open", **_fields(user), "simulated": self.link.is_simulated, "version": self._version}
        self._to_core({"client": page.client, **event, **({"robot": self._robot} if self._robot else {})})
        if trouble:
            page.reply({"t": "note", "level": "error", "text": trouble, "hint": "reload the page when it runs"})
        if user.digest and self._watching is None:
            self._watching = self._loop.call_later(WATCH_SESSIONS_S, self._watch_sessions)
        return page

    def closed(self, page: PageConnection) -> None:
        """A page is gone."""
        if self._pages.pop(page.client, None) is None:
            return
        self._to_core({"client": page.client, "event": "close"})
        self._listen()
        if not self._pages:
            self._closing = self._loop.call_later(LINGER_S, self._close_link)

    def frame(self, page: PageConnection, data: bytes) -> None:
        """A page has sent a frame."""
        self._to_core({"client": page.client, "event": "frame", "data": data})

    def report(self, event: str, user: PageUser, what: str = "") -> None:
        """What a user did besides the frames of a page: an event of login_reports.py."""
        self._to_core({"client": None, "event": event, **_fields(user), "what": what})

    def report_refusal(self, address: str, what: str) -> None:
        """A request was refused."""
        self._n_refused += 1
        now = self._loop.time()
        if now - self._refused_at >= REFUSALS_S:
            self._refused_at = now
            self._to_core({"client": None, "event": "refused", "host": address, "what": what, "n": self._n_refused})
            self._n_refused = 0

    def end_session(self, digest: str, reason: str) -> None:
        """Closes the pages of a session. What it drives gets zero at once."""
        for page in [page for page in self._pages.values() if page.user.digest == digest]:
            self.closed(page)
            page.end(reason)

    def _watch_sessions(self) -> None:
        self._watching = None
        users = {page.user.digest: page.user for page in self._pages.values() if page.user.digest}
        ended = [user for digest, user in users.items() if not self._sessions.is_open(digest)]
        for user in ended:
            self.report("session_end", user)
            self.end_session(user.digest, SESSION_ENDED)
        if len(ended) < len(users):
            self._watching = self._loop.call_later(WATCH_SESSIONS_S, self._watch_sessions)

    @property
    def is_in_use(self) -> bool:
        """Whether a page is open, or opens."""
        return bool(self._pages) or self._n_opening > 0

    async def close(self) -> None:
        """Ends everything but the tools, which hubs share."""
        if self._watching is not None:
            self._watching.cancel()
        for page in list(self._pages.values()):
            page.end(SERVER_ENDED)
        for task in self._tasks:
            task.cancel()
        if self._closing is not None:
            self._closing.cancel()
        await self._loop.run_in_executor(self._one, self.link.close)
        self._one.shutdown(wait=False, cancel_futures=True)
        self._asking.shutdown(wait=False, cancel_futures=True)

    # --- from the core --------------------------------------------------------------------------------------------

    @property
    def pages(self) -> list[PageConnection]:
        """The open pages."""
        return list(self._pages.values())

    def take(self, order: dict[str, Any]) -> None:
        """A frame or an order of the core (outgoing.py)."""
        client = order.get("client")
        pages = list(self._pages.values()) if client is None else [p for p in (self._pages.get(client),) if p]
        if "frame" in order:
            for page in pages:
                page.take(order["t"], order["frame"])
        elif "hello" in order:
            for page in pages:
                page.reply({**order["hello"], "csrf": self._csrf(page.user.digest)})
        elif "want" in order:
            for page in pages:
                self._want(page, frozenset(order["want"]))
        elif "ask" in order:
            self._start(self._ask(client, order["id"], order["ask"], order["payload"]))
        elif "do" in order:
            self._start(self._do(client, order["id"], order["do"], order["args"]))

    def _want(self, page: PageConnection, keys: frozenset[str]) -> None:
        added = keys - page.keys
        page.want(keys)
        self._listen()
        for key in added & self._last.keys():
            page.message(key, self._last[key])

    def _listen(self) -> None:
        keys = frozenset().union(*(page.keys for page in self._pages.values()))
        if keys == self._listening:
            return
        self._listening = keys
        for key in self._last.keys() - keys:
            del self._last[key]
        if topics.MAP.key not in keys:
            self._tiles.clear()
        self._start(self._in_order(lambda: self.link.listen_to(keys)))

    def _close_link(self) -> None:
        self._closing = None
        if self.is_in_use:
            return
        self._start(self._in_order(self.link.close))

    async def _in_order(self, work: Callable[[], None]) -> None:
        await self._loop.run_in_executor(self._one, work)

    async def _ask(self, client: int | None, answered: Any, key: str, payload: bytes) -> None:
        if self._n_asks >= MAX_ASKS:
            reply = refusal(BUSY.code, BUSY.text, BUSY.hint)
        else:
            self._n_asks += 1
            try:
                reply = await self._loop.run_in_executor(self._asking, self.link.ask, key, payload)
            finally:
                self._n_asks -= 1
        self._reply(client, answered, reply)

    async def _do(self, client: int | None, answered: Any, op: str, arguments: dict[str, Any]) -> None:
        self._reply(client, answered, await self.tools.run(op, arguments))

    def _reply(self, client: int | None, answered: Any, reply: dict[str, Any]) -> None:
        page = self._pages.get(client) if client is not None else None
        if page is not None and answered is not None:
            page.reply({"t": "reply", "id": answered, **reply})

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # --- from the stack -------------------------------------------------------------------------------------------

    def deliver(self, key: str, payload: bytes, latched: bool) -> None:
        """A message of the stack, on a thread of Zenoh's: it is filed, and the loop wakes up once for many."""
        with self._lock:
            self._incoming.append((key, payload, latched))
            if self._is_scheduled:
                return
            self._is_scheduled = True
        self._wake(self._drain)

    def other_teleop(self) -> None:
        """Another tool drives, on a thread of Zenoh's."""
        self._wake(self._notice_other)

    def _wake(self, work: Callable[[], None]) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(work)

    def _notice_other(self) -> None:
        now = self._loop.time()
        if now - self._other_at >= OTHER_TELEOP_S:
            self._other_at = now
            self._to_core({"client": None, "event": "other_teleop"})

    def _drain(self) -> None:
        with self._lock:
            messages = list(self._incoming)
            self._incoming.clear()
            self._is_scheduled = False
        for key, payload, latched in messages:
            if key not in self._listening:
                continue
            if key == topics.MAP.key:
                self._map(payload)
            else:
                self._message(key, payload, latched)

    def _map(self, payload: bytes) -> None:
        try:
            update, envelope = decode(topics.MAP.type, payload)
        except CodecError:
            return  # as every reader of the map does; the readers among the services count it
        self._tiles.add(update, envelope.sent)
        for page in self._pages.values():
            page.wake()

    def _message(self, key: str, payload: bytes, latched: bool) -> None:
        if latched and key in self._last:
            return  # newer messages came before the latched value
        frame = bytes(msgpack.packb({"t": "m", "k": key, "b": payload}))
        topic = topic_of(key)
        if topic is not None and (topic.latched or topic.key not in EVENT_KEYS):
            self._last[key] = frame
        for page in self._pages.values():
            if key in page.keys:
                page.message(key, frame)


def _fields(user: PageUser) -> dict[str, str]:
    return {"host": user.address, "name": user.name, "role": str(user.role)}
