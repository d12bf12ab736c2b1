# SPDX-License-Identifier: Apache-2.0
"""Runs services on the events that their journals tell: the same events in the same order give the same bytes.

Several services are replayed as a chain: what one publishes now is what the next one takes, at the event where its
journal says so. The promise of equal bytes ends at the first `Gap`; the replay goes on behind it as well as it can.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from shared import topics
from shared.codec import CodecError, Envelope, decode, envelope_of
from shared.config import UserError, nearest
from shared.messages import Message
from shared.recording import Recording
from shared.rejections import Kind
from shared.runners.host import (
    DONE,
    FAREWELL,
    LATCHED,
    MESSAGE,
    REJECTED,
    REQUEST,
    TICK,
    Effect,
    Host,
    JobOrder,
    Sent,
    request_of,
)
from shared.runners.journal import HOLE, Event, Life
from shared.runners.lockstep import Lockstep
from shared.runners.replay_traffic import MissingError, ReplayTraffic, valid
from shared.service import Service, handlers
from shared.topics import Publication, Topic

T = TypeVar("T")

DAY = 86_400_000_000_000
AT_ONCE = 500
"""Events of one session between two looks at the others, and at the progress."""

Build = Callable[[str], Service]
"""A new service of this name, as it stood at its start."""
Progress = Callable[[int, int], None]
"""Called now and then with the events done and all events."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Where something is missing: the event's place in its session's journal, its time in ns, and what."""

    name: str
    session: str
    event: int
    now: int
    what: str

    def __str__(self) -> str:
        return f"{self.name} ({self.session}), event {self.event}: {self.what}"


@dataclass(frozen=True, slots=True)
class JobRun:
    """A job of a service: by its handler's name, when (ns) it was ordered and ended, and how long (s) it took here."""

    name: str
    done: str
    ordered: int
    ended: int
    spent: float


@dataclass(slots=True)
class Replayed:
    """What came out: per service, the publications of its handlers in order.

    recorded: what the replayed sessions had published, by (key, session) and sequence.
    until: by session, the time (ns) of the last event that its journal tells: what was sent later is not replayed.
    journalled: False where the recording has no journals and was fed in the order of the stamps.
    jobs: those that ended, where there are journals.
    """

    sent: dict[str, list[Sent]]
    gaps: list[Gap] = field(default_factory=list)
    recorded: dict[tuple[str, str], dict[int, bytes]] = field(default_factory=dict)
    until: dict[str, int] = field(default_factory=dict)
    journalled: bool = True
    jobs: list[JobRun] = field(default_factory=list)


def replay(
    recording: Recording, names: list[str], build: Build, progress: Progress = lambda done, of: None
) -> Replayed:
    """Replays these services, each session with a new object from `build`.

    Raises UserError where the recording does not hold what is asked; what a handler raises passes, with a note that
    names the event.
    """
    lives = recording.lives()
    if not lives:
        return _in_stamp_order(recording, names, build, progress)
    for name in names:
        if name not in lives:
            raise UserError(f"{recording.path} has no journal of {name}", nearest(name, tuple(lives)))
    began = next((entry.log_time for entry in recording.entries()), 0)
    chosen = [_heard(life, began) for name in names for life in lives[name]]
    traffic = ReplayTraffic(recording, chosen, [life for of_name in lives.values() for life in of_name])
    runs = [_Run(life, build(life.name), traffic) for life in chosen]
    waiting = [run for run in runs if run.life.events]
    while waiting:
        if not any(run.go() for run in waiting):  # a circle, in which nobody sends what the next one needs
            min(waiting, key=lambda run: run.next.now).go(patient=False)
        progress(sum(run.at for run in runs), sum(len(life.events) for life in chosen))
        waiting = [run for run in waiting if not run.finished]
    return Replayed(
        {name: [sent for run in runs if run.life.name == name for sent in run.sent] for name in names},
        [gap for run in runs for gap in run.gaps],
        traffic.recorded,
        traffic.ended,
        jobs=[job for run in runs for job in run.jobs],
    )


