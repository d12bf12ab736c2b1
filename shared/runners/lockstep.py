# SPDX-License-Identifier: Apache-2.0
"""All services in one process on a virtual clock, as fast as it goes: the same seed gives the same bytes.

Events are ordered by (time, cause), a total order. A message arrives `topic.within` after its publication. A job's
result comes `job.takes` after the job could start. Faults are injected at virtual times. As in a live stack, sequence
numbers of a session must rise. A test may publish in another service's name, so there are no intruders.
"""

import heapq
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar, cast

from shared import topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.kernel_cache import warm_up
from shared.messages import Message, PortState, SerialData, Stamp
from shared.rejections import RejectionCause
from shared.requests import Request
from shared.runners.admission import Admission, Verdict
from shared.runners.host import Effect, Host, JobOrder, Sent, merged
from shared.runners.tick_timer import TickTimer
from shared.service import Checkpoint, Service
from shared.topics import SERVICES, Publication, key_of
from shared.types import NS_PER_S

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

START: Stamp = 1_000_000_000_000_000_000
"""ns: start of virtual time, a plausible time of a wall clock."""

Sink = Callable[[Sent], None]
Filter = Callable[[Sent, str], float | None]
"""(publication, subscriber's name) -> extra delay in s, or None to lose it."""
Port = tuple[str, str]
"""(service, its port's name)"""


