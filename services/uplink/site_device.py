# SPDX-License-Identifier: Apache-2.0
"""The shell of the link: the device `tls://HOST:PORT` behind the service's port.

It has a session with the stack and one with the site, and a thread that passes what is due. Zenoh's threads only file
bytes, in queues that are bounded. A link that hangs delays this process alone.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import msgpack

from services.uplink.config import UplinkConfig
from services.uplink.outgoing import Level, Outgoing
from services.uplink.service import PORT
from services.uplink.token_bucket import TokenBucket
from shared import requests, topics
from shared.codec import Envelope, encode
from shared.config import UserError
from shared.credentials import Credentials, credentials_for, read_credentials, tls_endpoint
from shared.crossing import CROSSING_REQUESTS
from shared.messages import PortState, SerialData
from shared.reasons import BUSY, NOT_RUNNING, Reason
from shared.requests import Request
from shared.runners.devices import DeviceContext
from shared.runners.stack_listener import StackListener
from shared.topics import Publication

PERIOD_S = 0.1  # between two looks at what is due
LOOK_S = 0.5  # between two looks whether the router is there
REPORT_S = 5.0
MIN_RETRY_S, MAX_RETRY_S = 2.0, 30.0  # between two tries to reach the site
MAX_INCOMING = 2000  # messages of the stack that wait; then the oldest are left out
MAX_HEARD = 200  # messages of other robots that wait, at most
MAX_ASKS = 16  # requests of the site that wait for the stack
ASK_LIMIT_S = 5.0
RECORDING_BURST_S = 1.0
Reply = Callable[[bytes], None]


def site_device(context: DeviceContext) -> "SiteDevice":
    """The device of a configuration, not yet open. Raises UserError where address or credentials are wrong."""
    return SiteDevice(context)


class SiteDevice:
    """See the module. Its events are messages of topics.RX, and it takes those of topics.TX."""

    def __init__(self, context: DeviceContext) -> None:
        self._context = context
        self._config = cast(UplinkConfig, context.section)
        self.endpoint = site_endpoint(context.config.device)
        self._credentials = robot_credentials(self.endpoint, self._config.credentials, context.robot)
        self._closing = threading.Event()
        self._lock = threading.Lock()  # of `_outgoing`
        self._outgoing = Outgoing(f"{time.time_ns():x}")
        self._incoming: deque[tuple[str, bytes, int | None]] = deque(maxlen=MAX_INCOMING)
        self._heard: deque[tuple[str, bytes]] = deque(maxlen=MAX_HEARD)  # key with the robot's name
        self._level = Level.REST
        self._replies: dict[int, tuple[Request[Any, Any], bytes, Reply]] = {}  # by id
        self._n_asks = 0
        self._state: tuple[bool, str] | None = None
        self._pool = ThreadPoolExecutor(4, thread_name_prefix="ask")
        self._recording_bucket = TokenBucket(self._config.recording_rate * 1e3, RECORDING_BURST_S)
        self._stack = StackListener(context.robot, context.where, self._hear)
        self._thread = threading.Thread(target=self._run, name="site", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Orders of the core."""
        order = msgpack.unpackb(data)
        if "level" in order:
            self._level = Level(order["level"])
            return
        asked = order.get("ask", order.get("reply"))
        with self._lock:
            row, payload, reply = self._replies.pop(asked, (None, b"", None))
        if row is None or reply is None:
            return
        if "reply" in order:
            self._reply(reply, order["data"])
        else:
            with suppress(RuntimeError):  # it is being closed
                self._pool.submit(self._ask_stack, row, payload, reply)

    def plug(self, plugged: bool) -> None:
        """There is nothing to unplug."""

    def close(self) -> None:
        self._closing.set()
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._thread.is_alive():
            self._thread.join(2.0)

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        from services.uplink.site_session import SiteEvents, SiteSession  # Zenoh's session

        events = SiteEvents(self._on_order, self._on_heard, self._on_ask, self._last_value)
        retry = MIN_RETRY_S
        while not self._closing.is_set():
            try:
                self._stack.connect()
                site = SiteSession(self.endpoint, self._credentials, self._context.robot, events)
            except UserError as error:
                self._publish_state(False, f"{error.what}: {error.hint}")
                self._closing.wait(retry)
                retry = min(2 * retry, MAX_RETRY_S)
                continue
            retry = MIN_RETRY_S
            try:
                self._serve(site)
            except Exception as error:  # Zenoh's, of many kinds: both sessions begin again
                self._publish_state(False, f"{self.endpoint}: {error}")
                self._closing.wait(retry)
            finally:
                site.close()
                self._stack.close()

    def _serve(self, site: Any) -> None:
        level: Level | None = None
        looked, reported, n_bytes, is_up = 0.0, time.monotonic(), 0, False
        while not self._closing.wait(PERIOD_S):
            now = time.monotonic()
            if now - looked >= LOOK_S:
                looked, is_up = now, site.is_up
                self._publish_state(is_up, "" if is_up else f"{self.endpoint}: the link is lost")
            with self._lock:
                if level is not self._level:
                    level = self._level
                    self._outgoing.set_level(level)
                keys = self._outgoing.keys
                for _ in range(len(self._incoming)):
                    self._outgoing.take(*self._incoming.popleft())
                due = list(self._outgoing.due(now)) if is_up else []
                total = self._outgoing.n_bytes
            self._stack.listen_to(keys)
            for key, payload in due:
                site.put(key, payload)
            for _ in range(len(self._heard)):
                self._stack.pass_on(*self._heard.popleft())
            if now - reported >= REPORT_S and is_up:
                self._publish({"event": "sent", "rate": (total - n_bytes) / (now - reported)})
                reported, n_bytes = now, total

    # --- from the stack and the site, on threads of Zenoh's -----------------------------------------------------------

    def _hear(self, key: str, payload: bytes, is_latched: bool) -> None:
        self._incoming.append((key, payload, self._context.clock.now() if is_latched else None))

    def _last_value(self, key: str) -> bytes:
        with self._lock:
            return self._outgoing.last_value(key, time.monotonic())

    def _on_order(self, key: str, payload: bytes) -> None:
        self._publish({"event": key, "data": payload})

    def _on_heard(self, key: str, payload: bytes) -> None:
        self._heard.append((key, payload))

    def _on_ask(self, key: str, payload: bytes, reply: Reply) -> None:
        row = next(row for row in CROSSING_REQUESTS if key in row.keys)
        with self._lock:
            is_full = len(self._replies) >= MAX_ASKS
            self._n_asks += 1
            id_ = self._n_asks
            if not is_full:
                self._replies[id_] = row, payload, reply
        if is_full:
            self._refuse(row, reply, BUSY, "")
        else:
            self._publish({"event": "ask", "id": id_, "key": key, "data": payload})

    # --- requests -----------------------------------------------------------------------------------------------------

    def _ask_stack(self, row: Request[Any, Any], payload: bytes, reply: Reply) -> None:
        client = self._stack.client
        if client is None:
            self._refuse(row, reply, NOT_RUNNING, "")
            return
        try:
            data = client.ask_raw(row, payload, ASK_LIMIT_S)
        except UserError as error:
            self._refuse(row, reply, NOT_RUNNING, error.what)
            return
        if row is requests.FETCH_RECORDING:
            self._wait_for_recordings(len(data))
        self._reply(reply, data)

    def _wait_for_recordings(self, n_bytes: int) -> None:
        """Holds a part back, so that recordings leave the link to what is live."""
        with self._lock:
            self._recording_bucket.fill(time.monotonic())
            self._recording_bucket.spend(n_bytes)
            wait = self._recording_bucket.wait
        self._closing.wait(wait)

    def _refuse(self, row: Request[Any, Any], reply: Reply, reason: Reason, detail: str) -> None:
        now = self._context.clock.now()
        self._reply(reply, encode(row.refusal(now, reason, detail), Envelope("uplink", "", 0, now)))

    def _reply(self, reply: Reply, data: bytes) -> None:
        with suppress(Exception):  # Zenoh's: the session with the site is closed
            reply(data)

    # --- to the core --------------------------------------------------------------------------------------------------

    def _publish(self, event: dict[str, Any]) -> None:
        self._send(topics.RX(SerialData(self._context.clock.now(), PORT, bytes(msgpack.packb(event)))))

    def _publish_state(self, is_open: bool, detail: str) -> None:
        if self._state != (is_open, detail):
            self._state = is_open, detail
            self._send(topics.PORT(PortState(self._context.clock.now(), PORT, is_open, detail)))

    def _send(self, publication: Publication) -> None:
        self._context.publish(publication)


def site_endpoint(device: str) -> str:
    """Zenoh's endpoint of tls://HOST:PORT. Raises UserError where it is none."""
    return tls_endpoint(device, "uplink.port.device", "tls://site.example.org:7449")


def robot_credentials(endpoint: str, file: str, robot: str) -> Credentials:
    """The credentials of a robot for its site. Raises UserError where there are none, or they are another's."""
    credentials = read_credentials(Path(file)) if file else credentials_for(endpoint)
    if (credentials.role, credentials.name) != ("robot", robot):
        raise UserError(
            f"the credentials are of {credentials.name} ({credentials.role}), and this robot is {robot}",
            f"at the site: zenav secure add {robot} --role robot; the name of this robot: zenav up --name NAME",
        )
    return credentials
