# SPDX-License-Identifier: Apache-2.0
"""Runs one service over Zenoh. Callbacks only queue bytes; one loop handles them in order."""

import logging
import os
import time
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from operator import attrgetter
from typing import Any, cast

import zenoh

from shared import reasons, topics
from shared.codec import CodecError, Envelope, decode, encode, envelope_of
from shared.messages import LogLine, Message
from shared.reasons import Reason
from shared.requests import Request
from shared.runners import transport
from shared.runners.admission import Admission, Verdict
from shared.runners.blackbox import BlackBox, Taken, crash_line
from shared.runners.checkpoint_disk import CheckpointDisk
from shared.runners.clock import StackClock
from shared.runners.devices import DeviceOpener
from shared.runners.heap_trim import HeapTrimmer
from shared.runners.host import Effect, Host, JobOrder, Sent
from shared.runners.inbox import Inbox, Slot
from shared.runners.latched_disk import LatchedDisk
from shared.runners.latched_store import LatchedStore
from shared.runners.link_stats import LinkStats
from shared.runners.other_robots import OtherRobotsAdmission, key_of_others
from shared.runners.port import Port
from shared.runners.refusals import Refusals
from shared.runners.tick_timer import TickTimer
from shared.runners.waiting_topics import WaitingTopics
from shared.service import Service
from shared.topics import TOPICS, Topic, key_of
from shared.types import NS_PER_S
from shared.unknown_fields import unknown_fields, unknown_text

MAX_REQUESTS = 8
URGENT = "cmd/vel", "cmd/nav", "hardware/motors", "estop"
FIRST_INTERVAL_NS = NS_PER_S // 10  # between the first health messages: the links to their readers may not stand yet

log = logging.getLogger("zenav")