class Lockstep:
    """Runs services on the virtual clock. `record` sees every publication, in order.

    wires: pairs of ports. Data that a service writes to one end arrives at the other, `topics.RX.within` later.
    """

    def __init__(
        self, services: dict[str, Service], record: Sink | None = None, wires: tuple[tuple[Port, Port], ...] = ()
    ) -> None:
        self.now: int = START
        self.filters: list[Filter] = []
        self.latched: dict[str, Sent] = {}
        self.n_bad = 0  # messages that readers drop: a field is out of its bounds
        self._record = record
        self._hosts: dict[str, Host] = {}
        self._listeners: dict[str, tuple[str, ...]] = {}  # by key: which of the hosts take it
        self._admissions: dict[tuple[str, str], Admission] = {}  # by the listening service's name, and the key
        self._lives: dict[str, int] = {}
        self._timers: dict[str, list[TickTimer]] = {}
        self._busy_until: dict[str, int] = {}
        self._watchers: dict[str, list[Callable[[Any], None]]] = {}
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._cause = 0
        self._operator: dict[str, int] = {}
        self._wires = {end: other for a, b in wires for end, other in ((a, b), (b, a))}
        self._unplugged: set[Port] = set()
        self._checkpoints: dict[str, Checkpoint] = {}  # of killed services
        for name in sorted(services, key=SERVICES.index):
            self.start(name, services[name])

    def start(self, name: str, service: Service) -> None:
        """Starts a service now, also in place of a killed one.

        It gets its own latched values at once, then its checkpoint from before, then the latched values of the others.
        """
        life = self._lives[name] = self._lives.get(name, 0) + 1
        host = self._hosts[name] = Host(service, name, f"{name}-{life}")
        self._listeners.clear()
        self._admissions = {of: admission for of, admission in self._admissions.items() if of[0] != name}
        warm_up(service)
        self._busy_until[name] = self.now
        before = list(self.latched.values())
        for sent in before:
            if sent.envelope.publisher == name and host.hears(sent.key):
                self._take(host, host.message(sent.key, sent.message, sent.envelope, self.now, latched=True))
        checkpoint = self._checkpoints.pop(name, None)
        for row, request in checkpoint.function(*checkpoint.arguments) if checkpoint is not None else ():
            payload = encode(request, Envelope(name, host.session, 0, self.now))
            self._take(host, host.request(row.key, request, payload, self.now)[0])
        timers = [TickTimer(hz, follows, self.now) for hz, _, follows in host.handlers.ticks]
        self._timers[name] = timers
        for index, timer in enumerate(timers):
            self._schedule_tick(name, life, index, timer)
        self._schedule_journal(name, life)
        for sent in before:
            if sent.envelope.publisher != name and host.hears(sent.key):
                self._deliver(sent, name, latched=True)
        for end in self._wires:
            if end[0] == name and not {end, self._wires[end]} & self._unplugged:
                self._from_port(end, topics.PORT(PortState(self.now, end[1], True, "")))

    def kill(self, name: str) -> None:
        """Removes a service. Its jobs and events are discarded; its checkpoint is kept."""
        checkpoint = self._hosts[name].service.checkpoint()
        if checkpoint is not None:
            self._checkpoints[name] = checkpoint
        self._lives[name] += 1
        del self._hosts[name]
        self._listeners.clear()

    def service(self, name: str) -> Service:
        """The running service object, for tests."""
        return self._hosts[name].service

    @property
    def n_waiting(self) -> int:
        """Events that are to come: messages under way, ticks, results of jobs."""
        return len(self._heap)

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        """Calls `action` this many seconds from now."""
        self._push(self.now + round(seconds * 1e9), action)

    def watch(self, key: str, watcher: Callable[[Any], None]) -> None:
        """Calls `watcher` with every message published on a key (without the robot's name), when it is published."""
        self._watchers.setdefault(key, []).append(watcher)

    def publish(self, publication: Publication, publisher: str = "operator") -> None:
        """Publishes a message from outside the services: an operator's command, or a fault."""
        key = key_of(publication.topic, publisher)
        sequence = self._operator[key] = self._operator.get(key, -1) + 1
        envelope = Envelope(publisher, f"{publisher}-0", sequence, self.now)
        self._send(Sent(publication.topic, key, publication.message, envelope, encode(publication.message, envelope)))

    def ask(self, request: Request[Q, R], message: Q, service: str = "") -> R:
        """The reply to a request at the present time. service: where several answer. KeyError when it does not run."""
        host = self._hosts[service or request.by]
        payload = encode(message, Envelope("operator", "operator-0", 0, self.now))
        effects, reply = host.request(request.key, decode(request.request, payload)[0], payload, self.now)
        self._take(host, effects)
        if not isinstance(reply, request.reply):
            raise TypeError(f"{request.key} replied with {type(reply).__name__}, not {request.reply.__name__}")
        return reply

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Runs for a virtual time (s), or until the condition holds after an event. Returns whether it held."""
        end = self.now + round(seconds * 1e9)
        while self._heap and self._heap[0][0] <= end:
            self.now, _, event = heapq.heappop(self._heap)
            event()
            if until():
                return True
        self.now = end
        return until()

    def flush(self) -> None:
        """Publishes the journals of the last events. Call it before the recording is closed."""
        for host in self._hosts.values():
            self._send_journals(host)

    def _send_journals(self, host: Host) -> None:
        while (journal := host.journal(self.now)) is not None:
            self._send(journal)

    def _push(self, when: int, event: Callable[[], None]) -> None:
        self._cause += 1
        heapq.heappush(self._heap, (when, self._cause, event))

    def _alive(self, name: str, life: int) -> Host | None:
        return self._hosts.get(name) if self._lives.get(name) == life else None

    def _schedule_tick(self, name: str, life: int, index: int, timer: TickTimer) -> None:
        def tick() -> None:
            host = self._alive(name, life)
            if host is not None and timer.due == self.now:  # else another tick was scheduled
                timer.advance(self.now)
                self._schedule_tick(name, life, index, timer)
                self._take(host, host.tick(index, self.now))

        self._push(timer.due, tick)

    def _keep_step(self, name: str, life: int, key: str) -> None:
        """Reschedules the ticks that follow a topic, after a message of it."""
        for index, timer in enumerate(self._timers[name]):
            due = timer.due
            timer.follow(key, self.now)
            if timer.due != due:
                self._schedule_tick(name, life, index, timer)

    def _schedule_journal(self, name: str, life: int) -> None:
        def write() -> None:
            host = self._alive(name, life)
            if host is not None:
                self._schedule_journal(name, life)
                self._send_journals(host)

        self._push(self.now + NS_PER_S, write)

    def _take(self, host: Host, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Sent):
                self._send(effect)
            else:
                self._run_job(host, effect)

    def _run_job(self, host: Host, order: JobOrder) -> None:
        name, life = host.name, self._lives[host.name]
        result = order.job.function(*order.job.arguments)
        begins = max(self.now, self._busy_until[name])
        ends = self._busy_until[name] = begins + round(order.job.takes * 1e9)

        def done() -> None:
            host = self._alive(name, life)
            if host is not None:
                self._take(host, host.done(order, result, self.now))

        self._push(ends, done)

    def _send(self, sent: Sent) -> None:
        if self._record is not None:
            self._record(sent)
        try:
            message, _ = decode(sent.topic.type, sent.payload)
        except CodecError:
            self.n_bad += 1  # its readers drop it
            return
        sent = Sent(sent.topic, sent.key, message, sent.envelope, sent.payload)
        if sent.topic.latched:
            before = self.latched.get(sent.key)
            whole = merged(before.message if before else None, message)
            self.latched[sent.key] = Sent(sent.topic, sent.key, whole, sent.envelope, b"")
        for watcher in self._watchers.get(sent.key, ()):
            watcher(message)
        if sent.topic is topics.TX or sent.topic is topics.PLUG:
            self._to_port(sent.envelope.publisher, cast("SerialData | PortState", message))
        if sent.topic.by == "*":
            return  # for people, or for the service's own ports
        listeners = self._listeners.get(sent.key)
        if listeners is None:
            listeners = tuple(name for name, host in self._hosts.items() if host.hears(sent.key))
            self._listeners[sent.key] = listeners
        for name in listeners:
            if name != sent.envelope.publisher:
                self._deliver(sent, name)

    def _to_port(self, name: str, message: SerialData | PortState) -> None:
        """Passes data or a plug of a port to the other end of its wire, if it has one."""
        end = name, message.port
        other = self._wires.get(end)
        if other is None:
            return
        if isinstance(message, PortState):
            (self._unplugged.discard if message.open else self._unplugged.add)(end)
            detail = "" if message.open else "unplugged"
            self._from_port(other, topics.PORT(PortState(self.now, other[1], message.open, detail)))
        elif not {end, other} & self._unplugged:
            self._from_port(other, topics.RX(SerialData(self.now, other[1], message.data)))

    def runs(self, name: str) -> bool:
        """Whether a service runs."""
        return name in self._hosts

    def hear(self, publication: Publication) -> None:
        """Another robot's message on a topic with `from_robots` arrives `within` later."""
        name = publication.topic.publishers[0]
        life = self._lives.get(name, 0)

        def arrive() -> None:
            host = self._alive(name, life)
            if host is not None:
                self._take(host, host.from_port(publication, self.now))

        self._push(self.now + round(publication.topic.within * 1e9), arrive)

    def _from_port(self, end: Port, publication: Publication) -> None:
        name, life = end[0], self._lives.get(end[0], 0)

        def arrive() -> None:
            host = self._alive(name, life)
            if host is not None:
                message = replace(publication.message, stamp=self.now)
                self._take(host, host.from_port(Publication(publication.topic, message), self.now))

        self._push(self.now + round(publication.topic.within * 1e9), arrive)

    def _deliver(self, sent: Sent, name: str, latched: bool = False) -> None:
        life, delay = self._lives[name], sent.topic.within
        for lost_or_late in self.filters:
            extra = lost_or_late(sent, name)
            if extra is None:
                return
            delay += extra

        def arrive() -> None:
            host = self._alive(name, life)
            if host is None:
                return
            admission = self._admissions.get((name, sent.key))
            if admission is None:
                admission = self._admissions[name, sent.key] = Admission(sent.topic)
            if admission.judge(sent.envelope, self.now, latched) is Verdict.OLD:
                if not latched:
                    host.rejected(sent.key, RejectionCause.SEQUENCE, admission.words, 1, self.now)
                return
            self._take(host, host.message(sent.key, sent.message, sent.envelope, self.now, latched))
            self._keep_step(name, life, sent.topic.key)

        self._push(self.now + round(delay * 1e9), arrive)