def _heard(life: Life, began: int) -> Life:
    """Of a session that is older than the recording, what happened since the recording began (ns)."""
    hole = life.events[0] if life.events else None
    if hole is None or hole.kind != HOLE:
        return life
    later = [event for event in life.events[1:] if event.now >= began]
    n_unheard = hole.number + len(life.events) - 1 - len(later)
    return replace(life, events=[Event(HOLE, began, n_unheard), *later])


@dataclass(frozen=True, slots=True)
class _Computed:
    """A job that has been run: its result, or what it raised; when it is over off the recorded course; s it took."""

    order: JobOrder
    ordered: int
    due: int
    spent: float
    result: Any = None
    error: Exception | None = None


class _Run:
    """One session on its way through its journal."""

    def __init__(self, life: Life, service: Service, traffic: ReplayTraffic) -> None:
        self.life, self.at = life, 0
        self.sent: list[Sent] = []
        self.gaps: list[Gap] = []
        self._traffic = traffic
        self._astray = False
        self.jobs: list[JobRun] = []
        self._jobs: dict[int, _Computed] = {}
        self._ending = {event.number for event in life.events if event.kind == DONE}
        self._host = Host(service, life.name, life.session, self._first_sequences())
        service.warm()

    @property
    def finished(self) -> bool:
        return self.at == len(self.life.events)

    @property
    def next(self) -> Event:
        return self.life.events[self.at]

    def go(self, patient: bool = True) -> bool:
        """Takes events until the end, for a while, or until one needs what others will publish; False: it took none.

        Not patient: does without what the first event needs.
        """
        begun = self.at
        while not self.finished and self.at < begun + AT_ONCE:
            event = self.next
            try:
                self._take(event)
            except MissingError as missing:
                if patient and missing.session in self._traffic.sessions - {*self._traffic.ended, self.life.session}:
                    return self.at > begun
                self._gap(str(missing))
            except Exception as error:
                error.add_note(f"replaying {self.life.name} ({self.life.session}): event {self.at} at {event.now} ns")
                raise
            self.at, patient = self.at + 1, True
        if self.at == len(self.life.events):
            self._traffic.ended[self.life.session] = self.life.events[-1].now
        return self.at > begun

    def _take(self, event: Event) -> None:
        host = self._host
        if self._astray:
            self._end_strays(event.now)
        if event.kind in (MESSAGE, LATCHED):
            topic = _known(topics.topic_of(event.key), event.key)
            message, envelope = self._message(topic, event)
            if topic.key in host.handlers.topics:
                self._apply(host.message(event.key, message, envelope, event.now, event.kind == LATCHED))
            else:
                self._gap(f"{self.life.name} does not listen to {event.key} any more")
        elif event.kind == TICK and event.number < len(host.handlers.ticks):
            self._apply(host.tick(event.number, event.now))
        elif event.kind == TICK:
            self._gap(f"{self.life.name} has no tick {event.number} any more")
        elif event.kind == REQUEST:
            request = _known(request_of(event.key), event.key)
            if request.key in host.handlers.requests:
                message = valid(request.request, event.payload)
                self._apply(host.request(event.key, message, event.payload, event.now)[0])
            else:
                self._gap(f"{self.life.name} does not answer {request.key} any more")
        elif event.kind == DONE and event.number in self._jobs:
            self._done(self._jobs.pop(event.number), event.now)
        elif event.kind == DONE:
            self._gap(f"job {event.number} is done but was not ordered")
        elif event.kind == REJECTED:
            host.rejected(event.key, Kind(event.why), event.words, event.number, event.now)
        elif event.kind == FAREWELL:
            self._apply(host.farewell(event.now))
        elif event.kind == HOLE:
            self._gap(f"{event.number} entries of the journal are missing")
            if self.at == 0:
                self._hold(event.now)

    def _hold(self, now: int) -> None:
        """A session whose beginning is not known gets what was latched when the recording began, as a late joiner."""
        for key, (message, envelope) in self._traffic.held.items():
            if key in self._host.handlers.topics:
                self._apply(self._host.message(key, message, envelope, now, latched=True))

    def _message(self, topic: Topic[Message], event: Event) -> tuple[Message, Envelope]:
        kept = self._traffic.kept(event.key, event.session, event.number) if event.kind == LATCHED else None
        if kept is not None:
            return valid(topic.type, kept), envelope_of(kept)
        payload = self._traffic.payload(event.key, event.session, event.number)
        if event.kind == LATCHED and hasattr(topic.type, "merged"):
            message = self._traffic.latched(topic, event.key, event.session, event.number)
            return message, envelope_of(payload)
        return valid(topic.type, payload), envelope_of(payload)

    def _apply(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Sent):
                self.sent.append(effect)
                self._astray |= not self._traffic.publish(effect)
            else:
                self._jobs[effect.index] = _computed(effect, self._host.service.now)

    def _end_strays(self, now: int) -> None:
        """Off the recorded course, jobs that the journal does not end are done when their time is over."""
        for index, job in sorted(self._jobs.items()):
            if index not in self._ending and job.due <= now:
                self._done(self._jobs.pop(index), now)

    def _done(self, job: _Computed, now: int) -> None:
        if job.error is not None:  # as live: it is raised where its result would have come
            raise job.error
        self.jobs.append(JobRun(self.life.name, job.order.job.done, job.ordered, now, job.spent))
        self._apply(self._host.done(job.order, job.result, now))

    def _gap(self, what: str) -> None:
        self._astray = True
        self.gaps.append(Gap(self.life.name, self.life.session, self.at, self.next.now, what))

    def _first_sequences(self) -> dict[str, int]:
        """Where each key's count stood when the journal begins in the middle: at what was recorded first after it."""
        events = self.life.events
        if len(events) < 2 or events[0].kind != HOLE:
            return {}
        counts: dict[str, int] = {}
        for (key, session), payloads in self._traffic.recorded.items():
            if session == self.life.session:
                later = (n for n, payload in payloads.items() if envelope_of(payload).sent >= events[1].now)
                counts[key] = min(later, default=0)
        return counts


