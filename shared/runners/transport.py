# SPDX-License-Identifier: Apache-2.0
"""How processes find each other with Zenoh: a fixed list of loopback ports a stack, or one router.

Kind A of the measured configurations: no holder to lose, no multicast, and a second instance of a service is refused at
open because its port is taken. Shared memory is off: it drops and delays what is over 3 kB.
"""

import json
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from shared.config import UserError, nearest
from shared.topics import SERVICES, TOPICS

BASE_PORT = 17400
PORTS_A_STACK = 40
MAX_DOMAIN = 200
LOG = "error,zenoh::api::session=off"  # goes to stdout, where tools write data; the session complains while it closes
MAX_MESSAGE = 4 * 2**20  # bytes; a whole map of 1000 tiles
DATA_QUEUE = 16  # batches of 64 kB a link: two, the default, overflow when a busy machine lets a process wait for 40 ms


@dataclass(frozen=True, slots=True)
class Where:
    """Which stack to join: a block of loopback ports by number (`domain`), or a router's endpoint."""

    domain: int = 0
    router: str = ""

    def port(self, name: str) -> int:
        """The loopback port of a service in this domain."""
        return BASE_PORT + PORTS_A_STACK * self.domain + SERVICES.index(name)


def where_from(text: str) -> Where:
    """A domain's number, or a router's endpoint like tcp/router:7447. Raises UserError on anything else."""
    if text.isdigit() and int(text) <= MAX_DOMAIN:
        return Where(int(text))
    if "/" in text and ":" in text:
        return Where(router=text)
    raise UserError(f"{text!r} names no stack", f"give a number 0 to {MAX_DOMAIN}, or a router like tcp/router:7447")


def configuration(where: Where, name: str = "") -> zenoh.Config:
    """The session's configuration: as service `name`, or as a tool where it is empty."""
    config = zenoh.Config()

    def put(key: str, value: Any) -> None:
        config.insert_json5(key, json.dumps(value))

    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    put("scouting/multicast/enabled", False)
    put("transport/shared_memory/enabled", False)
    put("transport/link/rx/max_message_size", MAX_MESSAGE)
    put("transport/link/tx/queue/size/data", DATA_QUEUE)
    put("connect/exit_on_failure", False)
    put("connect/retry", retry)
    if where.router:
        put("mode", "client")
        put("connect/endpoints", [where.router])
        put("connect/timeout_ms", -1 if name else 3000)
        return config
    put("mode", "peer")
    put("scouting/delay", 200)
    put("listen/endpoints", [f"tcp/127.0.0.1:{where.port(name) if name else 0}"])
    put("connect/endpoints", [f"tcp/127.0.0.1:{where.port(other)}" for other in SERVICES if other != name])
    put("connect/timeout_ms", -1)
    return config


def router_configuration(endpoint: str) -> zenoh.Config:
    """A router that listens on `endpoint`, for stacks whose services are containers."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    config.insert_json5("transport/link/rx/max_message_size", json.dumps(MAX_MESSAGE))
    return config


def opened(where: Where, name: str = "") -> zenoh.Session:
    """An open session. Raises UserError when the service's port is taken or the router does not answer."""
    if name and name not in SERVICES:
        raise UserError(f"{name} is not a service", nearest(name, SERVICES))
    zenoh.init_log_from_env_or(LOG)
    try:
        return zenoh.open(configuration(where, name))
    except zenoh.ZError as error:
        if where.router:
            raise UserError(f"no router answers at {where.router}", "is it running? see docker compose ps") from error
        mend = f"is another {name} running in domain {where.domain}? see who: ss -tlnp | grep {where.port(name)}"
        raise UserError(f"port {where.port(name)} is taken", mend) from error


def asks_for_realtime(priority: int = 5) -> bool:
    """SCHED_RR for this process and the threads that it starts; False where the system does not allow it."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


class LatchedPublisher:
    """Keeps a key's last value for late joiners: they ask with a query and get it at once."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._key, self._lock = key, threading.Lock()
        self._value: Callable[[], bytes] | None = None
        self._queryable = session.declare_queryable(key, self._answer, complete=True)

    def keep(self, value: Callable[[], bytes]) -> None:
        """The value that the next late joiner gets; encoded when somebody asks."""
        with self._lock:
            self._value = value

    def _answer(self, query: zenoh.Query) -> None:
        with self._lock:
            value = self._value
        with query:
            if value is not None:
                query.reply(self._key, value())


class LatchedReader:
    """Asks for a key's kept value at start, whenever a publisher appears, and on `refresh`; `file` gets the bytes."""

    def __init__(self, session: zenoh.Session, key: str, file: Callable[[bytes], None]) -> None:
        self._file = file
        self._querier = session.declare_querier(
            key, timeout=2.0, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE
        )
        self._listener = self._querier.declare_matching_listener(self._changed)
        self.refresh()

    def refresh(self) -> None:
        """Asks again: something was missed."""
        self._querier.get(self._reply)

    def _changed(self, status: zenoh.MatchingStatus) -> None:
        if status.matching:
            with suppress(zenoh.ZError):  # the session is being closed
                self.refresh()

    def _reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._file(reply.ok.payload.to_bytes())


def everything(session: zenoh.Session, robot: str, file: Callable[[str, bytes, bool], None]) -> list[Any]:
    """Hears every key of a robot: `file` gets the key, the bytes, and whether they were kept for late joiners."""

    def hear(sample: zenoh.Sample) -> None:
        file(str(sample.key_expr), sample.payload.to_bytes(), False)

    def keep(key: str, payload: bytes) -> None:
        file(key, payload, True)

    keys = [f"{robot}/{topic.key}" for topic in TOPICS if topic.latched]
    readers = [LatchedReader(session, key, partial(keep, key)) for key in keys]
    return [session.declare_subscriber(f"{robot}/**", hear), *readers]
