# SPDX-License-Identifier: Apache-2.0
"""Zenoh sessions: a fixed list of loopback ports for each stack, or one router.

There is no central process and no multicast. A second instance of a service cannot open its port. Shared memory is off:
it drops and delays messages over 3 kB (docs/decisions.md).
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

import zenoh

from shared.access_rules import access_control, site_access_control
from shared.config import UserError, nearest
from shared.credentials import TLS, Credentials, credentials_for
from shared.secure_folder import SecureFolder
from shared.topics import LATCHED_KEYS, SERVICES

BASE_PORT = 17400
PORTS_A_STACK = 40
MAX_DOMAIN = 200
LOG = "error,zenoh::api::session=off"  # goes to stdout, where tools write data; a session logs errors while it closes
MAX_PAYLOAD = 4 * 2**20  # bytes of a message, a request or a reply; a whole map of 1000 tiles
MAX_MESSAGE = 4 * MAX_PAYLOAD  # bytes that Zenoh accepts; it drops larger messages silently, so we refuse them first
RING = 6_000  # messages that wait for the recorder: 12 s of a stack, 1.5 MB
COMPRESSION = "transport/unicast/compression/enabled"  # LZ4 of batches: tiles of a map become a tenth
ONE_THREAD = "(rx: (worker_threads: 1), net: (handover: rx), acc: (handover: rx))"
"""Zenoh's setting for one thread that waits for the sockets and reads them; by default a message wakes three."""
DATA_QUEUE = 16  # batches of 64 kB a link, for parts of a map; small messages that wait share one, as none is `express`

TOOL_OPEN_MS = 200  # ms that opening waits for links: a tool asks at once, and has no second try
SERVICE_OPEN_MS = 80  # ms: what a service misses of its first links it asks for again; a restart waits for this


@dataclass(frozen=True, slots=True)
class StackAddress:
    """Address of a stack: a block of loopback ports by number (`domain`), or a router's endpoint.

    credentials: for a router over TLS; without them those kept for its host.
    """

    domain: int = 0
    router: str = ""
    credentials: Credentials | None = None

    def port(self, name: str) -> int:
        """The loopback port of a service in this domain."""
        return BASE_PORT + PORTS_A_STACK * self.domain + SERVICES.index(name)


def stack_address(text: str) -> StackAddress:
    """The address from a domain's number, or a router's endpoint like tcp/router:7447. Raises UserError."""
    if text.isdigit() and int(text) <= MAX_DOMAIN:
        return StackAddress(int(text))
    if "/" in text and ":" in text:
        return StackAddress(router=text)
    raise UserError(
        f"{text!r} names no stack",
        f"give a number 0 to {MAX_DOMAIN}, or a router like tcp/router:7447 or tls/HOST:7448",
    )


def configuration(where: StackAddress, name: str = "") -> zenoh.Config:
    """The session's configuration: as service `name`, or as a tool where it is empty."""
    config = zenoh.Config()
    for key, value in session_settings(where, name).items():
        config.insert_json5(key, json.dumps(value))
    return config


def session_settings(where: StackAddress, name: str = "") -> dict[str, Any]:
    """The settings of a session by their paths in Zenoh's configuration. name: as in `configuration`."""
    common = {
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": MAX_MESSAGE,
        "transport/link/tx/queue/size/data": DATA_QUEUE,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    }
    if where.router:
        secured = where.router.startswith(TLS)
        tls = {"transport/link/tls": (where.credentials or credentials_for(where.router)).tls()} if secured else {}
        return {
            "mode": "client",
            **common,
            "connect/endpoints": [where.router],
            "connect/timeout_ms": -1 if name else 3000,
            **tls,
        }
    return {
        "mode": "peer",
        **common,
        "scouting/delay": SERVICE_OPEN_MS if name else TOOL_OPEN_MS,
        "listen/endpoints": [f"tcp/127.0.0.1:{where.port(name) if name else 0}"],
        "connect/endpoints": [f"tcp/127.0.0.1:{where.port(other)}" for other in SERVICES if other != name],
        "connect/timeout_ms": -1,
    }


