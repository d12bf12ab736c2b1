# SPDX-License-Identifier: Apache-2.0
"""A browser for tests: HTTP and the WebSocket of a page's server, and a server on a free port with a fake stack."""

import http.client
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import TracebackType
from typing import Any

import msgpack
from websockets.exceptions import ConnectionClosed

from services.dashboard.outgoing import PORT
from services.dashboard.service import DashboardConfig, DashboardService
from services.dashboard.web import WebDevice
from shared import topics
from shared.codec import Envelope, encode
from shared.messages import Message, SerialData
from shared.ports import PortConfig
from shared.runners.clock import StackClock
from shared.runners.devices import DeviceContext
from shared.runners.transport import StackAddress
from shared.service import Log
from shared.topics import Publication
from tests.unit.services.dashboard.pages import ROBOT
from tests.websocket import WebSocketClient

SOON = 60.0  # s that a busy machine may take: a tool starts beside a whole stack
DEVICE = "web://127.0.0.1:0"


class Browser:
    """A page's connection. `frames` collects what came, in order. options: of websockets; with `ssl` it is TLS."""

    def __init__(self, port: int, host: str = "127.0.0.1", read: bool = True, **options: Any) -> None:
        scheme = "wss" if "ssl" in options else "ws"
        self.socket = WebSocketClient(f"{scheme}://{host}:{port}/ws", **options)
        self.frames: list[dict[str, Any]] = []
        self.closed: tuple[int, str] | None = None
        self._changed = threading.Condition()
        self._n = 0
        self._thread = threading.Thread(target=self._read, daemon=True)
        if read:
            self._thread.start()

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.socket.__exit__(kind, error, at)

    def send(self, t: str, **fields: Any) -> None:
        self.socket.send(msgpack.packb({"t": t, **fields}))

    def teleop(self, v: float) -> None:
        self._n += 1
        self.send("teleop", v=v, w=0.0, n=self._n)

    def ask(self, kind: str, **fields: Any) -> dict[str, Any]:
        """The reply to an `ask` or `do`."""
        self._n += 1
        self.send(kind, id=self._n, **fields)
        return self.until(lambda: next((f for f in self.of("reply") if f["id"] == self._n), None))

    def of(self, t: str) -> list[dict[str, Any]]:
        with self._changed:
            return [frame for frame in self.frames if frame["t"] == t]

    def first(self, t: str) -> dict[str, Any]:
        return self.until(lambda: next(iter(self.of(t)), None))

    def until(self, found: Callable[[], Any], seconds: float = SOON) -> Any:
        """What `found` returns, as soon as it is true."""
        limit = time.monotonic() + seconds
        while not (result := found()):
            with self._changed:
                assert time.monotonic() < limit, self.frames[-5:]
                self._changed.wait(0.05)
        return result

    def _read(self) -> None:
        try:
            for data in self.socket:
                with self._changed:
                    self.frames.append(msgpack.unpackb(data))
                    self._changed.notify_all()
        except ConnectionClosed:
            pass
        with self._changed:
            self.closed = self.socket.closed
            self._changed.notify_all()


class FakeLink:
    """A stack that hears what is wanted, and gives what the test publishes."""

    def __init__(self, deliver: Callable[[str, bytes, bool], None], on_teleop: Callable[[], None]) -> None:
        self.deliver, self.on_teleop = deliver, on_teleop
        self.is_simulated = True
        self.is_open = False
        self.keys: frozenset[str] = frozenset()
        self.asked: list[str] = []
        self._n = 0

    def connect(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def listen_to(self, keys: frozenset[str]) -> None:
        self.keys = keys

    def ask(self, key: str, payload: bytes) -> dict[str, Any]:
        self.asked.append(key)
        return {"accepted": True, "reason": "", "detail": "", "hint": "", "data": {"task_id": len(self.asked)}}

    def publish(self, key: str, message: Message, latched: bool = False) -> None:
        self._n += 1
        self.deliver(key, encode(message, Envelope("sim", "s", self._n, message.stamp)), latched)


class Served:
    """A core and its shell on a free port. The core runs here, a tick each 50 ms.

    settings: of the service.  sent: the bytes of all that the shell and the core exchanged.  logs: of the core.
    """

    def __init__(self, monkeypatch: Any, **settings: Any) -> None:
        self.links: list[FakeLink] = []
        monkeypatch.setattr("services.dashboard.web.StackLink", self._link)
        config = DashboardConfig(**{"port": PortConfig(device=DEVICE), "tools": "", **settings})
        self.logs: list[tuple[str, str]] = []
        self.sent: list[bytes] = []
        self.core = DashboardService(config, ROBOT)
        self.published: list[Message] = []
        self._lock = threading.Lock()
        self._open, self._ending = threading.Event(), threading.Event()
        arguments = ("--robot", "x80sv", "--stack", "0")
        where, clock = StackAddress(), StackClock()
        self.device = WebDevice(
            DeviceContext(PORT, config.port, config, ROBOT.name, where, arguments, clock, self._publish)
        )
        self._clock = clock
        self._ticking = threading.Thread(target=self._tick, daemon=True)

    @property
    def link(self) -> FakeLink:
        return self.links[-1]

    @property
    def port(self) -> int:
        return self.device.address.port

    def request(
        self, method: str, path: str, body: bytes | None = None, **headers: str
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        """Status, headers and body of the answer."""
        names = {name.replace("_", "-"): value for name, value in headers.items()}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=SOON)) as connection:
            connection.request(method, path, body, names)
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read()

    def _link(self, robot: str, where: StackAddress, deliver: Any, on_teleop: Any) -> FakeLink:
        self.links.append(FakeLink(deliver, on_teleop))
        return self.links[-1]

    def _publish(self, publication: Publication) -> None:
        with self._lock:
            self.core.now = self._clock.now()
            if publication.topic is topics.RX:
                assert isinstance(publication.message, SerialData)
                self.sent.append(publication.message.data)
                self._take(self.core.receive(publication.message))
            else:
                self._take(self.core.port_state(publication.message))
                self._open.set()

    def _take(self, out: Any) -> None:
        for output in out:
            if isinstance(output, Publication) and output.topic is topics.TX:
                assert isinstance(output.message, SerialData)
                self.sent.append(output.message.data)
                self.device.write(output.message.data)
            elif isinstance(output, Log):
                self.logs.append((output.level, output.text))
            elif isinstance(output, Publication):
                self.published.append(output.message)

    def _tick(self) -> None:
        while not self._ending.wait(0.05):
            with self._lock:
                self.core.now = self._clock.now()
                self._take(self.core.drive())


@contextmanager
def serving(monkeypatch: Any, **settings: Any) -> Iterator[Served]:
    """A running server; it is ended afterwards."""
    served = Served(monkeypatch, **settings)
    served.device.start()
    assert served._open.wait(SOON)
    served._ticking.start()
    try:
        yield served
    finally:
        served._ending.set()
        served.device.close()
        assert not served.device._thread.is_alive()
