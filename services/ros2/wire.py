# SPDX-License-Identifier: Apache-2.0
"""The session with the ROS 2 nodes: publishers, subscriptions, services and tokens, in one of the two formats.

Callbacks run on Zenoh's threads: they file, and return. Source: ros2/rmw_zenoh, rmw_zenoh_cpp/src/detail/
rmw_publisher_data.cpp, rmw_service_data.cpp and rmw_client_data.cpp.
"""

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from hashlib import blake2b
from typing import Any

import zenoh
from zenoh.ext import (
    CacheConfig,
    HistoryConfig,
    MissDetectionConfig,
    declare_advanced_publisher,
    declare_advanced_subscriber,
)

from services.ros2.rmw_names import GID_BYTES, Endpoint, Entity, Qos, Reliability, RosName, ros_type
from services.ros2.ros_format import Attachment, RosFormat
from shared.config import UserError

OPEN_LIMIT_MS = 1000
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
HEARTBEAT_S = 0.5  # rmw_zenoh's SAMPLE_MISS_DETECTION_HEARTBEAT_PERIOD
MAX_QUERIES, MAX_OF_SERVICE = 64, 16  # requests that wait for a reply: of all services, and of one
"""A client may ask for a result that comes after hours again and again. STOP has its own places beside MAX_QUERIES."""
MAX_BYTES = 2**20  # of an incoming message or request
SERVICE_QOS = Qos(depth=10)  # rmw_qos_profile_services_default


@dataclass(frozen=True, slots=True)
class WireEvents:
    """What the wire calls, on Zenoh's threads.

    message: name, type, CDR, gid of the publisher, ns on its clock when it was sent, ns on ours when it came.
    request: name of the service, its number here, CDR.
    wanted: label of a publisher, and whether a subscription matches.
    endpoint: a token of another node, what it says, and whether it is there.  rejected: name and cause.
    """

    message: Callable[[str, str, bytes, bytes, int, int], None]
    request: Callable[[str, int, bytes], None]
    wanted: Callable[[str, bool], None]
    endpoint: Callable[[str, Endpoint, bool], None]
    rejected: Callable[[str, str], None]


@dataclass(slots=True)
class _Publisher:
    put: Any  # zenoh's, advanced or plain
    gid: bytes
    parts: list[Any]  # what else is declared for it
    sequence: int = 0


