# SPDX-License-Identifier: Apache-2.0
"""What tools and the page need of a running stack: publish as the operator, listen, read kept values, ask.

with Client("x80", where) as client:
    client.follow(topics.NAV_STATUS)
    client.ask(requests.CANCEL, Cancel(client.now()))
"""

import os
import threading
import time
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any, TypeVar, cast

import zenoh

from shared import topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.config import UserError
from shared.messages import Clock, Message
from shared.reasons import BAD_REQUEST, NOT_RUNNING, REASONS, TOO_LARGE
from shared.requests import Request
from shared.runners import transport
from shared.runners.host import merged
from shared.runners.transport import StackAddress
from shared.stamps import is_older
from shared.topics import SERVICES, Publication, Topic, key_of

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)
Callback = Callable[[M, Envelope], None]

SETTLING_S = 1.0  # within which a new session learns which services answer, on a busy machine too
ASK_AGAIN_S = 0.05
CLOCK_AGE = 2.0  # s without `sim/clock` after which the stack's clock is taken for the wall's again


class Timekeeper:
    """The stack's clock in a tool: the wall clock, or the simulator's where one runs. It runs on between ticks."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None
        self._last = (0.0, 0)

    def add_clock(self, stamp: int, at: float) -> None:
        """The simulator's clock showed `stamp` (ns) at `at` (s, monotonic)."""
        if self._first is None or stamp < self._last[1]:
            self._first = (at, stamp)
        self._last = (at, stamp)

    def now(self, wall: int, at: float) -> int:
        """ns, when the wall's clock shows `wall` (ns) and the monotonic one `at` (s)."""
        if self._first is None or at - self._last[0] > CLOCK_AGE:
            return wall
        elapsed = self._last[0] - self._first[0]
        rate = (self._last[1] - self._first[1]) / 1e9 / elapsed if elapsed > 0.5 else 1.0
        return self._last[1] + round((at - self._last[0]) * rate * 1e9)


