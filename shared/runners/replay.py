# SPDX-License-Identifier: Apache-2.0
"""Runs services on the events of their journals: the same events in the same order give the same bytes.

Several services are replayed as a chain: a publication of one is the input of the next, at the event that its journal
names. Equal bytes are promised up to the first `ReplayGap`. Behind it the replay goes on with the messages that it has.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from shared import topics
from shared.codec import CodecError, Envelope, decode, envelope_of
from shared.config import UserError, nearest
from shared.kernel_cache import warm_up
from shared.messages import Message
from shared.recording import Recording
from shared.rejections import RejectionCause
from shared.runners.host import (
    DONE,
    LATCHED,
    MESSAGE,
    REJECTED,
    REQUEST,
    SHUTDOWN,
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
MAX_BATCH = 500
"""Events of one session before the other sessions and the progress."""

Build = Callable[[str], Service]
"""A function that builds a service by name, in its initial state."""
Progress = Callable[[int, int], None]
"""A function of the number of handled events and of all events."""


@dataclass(frozen=True, slots=True)
class ReplayGap:
    """A missing input: index of the event in its session's journal, its time (ns), and what is missing."""

    name: str
    session: str
    event: int
    now: int
    what: str

    def __str__(self) -> str:
        return f"{self.name} ({self.session}), event {self.event}: {self.what}"


@dataclass(frozen=True, slots=True)
class JobRun:
    """A job of a service: name of its handler, times of order and end (ns), and computation time (s)."""

    name: str
    done: str
    ordered: int
    ended: int
    spent: float


@dataclass(slots=True)
class Replayed:
    """Result of a replay: the publications of each service, in order.

    recorded: recorded publications of the replayed sessions, by (key, session) and sequence.
    until: time (ns) of the last event in a session's journal; later publications are not replayed.
    journalled: False where the recording has no journals, so messages were replayed in the order of their stamps.
    jobs: completed jobs, where there are journals.
    """

    sent: dict[str, list[Sent]]
    gaps: list[ReplayGap] = field(default_factory=list)
    recorded: dict[tuple[str, str], dict[int, bytes]] = field(default_factory=dict)
    until: dict[str, int] = field(default_factory=dict)
    journalled: bool = True
    jobs: list[JobRun] = field(default_factory=list)


def replay(
    recording: Recording, names: list[str], build: Build, progress: Progress = lambda done, of: None
) -> Replayed:
    """Replays these services, each session with a new object from `build`.

    Raises UserError where the recording lacks the journals or messages. Exceptions of handlers pass, with a note that
    names the event.
    """
    lives = recording.lives()
    if not lives:
        return _in_stamp_order(recording, names, build, progress)
    for name in names:
        if name not in lives:
            raise UserError(f"{recording.path} has no journal of {name}", nearest(name, tuple(lives)))
    began = next((entry.log_time for entry in recording.entries()), 0)
    chosen = [_since(life, began) for name in names for life in lives[name]]
    traffic = ReplayTraffic(recording, chosen, [life for of_name in lives.values() for life in of_name])
    runs = [_Run(life, build(life.name), traffic) for life in chosen]
    waiting = [run for run in runs if run.life.events]
    while waiting:
        if not any(run.go() for run in waiting):  # a cycle: each one waits for a message of another
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


def _since(life: Life, began: int) -> Life:
    """The session without events before the recording began (ns)."""
    hole = life.events[0] if life.events else None
    if hole is None or hole.kind != HOLE:
        return life
    later = [event for event in life.events[1:] if event.now >= began]
    n_missing = hole.number + len(life.events) - 1 - len(later)
    return replace(life, events=[Event(HOLE, began, n_missing), *later])


@dataclass(frozen=True, slots=True)
class _Computed:
    """A computed job: result or exception, end (ns) where the replay deviates from the recording, duration (s)."""

    order: JobOrder
    ordered: int
    due: int
    spent: float
    result: Any = None
    error: Exception | None = None


class _Run:
    """The replay of one session."""

    def __init__(self, life: Life, service: Service, traffic: ReplayTraffic) -> None:
        self.life, self.at = life, 0
        self.sent: list[Sent] = []
        self.gaps: list[ReplayGap] = []
        self._traffic = traffic
        self._deviates = False
        self.jobs: list[JobRun] = []
        self._jobs: dict[int, _Computed] = {}
        self._ending = {event.number for event in life.events if event.kind == DONE}
        self._host = Host(service, life.name, life.session, self._first_sequences())
        warm_up(service)

    @property
    def finished(self) -> bool:
        return self.at == len(self.life.events)

    @property
    def next(self) -> Event:
        return self.life.events[self.at]

    def go(self, patient: bool = True) -> bool:
        """Handles events until the end, MAX_BATCH, or one that waits for another session. False if it handled none.

        patient: False to handle the first event without the message that it waits for.
        """
        begun = self.at
        while not self.finished and self.at < begun + MAX_BATCH:
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
        if self._deviates:
            self._end_unrecorded_jobs(event.now)
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
            host.rejected(event.key, RejectionCause(event.why), event.words, event.number, event.now)
        elif event.kind == SHUTDOWN:
            self._apply(host.shutdown(event.now))
        elif event.kind == HOLE:
            self._gap(f"{event.number} entries of the journal are missing")
            if self.at == 0:
                self._hold(event.now)

    def _hold(self, now: int) -> None:
        """Gives a session without its beginning the latched values from when the recording began."""
        for key, (message, envelope) in self._traffic.held.items():
            if self._host.hears(key):
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
                self._deviates |= not self._traffic.publish(effect)
            else:
                self._jobs[effect.index] = _computed(effect, self._host.service.now)

    def _end_unrecorded_jobs(self, now: int) -> None:
        """Ends jobs that the journal does not end, at their due time, where the replay deviates from the recording."""
        for index, job in sorted(self._jobs.items()):
            if index not in self._ending and job.due <= now:
                self._done(self._jobs.pop(index), now)

    def _done(self, job: _Computed, now: int) -> None:
        if job.error is not None:  # as live: raised in place of its result
            raise job.error
        self.jobs.append(JobRun(self.life.name, job.order.job.done, job.ordered, now, job.spent))
        self._apply(self._host.done(job.order, job.result, now))

    def _gap(self, what: str) -> None:
        self._deviates = True
        self.gaps.append(ReplayGap(self.life.name, self.life.session, self.at, self.next.now, what))

    def _first_sequences(self) -> dict[str, int]:
        """First sequence number of each key, where the journal lacks its beginning: that of the first later message."""
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
    """Replays the recorded messages in the order of their stamps, on a virtual clock."""
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
        if done % MAX_BATCH == 0:
            progress(done, len(messages))
    lockstep.run(1.0)
    progress(len(messages), len(messages))
    return replayed
