# SPDX-License-Identifier: Apache-2.0
"""What goes to the site, and when: of each topic the newest message, at most at the rate of the registry's column.

A message that shows another state than the last one goes at once. A token bucket bounds the bytes of all together; what
finds it empty waits, and the newest message of its topic goes later. No session: bytes in, bytes out.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from services.uplink.coarse_map import CoarseMap
from services.uplink.crossing_forms import crossing_payload
from services.uplink.token_bucket import TokenBucket
from shared import topics
from shared.codec import CodecError, Envelope, decode, encode, envelope_of
from shared.crossing import OUTWARD_KEYS
from shared.stamps import is_known
from shared.topics import Topic, topic_of

OVERHEAD_BYTES = 110  # of a message: Zenoh's head, TLS, TCP and IP, and the acknowledgement of the other side
BURST_S = 4.0
CHANGE_INTERVAL_S = 0.2  # between two messages of a topic whose state changes
MAX_EVENTS = 50  # of a topic whose messages all count, that wait; then the oldest is left out
STATE_FIELDS: dict[str, tuple[str, ...]] = {
    topics.GUARD.key: ("state", "source", "reason"),
    topics.NAV_STATUS.key: ("task_id", "state", "recovery", "reason", "waypoint"),
    topics.BASE_STATUS.key: ("link", "fault"),
    topics.POSE.key: ("state", "mode"),
}
"""Fields of which a change goes to the site at once."""
LAST = (topics.SCAN.key, topics.ODOM.key, topics.LOG.key, topics.HEALTH.key, topics.MAP.key)
"""Topics that wait for all others."""


class Level(StrEnum):
    """The state of the robot by which rates are chosen."""

    REST = "rest"
    DRIVING = "driving"
    WATCHED = "watched"


RATE_LIMITS = {Level.REST: 1500.0, Level.DRIVING: 15_000.0, Level.WATCHED: 150_000.0}
"""bytes/s, with OVERHEAD_BYTES for each message."""


@dataclass(slots=True)
class _Lane:
    """One key. waiting: messages that were not sent; of most topics one.  state: of the last one sent."""

    topic: Topic[Any]
    waiting: deque[bytes] = field(default_factory=deque)
    sent_at: float = float("-inf")
    state: object = None
    has_changed: bool = False
    latched: bytes = b""  # the last value, as the stack has it


class Outgoing:
    """See the module. session: of the envelopes. Times are s, monotonic."""

    def __init__(self, session: str) -> None:
        self.session, self.level = session, Level.REST
        self.n_bytes = 0
        self._bucket = TokenBucket(RATE_LIMITS[Level.REST], BURST_S)
        self._map = CoarseMap()
        self._map_sent_at = float("-inf")
        self._sequences: dict[str, int] = {}
        keys = sorted(OUTWARD_KEYS, key=lambda key: _rank(_row(key)))
        self._lanes = {key: _Lane(_row(key)) for key in keys}
        self.keys = frozenset[str]()
        """What crosses at this level."""
        self.set_level(Level.REST)

    def set_level(self, level: Level) -> None:
        """Other rates hold from now on. A map that is not shown any more is forgotten."""
        self.level, self._bucket.rate = level, RATE_LIMITS[level]
        if level is not Level.WATCHED:
            self._map.clear()
        self.keys = frozenset(key for key, lane in self._lanes.items() if self._hz(lane.topic))
        for lane in self._lanes.values():
            if not self._hz(lane.topic) and not lane.topic.latched:
                lane.waiting.clear()

    def take(self, key: str, payload: bytes, kept_at: int | None = None) -> None:
        """A message of the stack. kept_at: of a last value when it came, ns on the stack's clock; a newer one stays."""
        lane = self._lanes.get(key)
        if lane is None or not self._hz(lane.topic):
            return
        try:
            if lane.topic is topics.MAP:
                update, envelope = decode(topics.MAP.type, payload)
                self._map.take(update, envelope.sent)
                return
            last = envelope_of(lane.latched) if lane.latched else None
            if kept_at is not None and last is not None and is_known(envelope_of(payload), last, kept_at):
                return
            self._file(lane, payload)
        except CodecError:
            return  # its readers among the services count it

    def due(self, now: float) -> Iterator[tuple[str, bytes]]:
        """Key and bytes of what goes now, the most important first."""
        self._bucket.fill(now)
        for key, lane in self._lanes.items():
            if not self._bucket.is_open:
                return
            payload = self._map_due(now) if lane.topic is topics.MAP else self._lane_due(lane, key, now)
            if payload:
                self._spend(payload)
                yield key, payload

    def last_value(self, key: str, now: float) -> bytes:
        """The answer to a reader at the site that begins; empty where there is none."""
        self._bucket.fill(now)
        lane = self._lanes.get(key)
        if lane is None:
            return b""
        if lane.topic is topics.MAP:
            self._map.send_again()  # part by part, as the bucket allows
            return b""
        if not lane.latched:
            return b""
        sequence = self._sequences.get(key, 0)  # of the last one sent: a reader counts from it on
        try:
            payload = crossing_payload(lane.topic, lane.latched, self.session, sequence)
        except CodecError:
            return b""
        self._spend(payload)
        return payload

    # --- one key ------------------------------------------------------------------------------------------------------

    def _file(self, lane: _Lane, payload: bytes) -> None:
        if fields := STATE_FIELDS.get(lane.topic.key):
            message, _ = decode(lane.topic.type, payload)
            state = tuple(getattr(message, name) for name in fields)
            lane.has_changed |= state != lane.state
            lane.state = state
        keeps_all = lane.topic.keep == "all" and not lane.topic.latched and not lane.topic.hz
        if not keeps_all:
            lane.waiting.clear()
        elif len(lane.waiting) >= MAX_EVENTS:
            lane.waiting.popleft()
        lane.waiting.append(payload)
        if lane.topic.latched:
            lane.latched = payload

    def _lane_due(self, lane: _Lane, key: str, now: float) -> bytes:
        hz = self._hz(lane.topic)
        if not lane.waiting or not hz:
            return b""
        interval = min(1 / hz, CHANGE_INTERVAL_S) if lane.has_changed else 1 / hz
        if now - lane.sent_at < interval:
            return b""
        try:
            payload = crossing_payload(lane.topic, lane.waiting.popleft(), self.session, self._next(key))
        except CodecError:
            return b""
        lane.sent_at, lane.has_changed = now, False
        self._count(key)
        return payload

    def _map_due(self, now: float) -> bytes:
        hz = self._hz(topics.MAP)
        if not hz or now - self._map_sent_at < 1 / hz or not self._map.is_behind:
            return b""
        part = self._map.part()
        if part is None:
            return b""
        self._map_sent_at = now
        payload = encode(part, Envelope("mapper", self.session, self._next(topics.MAP.key), part.stamp))
        self._count(topics.MAP.key)
        return payload

    def _hz(self, topic: Topic[Any]) -> float:
        row = topic.crosses
        return 0.0 if row is None else float(getattr(row, self.level))

    def _next(self, key: str) -> int:
        return self._sequences.get(key, -1) + 1

    def _count(self, key: str) -> None:
        self._sequences[key] = self._next(key)

    def _spend(self, payload: bytes) -> None:
        n = len(payload) + OVERHEAD_BYTES
        self.n_bytes += n
        self._bucket.spend(n)


def _row(key: str) -> Topic[Any]:
    topic = topic_of(key)
    assert topic is not None
    return topic


def _rank(topic: Topic[Any]) -> int:
    """What is small and shows the robot's state goes first."""
    first = (topics.GUARD.key, topics.NAV_STATUS.key, topics.INTENT.key)
    if topic.key in first:
        return 0
    return 2 + LAST.index(topic.key) if topic.key in LAST else 1