def _computed(order: JobOrder, now: int) -> _Computed:
    due, begun = now + round(order.job.takes * 1e9), time.perf_counter()
    try:
        result = order.job.function(*order.job.arguments)
    except Exception as error:
        return _Computed(order, now, due, 0.0, error=error)
    return _Computed(order, now, due, time.perf_counter() - begun, result)


def _known(row: T | None, key: str) -> T:
    if row is None:
        raise UserError(f"this version knows no {key}", "replay with the version that recorded it")
    return row


# --- without journals -----------------------------------------------------------------------------------------------


def _in_stamp_order(recording: Recording, names: list[str], build: Build, progress: Progress) -> Replayed:
    """The services on a virtual clock, fed with what was recorded in the order of the stamps."""
    services = {name: build(name) for name in names}
    inputs = {key for service in services.values() for key in handlers(type(service)).topics}
    messages: list[tuple[int, Publication, str]] = []
    for entry in recording.entries():
        topic = topics.topic_of(entry.key)
        if topic is None or topic.key not in inputs:
            continue
        try:
            message, envelope = decode(topic.type, entry.payload)
        except CodecError:
            continue  # as the boundary of a running service would drop it
        if envelope.publisher not in names:
            messages.append((message.stamp, topic(message), envelope.publisher))
    if not messages:
        raise UserError(f"{recording.path} holds nothing that {', '.join(names)} could take", "choose other services")
    messages.sort(key=lambda row: row[0])
    first, last = messages[0][0], messages[-1][0]
    if last - first > DAY:
        raise UserError(f"the stamps in {recording.path} span {(last - first) / DAY:.0f} days", "trim the recording")

    replayed = Replayed({name: [] for name in names}, journalled=False)

    def record(sent: Sent) -> None:
        if sent.envelope.publisher in names and sent.topic is not topics.JOURNAL:
            replayed.sent[sent.envelope.publisher].append(sent)

    lockstep = Lockstep({}, record)
    lockstep.now = first
    for name, service in services.items():
        lockstep.start(name, service)
    for done, (stamp, publication, publisher) in enumerate(messages):
        lockstep.run((stamp - lockstep.now) / 1e9)
        lockstep.publish(publication, publisher)
        if done % AT_ONCE == 0:
            progress(done, len(messages))
    lockstep.run(1.0)
    progress(len(messages), len(messages))
    return replayed