class Client:
    """A tool's session. Everything is closed when its `with` block ends.

    instead_of: a service whose port it takes, and with it the place where all others look for that service.
    hears_clock: else it takes the wall's clock for the stack's, and no `sim/clock` wakes it.
    """

    def __init__(self, robot: str, where: StackAddress, instead_of: str = "", hears_clock: bool = True) -> None:
        self.robot, self.where, self._instead_of, self._hears_clock = robot, where, instead_of, hears_clock
        self.changed = threading.Condition()
        self.n_bad = 0
        self._time = Timekeeper()
        self._latest: dict[str, tuple[Message, Envelope, float]] = {}
        self._sequences: dict[str, int] = {}
        self._publishing = threading.Lock()  # messages of a key leave in the order of their numbers
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[Any] = []
        self.session_name = f"{time.time_ns():x}-{os.getpid():x}"

    def __enter__(self) -> "Client":
        self.session = transport.opened(self.where, self._instead_of)
        self._settled = time.monotonic() + SETTLING_S
        if self._hears_clock:
            self.listen(topics.CLOCK, lambda clock, _: self._hear_clock(clock))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.session.close()  # type: ignore[no-untyped-call]  # zenoh's own

    def now(self) -> int:
        """ns on the stack's clock."""
        return self._time.now(time.time_ns(), time.monotonic())

    def publish(self, publication: Publication, publisher: str = "operator") -> None:
        """Publishes as `operator`, or in the place of a service. From any thread.

        Raises UserError where the message is too large.
        """
        key = key_of(publication.topic, publisher)
        with self._publishing:
            if key not in self._publishers:
                self._publishers[key] = transport.publisher(self.session, f"{self.robot}/{key}", urgent=True)
            sequence = self._sequences[key] = self._sequences.get(key, -1) + 1
            envelope = Envelope(publisher, self.session_name, sequence, self.now())
            self._publishers[key].put(_sized(key, encode(publication.message, envelope)))

    def put_raw(self, key: str, payload: bytes) -> None:
        """Publishes bytes as they are. key: with the robot's name."""
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def listen(self, topic: Topic[M], callback: Callback[M]) -> None:
        """Calls back with each message on a topic, all of a family's keys too, and with the kept value.

        The kept value comes first, unless a newer message overtakes it.

        The callback runs on a thread of Zenoh's: it files, and returns.
        """
        for key in [topic.key] if topic.by != "*" else [f"{topic.key}/{name}" for name in SERVICES]:
            self._listen_key(key, topic, callback)

    def listen_raw(self, key: str, callback: Callable[[str, bytes], None]) -> Callable[[], None]:
        """Calls back with the key (without the robot's name) and the bytes of whatever comes; `**` is every key.

        Returns a function that ends it.
        """

        def file(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr).removeprefix(f"{self.robot}/"), sample.payload.to_bytes())

        subscriber = self.session.declare_subscriber(f"{self.robot}/{key}", file)
        self._declared.append(subscriber)

        def end() -> None:
            self._declared.remove(subscriber)
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own

        return end

    def follow(self, *followed: Topic[Any]) -> None:
        """Keeps the newest message of these topics (the merged one, where its class can) for `latest` and `wait`."""
        for topic in followed:
            self.listen(topic, partial(self._keep, topic))

    def latest(self, topic: Topic[M], publisher: str = "") -> M | None:
        """The newest message of a followed topic; `publisher` names the service where the topic is a family."""
        with self.changed:
            newest = self._latest.get(key_of(topic, publisher))
        return cast(M, newest[0]) if newest else None

    def age(self, topic: Topic[Any], publisher: str = "") -> float:
        """Real seconds since the newest message of a followed topic came; infinite before the first."""
        with self.changed:
            newest = self._latest.get(key_of(topic, publisher))
        return time.monotonic() - newest[2] if newest else float("inf")

    def wait(self, topic: Topic[M], holds: Callable[[M], bool], timeout: float, publisher: str = "") -> M | None:
        """The newest message of a followed topic as soon as the condition holds for it; None after `timeout` s."""

        def newest_that_holds() -> M | None:
            newest = self._latest.get(key_of(topic, publisher))
            return cast(M, newest[0]) if newest and holds(cast(M, newest[0])) else None

        with self.changed:
            return self.changed.wait_for(newest_that_holds, timeout)

    def latched_value(self, topic: Topic[M], timeout: float = 3.0) -> M | None:
        """The value that a latched topic's publisher keeps for late joiners; None where none has one in `timeout` s.

        A new session asks again until it knows the services: a query that finds none ends at once.
        """
        found = self._kept_value(topic, timeout)
        while found is None and time.monotonic() < self._settled:
            threading.Event().wait(ASK_AGAIN_S)
            found = self._kept_value(topic, timeout)
        return found

    def _kept_value(self, topic: Topic[M], timeout: float) -> M | None:
        best: tuple[int, M] | None = None
        for reply in self.session.get(f"{self.robot}/{topic.key}", timeout=timeout):
            if reply.ok is None:
                continue
            try:
                message, envelope = decode(topic.type, reply.ok.payload.to_bytes())
            except CodecError:
                self.n_bad += 1
                continue
            if best is None or envelope.sent > best[0]:
                best = envelope.sent, message
        return best[1] if best else None

    def ask(self, request: Request[Q, R], message: Q, timeout: float = 5.0, service: str = "") -> R:
        """The reply to a request, which may refuse it. Raises UserError where it is too large, or no reply comes.

        service: the one that is asked, where several answer.
        """
        service = service or request.by
        envelope = Envelope("operator", self.session_name, 0, self.now())
        payload = _sized(request.key, encode(message, envelope))
        replied = self.ask_raw(request, payload, timeout, service)
        try:
            return decode(request.reply, replied)[0]
        except CodecError as error:
            raise UserError(
                f"{service} sent a reply that cannot be read: {error}", "same version on both sides?"
            ) from None

    def ask_raw(self, request: Request[Any, Any], payload: bytes, timeout: float, service: str = "") -> bytes:
        """The bytes of the reply to a request as its bytes. Raises UserError where none comes."""
        service = service or request.by
        unsettled = self._settled - time.monotonic()
        if unsettled > 0:  # a query that finds no service ends at once
            self.answers(request, unsettled, service)
        words = b""
        for reply in self.session.get(f"{self.robot}/{request.key_of(service)}", payload=payload, timeout=timeout):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            words = reply.err.payload.to_bytes() if reply.err is not None else b""
        raise request_error(service, words)

    def answers(self, request: Request[Any, Any], timeout: float, service: str = "") -> bool:
        """Whether a service that answers this request is there within `timeout` s. service: where several answer."""
        querier: Any = self.session.declare_querier(f"{self.robot}/{request.key_of(service)}")
        try:
            is_matched = threading.Event()
            querier.declare_matching_listener(lambda status: is_matched.set() if status.matching else None)
            there = querier.matching_status  # zenoh calls it a bool; it is a MatchingStatus
            return there.matching or is_matched.wait(timeout)
        finally:
            querier.undeclare()

    def _listen_key(self, key: str, topic: Topic[M], callback: Callback[M]) -> None:
        def take(payload: bytes) -> None:
            try:
                message, envelope = decode(topic.type, payload)
            except CodecError:
                self.n_bad += 1
                return
            callback(message, envelope)

        self.listen_raw(key, lambda _, payload: take(payload))
        if topic.latched:
            self._declared.append(transport.LatchedReader(self.session, f"{self.robot}/{key}", take))

    def _hear_clock(self, clock: Clock) -> None:
        self._time.add_clock(clock.stamp, time.monotonic())

    def _keep(self, topic: Topic[Any], message: Message, envelope: Envelope) -> None:
        key = key_of(topic, envelope.publisher)
        with self.changed:
            before = self._latest.get(key)
            if before is not None and topic.latched:
                late = is_older(envelope, before[1], self.now())  # the kept whole, overtaken by an update
                message = merged(message, before[0]) if late else merged(before[0], message)
                envelope = before[1] if late else envelope
            self._latest[key] = (message, envelope, time.monotonic())
            self.changed.notify_all()