class RosWire:
    """One node on one session, in a format. Raises UserError where no router answers at the endpoint.

    tls: Zenoh's settings for a router over TLS (router_tls.py).
    """

    def __init__(self, endpoint: str, tls: dict[str, Any], ros_format: RosFormat, events: WireEvents) -> None:
        self._events, self._format = events, ros_format
        try:
            self._session = zenoh.open(_configuration(endpoint, tls))
        except zenoh.ZError as error:
            hint = "is it running? ros2 run rmw_zenoh_cpp rmw_zenohd, or zenoh-bridge-ros2dds"
            hint = "is it running, and do the settings ros2.tls fit its certificate?" if tls else hint
            raise UserError(f"no Zenoh router answers at {endpoint}", hint) from error
        self._zid = str(self._session.info.zid())
        self._n_entities = 0
        self._declared: list[Any] = []
        self._publishers: dict[str, _Publisher] = {}
        self._services: dict[str, str] = {}  # key by name
        self._urgent: set[str] = set()
        self._queries: dict[int, tuple[str, zenoh.Query, Attachment]] = {}
        self._n_queries = 0
        self._lock = threading.Lock()
        liveliness = self._session.liveliness()
        self._tokens = [liveliness.declare_token(token) for token in ros_format.node_tokens(self._zid)]

    @property
    def is_connected(self) -> bool:
        """Whether the router is there."""
        return bool(list(self._session.info.routers_zid()))

    def close(self) -> None:
        """Ends the node."""
        with self._lock:
            queries, self._queries = self._queries, {}
        for _, query, _ in queries.values():
            query.drop()  # type: ignore[no-untyped-call]  # zenoh's own
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's own

    def advertise(self, label: str, topic: RosName, qos: Qos) -> None:
        """Declares a publisher. `wanted` is called with its label when a subscription matches, and when none does."""
        key = self._format.key(topic)
        is_reliable = qos.reliability is Reliability.RELIABLE
        options: dict[str, Any] = {
            "allowed_destination": zenoh.Locality.REMOTE,  # our own subscription to /tf is no listener
            "congestion_control": zenoh.CongestionControl.DROP,
            "reliability": zenoh.Reliability.RELIABLE if is_reliable else zenoh.Reliability.BEST_EFFORT,
        }
        publisher: Any
        plain = publisher = self._session.declare_publisher(key, **options)
        if qos.is_latched:
            publisher = declare_advanced_publisher(
                self._session,
                key,
                cache=CacheConfig(max_samples=qos.depth),
                publisher_detection=True,
                sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                **options,
            )
        listener = plain.declare_matching_listener(lambda status: self._events.wanted(label, status.matching))
        token, declared = self._declare_token(Entity.PUBLISHER, topic, qos)
        self._publishers[label] = _Publisher(publisher, _gid(token), [*declared, listener, plain])
        status: Any = plain.matching_status  # zenoh calls it a bool; it is a MatchingStatus
        if status.matching:
            self._events.wanted(label, True)

    def withdraw(self, label: str) -> None:
        """Ends a publisher without a cache."""
        for part in self._publishers.pop(label).parts:
            part.undeclare()

    def subscribe(self, name: str, topics: tuple[RosName, ...], qos: Qos) -> None:
        """Declares subscriptions of one name; `rejected` hears of messages of other types and hashes.

        Of a latched topic the messages from before are asked for. Our own messages do not come.
        """
        hear, key, remote = partial(self._hear, name, topics), self._format.listening_key(name), zenoh.Locality.REMOTE
        if qos.is_latched:
            key, history = self._format.key(topics[0]), HistoryConfig(detect_late_publishers=True)
            self._declared.append(
                declare_advanced_subscriber(self._session, key, hear, allowed_origin=remote, history=history)
            )
        else:
            self._declared.append(self._session.declare_subscriber(key, hear, allowed_origin=remote))
        for topic in topics:
            self._declared += self._declare_token(Entity.SUBSCRIPTION, topic, qos)[1]

    def serve(self, service: RosName, is_urgent: bool = False) -> None:
        """Declares a service. is_urgent: requests of other services never fill its places."""
        if is_urgent:
            self._urgent.add(service.name)
        key = self._services[service.name] = self._format.key(service)
        answer = partial(self._ask, service.name)
        self._declared.append(self._session.declare_queryable(key, answer, complete=True))
        self._declared += self._declare_token(Entity.SERVICE, service, SERVICE_QOS)[1]

    def discover(self) -> None:
        """From now on `endpoint` is called, also for the endpoints that are there already."""
        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(self._format.tokens_key(), self._hear_token, history=True))

    def publish(self, label: str, data: bytes) -> None:
        """Sends a message of a publisher, which must be there. data: CDR. Called from one thread at a time."""
        publisher = self._publishers[label]
        publisher.sequence += 1
        publisher.put.put(data, attachment=self._format.attachment(publisher.sequence, time.time_ns(), publisher.gid))

    def reply(self, number: int, data: bytes) -> None:
        """Replies to a request. data: CDR; empty: no reply."""
        with self._lock:
            waiting = self._queries.pop(number, None)
        if waiting is None:
            return
        name, query, asked = waiting
        attachment = self._format.attachment(asked.sequence, time.time_ns(), asked.gid)
        with query:
            if data:
                query.reply(self._services[name], data, attachment=attachment)

    def _declare_token(self, entity: Entity, topic: RosName, qos: Qos) -> tuple[str, list[Any]]:
        """The token of an endpoint, and what is declared for it: nothing where it needs none."""
        self._n_entities += 1
        token = self._format.endpoint_token(self._zid, self._n_entities, entity, topic, qos)
        return token, [self._session.liveliness().declare_token(token)] if token else []

    def _hear(self, name: str, topics: tuple[RosName, ...], sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        type_ = self._format.type_of(key, topics, len(sample.payload))
        found = self._format.attachment_of(_bytes_of(sample.attachment))
        if not type_:
            dds, type_hash = key.split("/")[-2:]
            self._events.rejected(name, f"a message of type {ros_type(dds)} {type_hash}")
        elif found is None:
            self._events.rejected(name, "a message without rmw_zenoh's attachment")
        elif len(sample.payload) > MAX_BYTES:
            self._events.rejected(name, f"a message of {len(sample.payload)} bytes")
        else:
            data, came = sample.payload.to_bytes(), time.time_ns()
            sent = came if found.sent is None else found.sent
            self._events.message(name, type_, data, found.gid, sent, came)

    def _ask(self, name: str, query: zenoh.Query) -> None:
        payload = query.payload
        found = self._format.attachment_of(_bytes_of(query.attachment))
        if payload is None or found is None or len(payload) > MAX_BYTES:
            self._events.rejected(name, "a request without payload or rmw_zenoh's attachment, or of over 1 MiB")
            query.drop()  # type: ignore[no-untyped-call]  # zenoh's own
            return
        with self._lock:
            n_own = sum(waiting == name for waiting, _, _ in self._queries.values())
            is_full = n_own >= MAX_OF_SERVICE or (len(self._queries) >= MAX_QUERIES and name not in self._urgent)
            if not is_full:
                self._n_queries += 1
                number = self._n_queries
                self._queries[number] = name, query, found
        if is_full:
            self._events.rejected(
                name, f"over {MAX_OF_SERVICE} of its requests, or {MAX_QUERIES} in all, wait for a reply"
            )
            query.drop()  # type: ignore[no-untyped-call]  # zenoh's own
        else:
            self._events.request(name, number, payload.to_bytes())

    def _hear_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        endpoint = self._format.endpoint_of(token)
        if endpoint is not None and f"/{self._zid}/" not in token:
            self._events.endpoint(token, endpoint, sample.kind == zenoh.SampleKind.PUT)


def _bytes_of(attachment: zenoh.ZBytes | None) -> bytes | None:
    return None if attachment is None else attachment.to_bytes()


def _configuration(endpoint: str, tls: dict[str, Any]) -> zenoh.Config:
    """A client of the router; the time stamps are for the caches of latched topics."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": OPEN_LIMIT_MS,
        "connect/retry": RETRY,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
        **({"transport/link/tls": tls} if tls else {}),
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _gid(token: str) -> bytes:
    """The 16 bytes that are a publisher's own. rmw_zenoh takes XXH3; nothing but their constancy counts."""
    return blake2b(token.encode(), digest_size=GID_BYTES).digest()
