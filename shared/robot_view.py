# SPDX-License-Identifier: Apache-2.0
"""What one robot of a fleet said of itself, as far as it was heard. No session: messages in, a row out."""

from dataclasses import dataclass, field
from math import degrees, isnan
from typing import Any, TypeVar

from shared import topics
from shared.codec import Envelope
from shared.messages import GuardState, Message, NavState
from shared.stamps import is_older
from shared.task_state import FINAL_STATES, stop_reason
from shared.topics import Topic

FLEET_TOPICS: tuple[Topic[Any], ...] = (
    topics.NAV_STATUS,
    topics.GUARD,
    topics.BASE_STATUS,
    topics.MAP_STATE,
    topics.POSE,
)
"""What a fleet listens to: one key each, of every robot."""
LINK_TOPIC = topics.NAV_STATUS  # it comes always, at a fixed rate: its sequence shows what was lost
SILENT_S = 3.0  # without a message of LINK_TOPIC a robot counts as silent
MAX_BEHIND = 1000  # messages of LINK_TOPIC by which one may come after a later one, and still count
NO_TASK = (NavState.IDLE, *FINAL_STATES)

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class FleetRow:
    """One robot for people and programs. state: the navigator's, `stopped` by STOP, or `silent`.

    battery: V. x, y: m, yaw: degrees, on its map. received: share of the messages that the robot sent, since it was
    first heard. delay: s from sending to arrival, median, by both computers' clocks. None is unknown.
    """

    name: str
    stack: str
    state: str
    reason: str
    task: str
    battery: float | None
    map: str
    x: float | None
    y: float | None
    yaw: float | None
    pose_state: str
    received: float | None
    delay: float | None
    address: str
    version: str


@dataclass(slots=True)
class RobotView:
    """Collects the messages of the robot `name` in a stack. addresses: host and version of each `zenav up` of it."""

    name: str
    stack: str
    addresses: list[tuple[str, str]] = field(default_factory=list)
    heard: float = 0.0  # s, monotonic, of LINK_TOPIC's newest
    _newest: dict[str, tuple[Message, Envelope, float]] = field(default_factory=dict)
    _arrivals: "_Arrivals" = field(default_factory=lambda: _Arrivals(""))
    _delays: list[float] = field(default_factory=list)

    def add(self, topic: Topic[Any], message: Message, envelope: Envelope, at: float, now: int) -> None:
        """A message that came at `at` (s, monotonic) and `now` (ns, the wall clock). Older ones change nothing."""
        before = self._newest.get(topic.key)
        if before is None or not self._is_older(envelope, before, at, now):
            self._newest[topic.key] = message, envelope, at
        if topic is LINK_TOPIC:
            self._count(envelope, at, now)

    def latest(self, topic: Topic[M]) -> M | None:
        """The newest message of one of FLEET_TOPICS."""
        newest = self._newest.get(topic.key)
        return newest[0] if newest else None  # type: ignore[return-value]  # by its topic

    def row(self, at: float) -> FleetRow:
        """The robot as of `at` (s, monotonic)."""
        nav, guard, base = self.latest(topics.NAV_STATUS), self.latest(topics.GUARD), self.latest(topics.BASE_STATUS)
        pose, map_state = self.latest(topics.POSE), self.latest(topics.MAP_STATE)
        is_silent = at - self.heard > SILENT_S
        state = "silent" if is_silent or nav is None else str(nav.state)
        if not is_silent and guard is not None and guard.state is GuardState.STOPPED:
            state = "stopped"
        where = pose.map_from_base if pose is not None else None
        return FleetRow(
            name=self.name,
            stack=self.stack,
            state=state,
            reason="" if is_silent else stop_reason(nav, guard),
            task="" if nav is None or nav.state in NO_TASK else f"{nav.distance_left:.1f} m left",
            battery=None if base is None or isnan(base.battery) else base.battery,
            map="" if map_state is None else map_state.name,
            x=None if where is None else where.x,
            y=None if where is None else where.y,
            yaw=None if where is None else degrees(where.yaw),
            pose_state="" if pose is None else str(pose.state),
            received=self._arrivals.share,
            delay=sorted(self._delays)[len(self._delays) // 2] if self._delays else None,
            address=", ".join(address for address, _ in self.addresses),
            version=", ".join(dict.fromkeys(version for _, version in self.addresses)),
        )

    def _is_older(self, envelope: Envelope, newest: tuple[Message, Envelope, float], at: float, now: int) -> bool:
        """A robot that was silent may have started again, with a clock that was set back."""
        _, last, came = newest
        has_started_again = envelope.session != last.session and at - came > SILENT_S
        return not has_started_again and is_older(envelope, last, now)

    def _count(self, envelope: Envelope, at: float, now: int) -> None:
        if envelope.session != self._arrivals.session:  # the navigator was started again
            self._arrivals = _Arrivals(envelope.session)
        if not self._arrivals.add(envelope.sequence):  # a latched value, which was there before
            return
        self.heard = at
        self._delays = [*self._delays[-99:], (now - envelope.sent) / 1e9]


@dataclass(slots=True)
class _Arrivals:
    """Counts the messages of a session, in any order and each of them once. Those that are far behind do not count."""

    session: str
    _n: int = 0
    _first: int = 0
    _last: int = 0
    _recent: set[int] = field(default_factory=set)  # all after `_last` - MAX_BEHIND, and perhaps a few before

    def add(self, sequence: int) -> bool:
        """Whether it is another message than those before."""
        if sequence in self._recent or (self._n and sequence <= self._last - MAX_BEHIND):
            return False
        self._first = min(self._first, sequence) if self._n else sequence
        self._last = max(self._last, sequence) if self._n else sequence
        self._n += 1
        self._recent.add(sequence)
        if len(self._recent) > 2 * MAX_BEHIND:
            self._recent = {kept for kept in self._recent if kept > self._last - MAX_BEHIND}
        return True

    @property
    def share(self) -> float | None:
        """That of the messages between the first and the last one which came; None before the second one."""
        return (self._n - 1) / (self._last - self._first) if self._n > 1 else None
