# SPDX-License-Identifier: Apache-2.0
"""The part that all runners share: it feeds a service with events, encodes its publications and writes its journal.

The journal is a list of entries, in the order in which the service handled them. `now` is in ns. A small number stands
for a pair (key, session). Each journal message defines its numbers, so it can be read alone.

    [0, now, source, sequence]: a message.
    [1, now, tick]: a tick, by its index among the handlers.
    [2, now, job]: the result of a job.
    [3, now, key, bytes]: a request, as its bytes.
    [4, source, key, session]: the number of a source.
    [5, now, source, sequence]: a latched value for a late subscriber, with all messages of the source up to there.
    [6, now]: the shutdown.
    [7, now, key, why, words, n]: n messages on a key that the runner rejected (shared/rejections.py).

Data from a service's ports is published for the recorder, in a session of its own. A replay uses the recorded data.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, cast

import msgpack

from shared import topics
from shared.codec import Envelope, encode
from shared.messages import Journal, LogLine, Message
from shared.rejections import RejectionCause
from shared.requests import REQUESTS, Request
from shared.service import Job, Log, Out, Service, handlers, outputs
from shared.topics import Publication, Topic, key_of

JOURNAL_FULL = 2**20
"""bytes of requests in one journal message; the journal continues in the next. A message may have 4 MiB."""

MESSAGE, TICK, DONE, REQUEST, SOURCE, LATCHED, SHUTDOWN, REJECTED = range(8)


@dataclass(frozen=True, slots=True)
class Sent:
    """A publication on its way out: the key without the robot's name, and the bytes as they go on the wire."""

    topic: Topic[Message]
    key: str
    message: Message
    envelope: Envelope
    payload: bytes


@dataclass(frozen=True, slots=True)
class JobOrder:
    """A job that a handler yielded; `index` counts them from 0 in the order of yielding."""

    index: int
    job: Job


Effect = Sent | JobOrder


