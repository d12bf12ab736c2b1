# SPDX-License-Identifier: Apache-2.0
"""How processes find each other with Zenoh: a fixed list of loopback ports a stack, or one router.

Kind A of the measured configurations: no holder to lose, no multicast, and a second instance of a service is refused at
open because its port is taken. Shared memory is off: it drops and delays what is over 3 kB.
"""

import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sized
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import msgpack
import zenoh

from shared.config import UserError, nearest
from shared.reasons import Reason
from shared.topics import SERVICES, TOPICS

BASE_PORT = 17400
PORTS_A_STACK = 40
MAX_DOMAIN = 200
LOG = "error,zenoh::api::session=off"  # goes to stdout, where tools write data; the session complains while it closes
MAX_PAYLOAD = 4 * 2**20  # bytes of a message, a request or a reply; a whole map of 1000 tiles
MAX_MESSAGE = (
    4 * MAX_PAYLOAD
)  # bytes that Zenoh takes; it drops larger ones without a word, and here is who can refuse them
RING = 50_000  # messages that wait for who hears everything: 100 s of a stack, 13 MB
ONE_THREAD = "(rx: (handover: net))"  # the thread that waits for the sockets also reads them
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
    config.insert_json5("timestamping/enabled", "false")  # who wants to know when a message came, stamps it there
    return config


def opened(where: Where, name: str = "", everything: bool = False) -> zenoh.Session:
    """An open session. Raises UserError when the service's port is taken or the router does not answer.

    everything: what comes is stamped on arrival, for `Everything`; and this process receives on one thread, where
    Zenoh would wake three for each message. It holds for the process, from its first session on.
    """
    if name and name not in SERVICES:
        raise UserError(f"{name} is not a service", nearest(name, SERVICES))
    zenoh.init_log_from_env_or(LOG)
    config = configuration(where, name)
    if everything:
        config.insert_json5("timestamping/enabled", "true")
        os.environ.setdefault("ZENOH_RUNTIME", ONE_THREAD)  # noqa: TID251  # Zenoh has no other way to be told
    try:
        return zenoh.open(config)
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


def oversize(payload: Sized) -> str:
    """What is wrong with the size of a message, in words; empty where it is within `MAX_PAYLOAD`."""
    n = len(payload)
    return f"{n / 2**20:.1f} MiB where a message may have {MAX_PAYLOAD // 2**20}" if n > MAX_PAYLOAD else ""


def refuse(query: zenoh.Query, reason: Reason, text: str) -> None:
    """Answers a request with an error, at once."""
    with query:
        query.reply_err(msgpack.packb({"code": reason.code, "text": text}))


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


class Arrival(NamedTuple):
    """A payload as it came in. at: ns on the wall's clock; latched: kept for late joiners."""

    key: str
    payload: bytes
    at: int
    latched: bool


class Everything:
    """Hears every key of a robot, for who looks now and then: Python is not woken for each message.

    Zenoh files them in a ring, the oldest gives way, and stamps each on arrival (`opened(..., everything=True)`).
    """

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._kept: deque[Arrival] = deque()
        self._ring = session.declare_subscriber(f"{robot}/**", zenoh.handlers.RingChannel(RING))
        keys = [f"{robot}/{topic.key}" for topic in TOPICS if topic.latched]
        self._readers = [LatchedReader(session, key, partial(self._keep, key)) for key in keys]

    def _keep(self, key: str, payload: bytes) -> None:
        self._kept.append(Arrival(key, payload, time.time_ns(), True))

    def taken(self) -> list[Arrival]:
        """What came since the last call, in the order of its times."""
        samples = list(iter(self._ring.try_recv, None))
        now = time.time_ns()
        found = [self._kept.popleft() for _ in range(len(self._kept))]
        for sample in samples:
            stamp = sample.timestamp
            # a clock that was set back is behind its stamps, a router without stamps of its own leaves them to us
            at = now if stamp is None else min(now, stamp.get_time_as_ntp64().as_nanos())
            found.append(Arrival(str(sample.key_expr), sample.payload.to_bytes(), at, False))
        return sorted(found, key=attrgetter("at"))
