# SPDX-License-Identifier: Apache-2.0
"""The dashboard's core as its shell drives it: events in, frames, orders and messages out."""

from typing import Any

import msgpack

from services.dashboard.outgoing import PORT
from services.dashboard.service import DashboardConfig, DashboardService
from shared import topics
from shared.config import load_robot
from shared.messages import EmergencyStop, GuardState, GuardStatus, Message, SerialData, Velocity
from shared.service import Log, Out
from shared.topics import Publication

ROBOT = load_robot("x80sv").robot
START = 1_700_000_000_000_000_000  # ns
MS = 1_000_000  # ns
LOOPBACK, ELSEWHERE = "127.0.0.1", "192.168.1.7"


class Pages:
    """A core with pages on it. `frames` and `orders` collect what it sends, `messages` what it publishes."""

    def __init__(self) -> None:
        self.core = DashboardService(DashboardConfig(), ROBOT)
        self.core.now = START
        self.frames: list[tuple[int | None, dict[str, Any]]] = []
        self.orders: list[dict[str, Any]] = []
        self.messages: list[tuple[int, Message]] = []
        self.logs: list[str] = []
        self._n = 0

    def open(self, client: int, host: str = LOOPBACK, **login: str) -> None:
        """login: name and role, as the shell has them of a session."""
        self.event(client=client, event="open", host=host, simulated=True, version="1.0", **login)

    def close(self, client: int) -> None:
        self.event(client=client, event="close")

    def frame(self, client: int, t: str, **fields: Any) -> None:
        self.raw(client, msgpack.packb({"t": t, **fields}))

    def raw(self, client: int, data: bytes) -> None:
        self.event(client=client, event="frame", data=data)

    def teleop(self, client: int, v: float, w: float = 0.0) -> None:
        self._n += 1
        self.frame(client, "teleop", v=v, w=w, n=self._n)

    def event(self, **fields: Any) -> None:
        self.bytes(msgpack.packb(fields))

    def bytes(self, data: bytes) -> None:
        self._take(self.core.receive(SerialData(self.core.now, PORT, data)))

    def guard(self, state: GuardState = GuardState.ACTIVE, source: str = "") -> None:
        self._take(self.core.guard_status(GuardStatus(self.core.now, state, source, "", "", 0.5)))

    def run(self, ms: int) -> None:
        """Lets time pass, with a tick each 50 ms."""
        for _ in range(ms // 50):
            self.core.now += 50 * MS
            self._take(self.core.drive())

    def sent(self, t: str, client: int | None = None) -> list[dict[str, Any]]:
        """The frames of a type that a client got, those for all among them."""
        return [f for to, f in self.frames if f["t"] == t and (client is None or to in (None, client))]

    @property
    def velocities(self) -> list[tuple[float, float]]:
        return [(m.v, m.w) for _, m in self.messages if isinstance(m, Velocity)]

    @property
    def stops(self) -> list[bool]:
        return [m.pressed for _, m in self.messages if isinstance(m, EmergencyStop)]

    def _take(self, out: Out) -> None:
        for output in out:
            if isinstance(output, Log):
                self.logs.append(output.text)
                continue
            assert isinstance(output, Publication)
            if output.topic is not topics.TX:
                self.messages.append((self.core.now, output.message))
                continue
            assert isinstance(output.message, SerialData)
            tree = msgpack.unpackb(output.message.data)
            if "frame" in tree:
                self.frames.append((tree["client"], msgpack.unpackb(tree["frame"])))
            elif "hello" in tree:
                self.frames.append((tree["client"], tree["hello"]))
            else:
                self.orders.append(tree)