class LiveRunner:
    """One service on one session. `run` returns when `stop` was called."""

    def __init__(
        self,
        service: Service,
        name: str,
        robot: str,
        session: zenoh.Session,
        clock: StackClock,
        disk: LatchedDisk | None = None,
        box: BlackBox | None = None,
        open_device: DeviceOpener = Port,
    ) -> None:
        self.clock, self.session, self.name, self.robot = clock, session, name, robot
        self.host = Host(service, name, f"{time.time_ns():x}-{os.getpid():x}")
        self.inbox, self.stats, self._heap = Inbox(), LinkStats(), HeapTrimmer()
        self._stopping, self._box = False, box
        self.host.before_port = lambda sent: self._boxed(sent.key, sent.payload, sent.envelope, sent.envelope.sent)
        self._everything = transport.Everything(session, robot) if hasattr(service, "raw") else None
        self._patience = 0.25 if self._everything is None else 0.1  # s; the recorder polls
        self._requests = self.inbox.slot("requests", "all", MAX_REQUESTS)
        self._results = self.inbox.slot("jobs", "all")
        self._admissions: dict[str, Admission] = {}
        self._senders: dict[str, str] = {}  # by key: the session of its last message
        self._refusals = Refusals()
        self._latched_readers: dict[str, transport.LatchedReader] = {}
        self._from_ports = self.inbox.slot("ports", "all")
        self._slots: list[Slot] = [self._requests, self._from_ports]
        self._others: dict[str, OtherRobotsAdmission] = {}  # by key
        self._workers = ThreadPoolExecutor(1, thread_name_prefix="job")
        listened = [topic for topic, _ in self.host.handlers.topics.values()]
        own = [key_of(topic, name) for topic in listened if topic.latched and name in topic.publishers]
        self._latched = LatchedStore(disk, own)
        self._checkpoints = CheckpointDisk(disk.folder, name, self._workers) if disk is not None else None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._waiting = WaitingTopics(session, robot)
        self._timers: list[TickTimer] = []
        self._ports = {
            port: open_device(port, config, clock, partial(self.inbox.file, self._from_ports))
            for port, config in service.ports.items()
            if config.given
        }
        self._declared: list[Any] = []
        self._declare()

    def stop(self) -> None:
        """Ends `run` after the present event."""
        self._stopping = True
        self.inbox.close()

    def run(self) -> None:
        """Feeds the service until `stop`."""
        crashed: int | None = None
        now = report = self.clock.now()
        self._timers = [TickTimer(hz, follows, now) for hz, _, follows in self.host.handlers.ticks]
        self._restore(now)
        for port in self._ports.values():
            port.start()
        try:
            self._feed(report)
            self._take_raws()
            self._apply([effect for effect in self.host.shutdown(self.clock.now()) if isinstance(effect, Sent)])
        except Exception as error:
            crashed = self.host.service.now
            line = topics.LOG(LogLine(crashed, "ERROR", crash_line(error, crashed)))
            sent = self.host.publish(line, crashed)
            self._publish(sent)
            self._boxed(sent.key, sent.payload, sent.envelope, crashed)
            raise
        finally:  # also after an exception of a handler: its last events explain it
            self._workers.shutdown(wait=False, cancel_futures=True)
            for port in self._ports.values():
                port.close()
            self._latched.close()
            self._publish_journals(self.clock.now())
            if self._box is not None and (path := self._box.close(crashed)) is not None:
                log.error("%s replays the crash: zenav replay %s --through %s", path, path, self.name)

    def _feed(self, report: int) -> None:
        """Handles events until `stop`. report: ns, when the first health message is due.

        No tick comes twice before what waits in the inbox: one that is slower than its period would keep all out.
        """
        interval, ticked = FIRST_INTERVAL_NS, set[TickTimer]()
        while not self._stopping:
            self._take_raws()
            self._take_waiting()
            now = self.clock.now()
            self._refusals.report(self.host, now)
            if now >= report or report - now > NS_PER_S:  # due, or the clock was set back
                self._report(now)
                report, interval = now + interval, min(2 * interval, NS_PER_S)
            first = min(self._timers, key=attrgetter("due"), default=None)
            if first in ticked and first.is_due(now):
                ticked.clear()
                for waiting in self.inbox.take_waiting():
                    self._handle(*waiting)
                continue
            if first is not None and first.is_due(now):
                ticked.add(first)
                first.advance(now)
                begun = time.perf_counter()
                self._apply(self.host.tick(self._timers.index(first), now))
                self.stats.slowest = max(self.stats.slowest, time.perf_counter() - begun)
                continue
            until = report if first is None else min(report, first.due)
            item = self.inbox.take(min(self._patience, self.clock.seconds(until - now)))
            if item is not None:
                self._handle(*item)
            else:
                ticked.clear()

    def _restore(self, now: int) -> None:
        """Gives the service its state before a restart: its own latched topics, and its checkpoint."""
        for key, message, envelope in self._latched.restore(now, self.stats.record_error):
            self._boxed(key, encode(message, envelope), envelope, now, kept=True)
            self._apply(self.host.message(key, message, envelope, now, latched=True))
        if self._checkpoints is not None:
            for row, request, payload in self._checkpoints.restored(lambda words: self.stats.record_error(words, now)):
                effects, _ = self.host.request(row.key, request, payload, now)
                self._apply(effects)

    def _declare(self) -> None:
        for topic in TOPICS:
            if self.name in topic.publishers:
                self._declare_publisher(topic)
        for topic, _ in self.host.handlers.topics.values():
            if topic.key in self.host.handlers.waiting:
                self._admissions[topic.key] = Admission(topic)
                self._waiting.add(topic)
            elif topic.from_robots:
                self._declare_listener(topic)
            elif self.name not in topic.publishers:
                self._declare_subscriber(topic)
        for request, _ in self.host.handlers.requests.values():
            answer = partial(self._file_request, request)
            self._declared.append(self.session.declare_queryable(f"{self.robot}/{request.key_of(self.name)}", answer))

    def _declare_publisher(self, topic: Topic[Message]) -> None:
        key = key_of(topic, self.name)
        self._publishers[key] = transport.publisher(self.session, f"{self.robot}/{key}", topic.key in URGENT)
        if topic.latched:
            self._latched.publishers[key] = transport.LatchedPublisher(self.session, f"{self.robot}/{key}")

    def _declare_subscriber(self, topic: Topic[Message]) -> None:
        keys = [topic.key] if topic.by != "*" else [f"{topic.key}/{name}" for name in topic.publishers]
        for key in keys:
            slot = self.inbox.slot(key, topic.keep)
            self._slots.append(slot)
            self._admissions[key] = Admission(topic)
            file = partial(self._file_sample, slot)
            self._declared.append(self.session.declare_subscriber(f"{self.robot}/{key}", file))
            if topic.latched:
                file_kept = partial(self._file_kept, self.inbox.slot(key, "latest"))
                self._latched_readers[key] = transport.LatchedReader(self.session, f"{self.robot}/{key}", file_kept)

    def _declare_listener(self, topic: Topic[Message]) -> None:
        """Subscribes to what the other robots publish."""
        slot = self.inbox.slot(topic.key, topic.keep)
        self._slots.append(slot)
        self._others[topic.key] = OtherRobotsAdmission(topic, self.robot)
        self._declared.append(self.session.declare_subscriber(key_of_others(topic), partial(self._file_heard, slot)))

    def _file_heard(self, slot: Slot, sample: zenoh.Sample) -> None:
        if not self._refusals.oversized(slot.key, sample.payload):
            self.inbox.file(slot, (str(sample.key_expr), sample.payload.to_bytes()))

    def _file_sample(self, slot: Slot, sample: zenoh.Sample) -> None:
        if not self._refusals.oversized(slot.key, sample.payload):
            self.inbox.file(slot, sample.payload.to_bytes())

    def _file_kept(self, slot: Slot, payload: bytes) -> None:
        self.inbox.file(slot, (payload,))

    def _file_request(self, request: Request[Message, Message], query: zenoh.Query) -> None:
        if words := self._refusals.oversized(request.key, query.payload or b""):
            self._refuse(request, query, reasons.TOO_LARGE, words)
        elif len(self._requests.items) >= MAX_REQUESTS:
            self._refuse(request, query, reasons.BUSY, "")
        else:
            self.inbox.file(self._requests, (request, query))

    def _handle(self, slot: Slot, item: Any) -> None:
        self._take_waiting()
        now = self.clock.now()
        begun = time.perf_counter()
        if slot is self._requests:
            request, query = item
            self._answer(request, query, now)
        elif slot is self._results:
            order, future = item
            if future.exception() is not None:
                self.host.failed(order, now)
            self._apply(self.host.done(order, future.result(), now))
        elif slot is self._from_ports:
            self._apply(self.host.from_port(item, now))
        elif slot.key in self._others:
            self._hear(slot.key, item[0], item[1], now)
        elif isinstance(item, tuple):
            self._message(slot.key, item[0], now, begun, latched=True)
        else:
            self._message(slot.key, item, now, begun, latched=False)

    def _take_waiting(self) -> None:
        for key, payload in self._waiting.take():
            if not self._refusals.oversized(key, payload):
                self._message(key, payload.to_bytes(), self.clock.now(), time.perf_counter(), latched=False)

    def _message(self, key: str, payload: bytes, now: int, begun: float, latched: bool) -> None:
        topic = topics.topic_of(key)
        if topic is None:
            raise KeyError(key)
        try:
            message, envelope = decode(topic.type, payload)
        except CodecError as error:
            self.stats.bad += 1
            self.stats.record_error(f"{key}: a bad message was dropped: {error}", now)
            return
        verdict = self._admissions[key].judge(envelope, now, latched)
        if verdict is Verdict.INTRUDER:
            self.stats.intruders += 1
            sender = f"{envelope.publisher} {envelope.session}"
            self.stats.record_error(f"{key}: a second publisher ({sender}) is ignored", now)
            return
        if topic.latched and not latched and not self._admissions[key].complete:  # an answer asks for no other
            self._latched_readers[key].refresh()
        if verdict is Verdict.OLD:
            if not latched and (words := self._admissions[key].words):
                self.stats.old += 1
                self._refusals.sequence(key, words)
            return
        if self._senders.get(key) != envelope.session:
            self._senders[key] = envelope.session
            self._report_unknown(key, topic.type, payload, now)
        self._boxed(key, payload, envelope, now, latched)
        self._apply(self.host.message(key, message, envelope, now, latched))
        for timer in self._timers:
            timer.follow(topic.key, now)
        self.stats.count_message(key, (now - message.stamp) / NS_PER_S, time.perf_counter() - begun)

    def _hear(self, key: str, full_key: str, payload: bytes, now: int) -> None:
        """Gives the service another robot's message, and publishes it for the recorder."""
        try:
            message = self._others[key].admitted(full_key, payload, now)
        except CodecError as error:
            self.stats.bad += 1
            self.stats.record_error(f"{full_key}: a bad message was dropped: {error}", now)
            return
        if message is not None:
            self._apply(self.host.from_port(topics.BY_KEY[key](message), now))

    def _take_raws(self) -> None:
        for full_key, payload, at, latched in self._everything.take_all() if self._everything is not None else ():
            key, now = full_key.removeprefix(f"{self.robot}/"), self.clock.at(at)
            try:
                envelope = envelope_of(payload)
            except CodecError as error:
                self.stats.bad += 1
                self.stats.record_error(f"{key}: not a message: {error}", now)
                continue
            if not latched and self._refusals.oversized(key, payload):
                continue
            self.host.service.now = now
            self.host.n_events += 1
            self.host.service.raw(key, payload, envelope, now, latched)  # type: ignore[attr-defined]  # asked for before

    def _answer(self, request: Request[Message, Message], query: zenoh.Query, now: int) -> None:
        payload = query.payload.to_bytes() if query.payload is not None else b""
        try:
            message, _ = decode(request.request, payload)
        except CodecError as error:
            self.stats.bad += 1
            self.stats.record_error(f"{request.key}: a bad request was refused: {error}", now)
            self._refuse(request, query, reasons.BAD_REQUEST, str(error))
            return
        self._report_unknown(request.key, request.request, payload, now)
        effects, reply = self.host.request(request.key, message, payload, now)
        self._apply(effects)  # first: a client that has the reply finds what it asked for
        replied = encode(reply, Envelope(self.name, self.host.session, 0, now))
        if words := self._refusals.oversized(request.key, replied):
            self._refuse(request, query, reasons.TOO_LARGE, f"the reply has {words}")
        else:
            self._reply(request, query, replied)

    def _refuse(self, request: Request[Message, Message], query: zenoh.Query, reason: Reason, detail: str) -> None:
        """Refuses a request before the service sees it, as the service would. Thread-safe."""
        now = self.clock.now()
        refusal = request.refusal(now, reason, detail)
        self._reply(request, query, encode(refusal, Envelope(self.name, self.host.session, 0, now)))

    def _reply(self, request: Request[Message, Message], query: zenoh.Query, payload: bytes) -> None:
        with query:
            query.reply(f"{self.robot}/{request.key_of(self.name)}", payload)

    def _report_unknown(self, key: str, type_: type[Message], payload: bytes, now: int) -> None:
        if names := unknown_fields(type_, payload):
            self.stats.record_error(f"{key}: {unknown_text(names)}", now)

    def _apply(self, effects: list[Effect]) -> None:
        for effect in effects:  # devices first: they do not wait for the publications
            if isinstance(effect, Sent):
                self._to_port(effect)
        for effect in effects:
            if isinstance(effect, Sent):
                self._publish(effect)
            else:
                future = self._workers.submit(effect.job.function, *effect.job.arguments)
                future.add_done_callback(partial(self._file_result, effect))

    def _file_result(self, order: JobOrder, future: "Future[Any]") -> None:
        if not future.cancelled():
            self.inbox.file(self._results, (order, future))

    def _to_port(self, sent: Sent) -> None:
        order = cast(Any, sent.message)
        if sent.topic is topics.TX and order.port in self._ports:
            self._ports[order.port].write(order.data)
        elif sent.topic is topics.PLUG and order.port in self._ports:
            self._ports[order.port].plug(order.open)

    def _publish(self, sent: Sent) -> None:
        if sent.topic is topics.LOG:
            line = cast(LogLine, sent.message)
            log.log(logging.getLevelNamesMapping().get(line.level, logging.INFO), line.text)
        if sent.topic.latched:
            self._latched.publish(sent)
        if not self._refusals.oversized(sent.key, sent.payload):
            self._publishers[sent.key].put(sent.payload)

    def _report(self, now: int) -> None:
        self._publish_journals(now)
        if self._box is not None:
            self._box.hand_over()
        self._latched.save()
        if self._checkpoints is not None:
            self._checkpoints.step(self.host.service, now)
        dropped = sum(slot.dropped for slot in self._slots if slot.keep == "all")
        rejections = self.host.service.rejections
        self.stats.log_rejections(rejections, now)
        health = self.stats.health(self.name, self.host.service.state(), self.host.n_events, dropped, rejections, now)
        self._publish(self.host.publish(topics.HEALTH(health), now))
        self._heap.look(health.memory)

    def _publish_journals(self, now: int) -> None:
        while (journal := self.host.journal(now)) is not None:
            self._publish(journal)
            self._boxed(journal.key, journal.payload, journal.envelope, now)

    def _boxed(self, key: str, payload: bytes, envelope: Envelope, now: int, kept: bool = False) -> None:
        topic = topics.topic_of(key)
        if self._box is not None and topic is not None:
            self._box.take(Taken(key=key, type=topic.type, payload=payload, envelope=envelope, now=now, latched=kept))