def gateway_configuration(where: StackAddress, endpoint: str, folder: SecureFolder, robot: str) -> zenoh.Config:
    """A member of the stack that lets members of the folder in by TLS at `endpoint`, each within its access rules.

    The stack's own traffic does not pass it: without it only other computers are cut off. Raises UserError where the
    folder is incomplete.
    """
    config = configuration(where)
    if where.router:
        config.insert_json5("mode", '"router"')
        config.insert_json5("connect/timeout_ms", "-1")
    listening = [endpoint] if where.router else ["tcp/127.0.0.1:0", endpoint]
    config.insert_json5("listen/endpoints", json.dumps(listening))
    config.insert_json5("transport/link/tls", json.dumps(_listening_tls(folder)))
    config.insert_json5("access_control", json.dumps(access_control(robot, folder.members())))
    return config


def _listening_tls(folder: SecureFolder) -> dict[str, Any]:
    """Zenoh's `transport/link/tls` of a session that lets members of a folder in."""
    return {
        "enable_mtls": True,
        "close_link_on_expiration": True,
        "root_ca_certificate": str(folder.authority_certificate),
        "listen_certificate": str(folder.robot_certificate),
        "listen_private_key": str(folder.robot_key),
    }


def site_configuration(local: str, endpoint: str, folder: SecureFolder) -> zenoh.Config:
    """The router of a site: robots and people by TLS at `endpoint`, programs of this computer at `local`.

    Raises UserError where the folder is incomplete.
    """
    config = router_configuration(local, endpoint)
    config.insert_json5(COMPRESSION, "true")
    config.insert_json5("transport/link/tls", json.dumps(_listening_tls(folder)))
    config.insert_json5("access_control", json.dumps(site_access_control(folder.members())))
    return config


def opened_site(endpoint: str, credentials: Credentials) -> zenoh.Session:
    """The session of a robot with its site. It finds a router that was away again. Raises UserError without one."""
    config = configuration(StackAddress(router=endpoint, credentials=credentials))
    config.insert_json5(COMPRESSION, "true")
    retry = {"period_init_ms": 1000, "period_max_ms": 10_000, "period_increase_factor": 2}
    config.insert_json5("connect/retry", json.dumps(retry))
    zenoh.init_log_from_env_or(LOG)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        hint = "is it running, and is this robot a member? see zenav secure list at the site"
        raise UserError(f"no router of a site answers at {endpoint}", hint) from error


def router_configuration(*endpoints: str) -> zenoh.Config:
    """A router that listens on `endpoints`, for stacks whose services are containers."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps(endpoints))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    config.insert_json5("transport/link/rx/max_message_size", json.dumps(MAX_MESSAGE))
    config.insert_json5("timestamping/enabled", "false")  # receivers stamp messages themselves
    return config


def opened(where: StackAddress, name: str = "", everything: bool = False) -> zenoh.Session:
    """An open session. Raises UserError when the service's port is taken or the router does not answer.

    everything: messages get a stamp on arrival, for `Everything`.
    """
    if name and name not in SERVICES:
        raise UserError(f"{name} is not a service", nearest(name, SERVICES))
    zenoh.init_log_from_env_or(LOG)
    config = configuration(where, name)
    if everything:
        config.insert_json5("timestamping/enabled", "true")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        if where.router:
            hint = "is it running? see docker compose ps, or start it: zenav site up"
            if where.router.startswith(TLS):
                hint = "is it running, and are you a member? see zenav secure list on the robot"
            raise UserError(f"no router answers at {where.router}", hint) from error
        hint = f"is another {name} running in domain {where.domain}? find it: ss -tlnp | grep {where.port(name)}"
        raise UserError(f"port {where.port(name)} is taken", hint) from error


def receives_on_one_thread() -> None:
    """Lets this process receive on one thread. Call it before the first session."""
    os.environ.setdefault("ZENOH_RUNTIME", ONE_THREAD)  # noqa: TID251  # Zenoh reads it from the environment only


def asks_for_realtime(priority: int = 5) -> bool:
    """Sets SCHED_RR for this process and its threads. Returns False where the system does not allow it."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def oversize(payload: Sized) -> str:
    """Words for a message over `MAX_PAYLOAD`; empty for a smaller one."""
    n = len(payload)
    return f"{n / 2**20:.1f} MiB where a message may have {MAX_PAYLOAD // 2**20}" if n > MAX_PAYLOAD else ""