def request_outcome(client: Client, row: Request[Any, Any], payload: bytes, limit: float) -> dict[str, Any]:
    """Sends a request as its bytes: accepted, reason, detail, hint, and `task_id` in `data`. limit: s.

    A request that could not be sent is a refusal.
    """
    try:
        reply = client.ask(row, decode(row.request, payload)[0], limit)
    except UserError as error:
        return refusal(NOT_RUNNING.code, error.what, error.hint)
    except CodecError as error:
        return refusal(BAD_REQUEST.code, str(error), BAD_REQUEST.hint)
    reason = REASONS.get(reply.reason)
    data = {"task_id": getattr(reply, "task_id", 0)}
    outcome = {"accepted": reply.accepted, "reason": reply.reason, "detail": reply.detail}
    return {**outcome, "hint": reason.hint if reason is not None else "", "data": data}


def refusal(reason: str, detail: str, hint: str) -> dict[str, Any]:
    """The outcome of a refused request."""
    return {"accepted": False, "reason": reason, "detail": detail, "hint": hint, "data": None}


def _sized(key: str, payload: bytes) -> bytes:
    """The payload. Raises UserError where it is larger than a message may be: it would be lost without a word."""
    if reason := transport.oversize(payload):
        raise UserError(f"{key}: {TOO_LARGE.text}: {reason}", TOO_LARGE.hint)
    return payload


def request_error(service: str, error: bytes) -> UserError:
    """The error of a request without reply. error: Zenoh's own words, empty where no service answered."""
    if error == b"Timeout":
        return UserError(
            f"{service} does not answer in time", f"is it busy or stopped? zenav topic hz health/{service}"
        )
    return UserError(f"{service} does not run: {NOT_RUNNING.text}", NOT_RUNNING.hint)