class Host:
    """Feeds one service. Every event sets `service.now`, enters the journal, and returns its effects in order.

    sequences: first sequence number by key, for the replay of a session without its beginning. now: ns, of an event.
    """

    def __init__(self, service: Service, name: str, session: str, sequences: dict[str, int] | None = None) -> None:
        self.service, self.name, self.session = service, name, session
        service.name = name
        self.handlers = handlers(type(service))
        self.n_events = 0
        self.before_port: Callable[[Sent], None] = lambda sent: None
        """Called with a message of a port, before the service handles it."""
        self._sequences = dict(sequences or {})
        self._n_jobs = 0
        self._sources: dict[tuple[str, str], int] = {}
        self._entries: list[tuple[Any, ...]] = []
        self._n_bytes = 0  # of requests among them
        self._full: list[Journal] = []
        self._first = 0

    def hears(self, key: str) -> bool:
        """Whether the service takes a key (without the robot's name); of a family only its own."""
        topic = topics.topic_of(key)
        return topic is not None and topic.key in self.handlers.topics and key in (topic.key, key_of(topic, self.name))

    def message(self, key: str, message: Message, envelope: Envelope, now: int, latched: bool = False) -> list[Effect]:
        """Handles a message of a key (without the robot's name). latched: a value from before the subscription."""
        topic = topics.topic_of(key)
        if topic is None:
            raise KeyError(key)
        source = self._source(key, envelope.session)
        self._note((LATCHED if latched else MESSAGE, now, source, envelope.sequence), now)
        return self._effects(getattr(self.service, self.handlers.topics[topic.key][1])(message))

    def tick(self, index: int, now: int) -> list[Effect]:
        """Handles the tick with this index among the service's ticks."""
        self._note((TICK, now, index), now)
        return self._effects(getattr(self.service, self.handlers.ticks[index][1])())

    def done(self, order: JobOrder, result: Any, now: int) -> list[Effect]:
        """Handles the result of a job."""
        self._note((DONE, now, order.index), now)
        return self._effects(getattr(self.service, order.job.done)(result))

    def failed(self, order: JobOrder, now: int) -> None:
        """Notes a job that raised an exception, in place of its result, as the last event of the session."""
        self._note((DONE, now, order.index), now)

    def request(self, key: str, request: Message, payload: bytes, now: int) -> tuple[list[Effect], Message]:
        """Handles a request. Returns the handler's effects and the reply."""
        if self._n_bytes + len(payload) > JOURNAL_FULL:
            self._end_journal(now)
        self._n_bytes += len(payload)
        self._note((REQUEST, now, key, payload), now)
        answering = getattr(self.service, self.handlers.requests[key][1])(request)
        effects: list[Effect] = []
        while True:
            try:
                effects += self._effects((next(answering),))
            except StopIteration as end:
                return effects, end.value

    def shutdown(self, now: int) -> list[Effect]:
        """The process is asked to end."""
        self._note((SHUTDOWN, now), now)
        return self._effects(self.service.on_shutdown())

    def rejected(self, key: str, kind: RejectionCause, words: str, n: int, now: int) -> None:
        """The runner rejected messages of a key that the service listens to: that is an event too, so it replays."""
        self._note((REJECTED, now, key, str(kind), words, n), now)
        self.service.rejections.reject(key, kind, words, now, n)

    def from_port(self, publication: Publication, now: int) -> list[Effect]:
        """One of the service's ports spoke (topics.RX, topics.PORT), or another robot: that, and what comes of it."""
        sent = self._sent(publication, f"{self.session}-port", now)
        if sent.topic.key not in self.handlers.topics:
            return [sent]
        self.before_port(sent)
        return [sent, *self.message(sent.key, sent.message, sent.envelope, now)]

    def publish(self, publication: Publication, now: int) -> Sent:
        """Encodes a publication under this service's name: for the handlers' own, and for the runner's health."""
        return self._sent(publication, self.session, now)

    def _sent(self, publication: Publication, session: str, now: int) -> Sent:
        topic = publication.topic
        if self.name not in topic.publishers:
            raise TypeError(f"{self.name} may not publish {topic.key}: the registry says by={topic.by!r}")
        key = key_of(topic, self.name)
        sequence = self._sequences.get(key, 0)
        self._sequences[key] = sequence + 1
        envelope = Envelope(self.name, session, sequence, now)
        return Sent(topic, key, publication.message, envelope, encode(publication.message, envelope))

    def journal(self, now: int) -> Sent | None:
        """The events since the last call, as a publication; None when there are none. To be called until then."""
        self._end_journal(now)
        return self.publish(topics.JOURNAL(self._full.pop(0)), now) if self._full else None

    def _end_journal(self, now: int) -> None:
        if not self._entries:
            return
        events = bytes(msgpack.packb(self._entries, use_bin_type=True))
        self._full.append(Journal(now, self.session, self._first, events))
        self._first += len(self._entries)
        self._entries = []
        self._sources = {}
        self._n_bytes = 0

    def _note(self, entry: tuple[Any, ...], now: int) -> None:
        self.n_events += 1
        self._entries.append(entry)
        self.service.now = now

    def _source(self, key: str, session: str) -> int:
        known = self._sources.get((key, session))
        if known is None:
            known = self._sources[(key, session)] = len(self._sources)
            self._entries.append((SOURCE, known, key, session))
        return known

    def _effects(self, result: Out | None) -> list[Effect]:
        return list(self._each_effect(result))

    def _each_effect(self, result: Out | None) -> Iterator[Effect]:
        for output in outputs(result):
            if isinstance(output, Publication):
                yield self.publish(output, self.service.now)
            elif isinstance(output, Job):
                yield JobOrder(self._n_jobs, output)
                self._n_jobs += 1
            elif isinstance(output, Log):
                yield self.publish(topics.LOG(LogLine(self.service.now, output.level, output.text)), self.service.now)
            else:
                raise TypeError(f"{self.name} yielded {output!r}: neither a publication, nor a Job, nor a Log")


def request_of(key: str) -> Request[Message, Message] | None:
    """The registry's row for a request key, or None."""
    return next((row for row in REQUESTS if row.key == key), None)


def merged(before: Message | None, message: Message) -> Message:
    """The latched value after a message: the message, merged into the earlier value where its class can."""
    merge = getattr(before, "merged", None)
    return message if merge is None else cast(Message, merge(message))