class LatchedPublisher:
    """Serves a key's last value to late subscribers, which ask with a query."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._key, self._lock = key, threading.Lock()
        self._value: Callable[[], bytes] | None = None
        self._queryable = session.declare_queryable(key, self._answer, complete=True)

    def keep(self, value: Callable[[], bytes]) -> None:
        """Sets the value: a function that encodes it when a subscriber asks."""
        with self._lock:
            self._value = value

    def _answer(self, query: zenoh.Query) -> None:
        with self._lock:
            value = self._value
        with query:
            if value is not None:
                query.reply(self._key, value())


class LatchedReader:
    """Reads a key's latched value at start, when a publisher appears, and on `refresh`. file: called with the bytes."""

    def __init__(self, session: zenoh.Session, key: str, file: Callable[[bytes], None]) -> None:
        self._file = file
        self._querier = session.declare_querier(
            key, timeout=2.0, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE
        )
        self._listener = self._querier.declare_matching_listener(self._changed)
        self.refresh()

    def refresh(self) -> None:
        """Asks for the value again, after a missed message."""
        self._querier.get(self._reply)

    def close(self) -> None:
        """Reads no more."""
        self._listener.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own
        self._querier.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own

    def _changed(self, status: zenoh.MatchingStatus) -> None:
        if status.matching:
            with suppress(zenoh.ZError):  # the session is being closed
                self.refresh()

    def _reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._file(reply.ok.payload.to_bytes())


class RawSample(NamedTuple):
    """A received payload. at: ns on the wall clock.  latched: a value for late subscribers."""

    key: str
    payload: bytes
    at: int
    latched: bool


def publisher(session: zenoh.Session, key: str, urgent: bool) -> zenoh.Publisher:
    """A publisher that drops messages before it waits for a slow reader. key: with the robot's name."""
    return session.declare_publisher(
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.DATA,
    )


class Everything:
    """Subscribes to every key of a robot, for a reader that polls: Python does not wake up for each message.

    Zenoh stores the messages in a ring, drops the oldest, and stamps each on arrival (`opened(..., everything=True)`).
    """

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._kept: deque[RawSample] = deque()
        self._ring = session.declare_subscriber(f"{robot}/**", zenoh.handlers.RingChannel(RING))
        keys = [f"{robot}/{key}" for key in LATCHED_KEYS]
        self._readers = [LatchedReader(session, key, partial(self._keep, key)) for key in keys]

    def _keep(self, key: str, payload: bytes) -> None:
        self._kept.append(RawSample(key, payload, time.time_ns(), True))

    def take_all(self) -> list[RawSample]:
        """The messages since the last call, in the order of their times."""
        samples = list(iter(self._ring.try_recv, None))
        now = time.time_ns()
        found = [self._kept.popleft() for _ in range(len(self._kept))]
        for sample in samples:
            stamp = sample.timestamp
            # after the clock was set back a stamp may be ahead; a router may give none
            at = now if stamp is None else min(now, stamp.get_time_as_ntp64().as_nanos())
            found.append(RawSample(str(sample.key_expr), sample.payload.to_bytes(), at, False))
        return sorted(found, key=attrgetter("at"))
