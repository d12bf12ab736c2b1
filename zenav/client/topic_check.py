# SPDX-License-Identifier: Apache-2.0
"""`zenav topic check`: why do the messages on a key not pass? By the rules of the receivers (docs/wire.md)."""

import sys
import threading
from dataclasses import dataclass
from typing import Any

from services.base_driver.range_sensors import RangeSensorMonitor
from shared import topics
from shared.codec import CodecError, decode
from shared.config import Robot, UserError, load_robot
from shared.lasers import NO_SECOND_LASER, lasers_by_topic
from shared.messages import BoardReport, Health, LaserScan, Message
from shared.reasons import SCAN_UNLIKE, WRONG_RANGES
from shared.rejections import Rejections
from shared.runners.admission import Admission, Verdict
from shared.runners.transport import oversize, stack_address
from shared.scan_faults import mismatch
from shared.topics import Topic
from shared.unknown_fields import unknown_fields, unknown_text
from zenav.client import Client
from zenav.client.topic import does_it_run, topic_named
from zenav.console.shutdown import stop_on_signal

MAX_AGE_S = 0.5  # s of a stamp; services allow less for what moves the robot
MIN_RATE_SHARE = 0.7  # of the topic's rate

STAMPS = "stamps are ns since 1970 on the computer's clock, and rise with each message"
SEQUENCES = "the sequence begins at 0 and grows with each message of a key and session"
ENVELOPES = 'the envelope is under "@": [publisher, session, sequence, sent], see docs/wire.md'


@dataclass(frozen=True, slots=True)
class Problem:
    """Why messages do not pass, and what to do. Problems of one kind are counted as one."""

    kind: str
    what: str
    hint: str


class KeyCheck:
    """Checks the messages of one key in the order of their arrival. key: without the robot's name."""

    def __init__(self, key: str, topic: Topic[Message], robot: Robot) -> None:
        self.key, self.topic, self._robot = key, topic, robot
        self._allowed = (key.rpartition("/")[2],) if topic.by == "*" else topic.publishers
        self._admission, self._rejections = Admission(topic), Rejections()
        self._monitor = RangeSensorMonitor(robot)
        laser = next((laser for scans, laser in lasers_by_topic(robot).items() if scans.key == topic.key), None)
        self.expected_hz = laser.rate if laser is not None else topic.hz  # each laser has its own
        self._last: int | None = None
        self._lock = threading.Lock()
        self._found: dict[str, tuple[int, Problem]] = {}  # by kind: number, and the newest
        self.n = self.n_passed = 0
        self.publisher, self.note = "", ""
        self.passed_at = 0
        """ns, when the last message passed."""
        self._first_at = 0

    def take(self, payload: bytes, now: int) -> None:
        """Checks a message. now: ns, stack's clock. Any thread may call it."""
        with self._lock:
            self.n += 1
            problem = self._problem(payload, now)
            if problem is not None:
                self._found[problem.kind] = self._found.get(problem.kind, (0, problem))[0] + 1, problem
                return
            self.n_passed += 1
            self._first_at = self._first_at or now
            self.passed_at = now

    def rate(self) -> float:
        """Hz of the messages that passed; 0 for fewer than two."""
        seconds = (self.passed_at - self._first_at) / 1e9
        return (self.n_passed - 1) / seconds if seconds > 0 else 0.0

    def problems(self) -> list[Problem]:
        """The problems so far, the most frequent first."""
        with self._lock:
            counted = sorted(self._found.values(), key=lambda row: -row[0])
            found = [Problem(p.kind, f"{self.key}: {p.what} ({n} of {self.n})", p.hint) for n, p in counted]
        if self.n_passed > 2 and self.expected_hz and self.rate() < MIN_RATE_SHARE * self.expected_hz:
            slow = f"{self.key}: {self.rate():.1f} Hz, where {self.expected_hz:g} are expected"
            found.append(Problem("rate", slow, "is its sender or this computer overloaded?"))
        return found

    def newest(self) -> Problem | None:
        """The most frequent problem; None where all messages pass."""
        return next(iter(self.problems()), None)

    def _problem(self, payload: bytes, now: int) -> Problem | None:
        if words := oversize(payload):
            return Problem("size", words, "send less at once")
        try:
            message, envelope = decode(self.topic.type, payload)
        except CodecError as error:
            hint = ENVELOPES if "envelope" in str(error) else f"see zenav schema {self.topic.type.__name__}"
            return Problem("content", f"not a {self.topic.type.__name__}: {error}", hint)
        if names := unknown_fields(self.topic.type, payload):
            self.note = unknown_text(names)
        if envelope.publisher not in self._allowed:
            allowed = " or ".join(self._allowed)
            return Problem("publisher", f"publisher {envelope.publisher!r}, where {allowed} publishes", ENVELOPES)
        verdict = self._admission.judge(envelope, now)
        if verdict is Verdict.INTRUDER:
            hint = "end one of the two programs; one program keeps its session from its start to its end"
            return Problem("session", f"session {envelope.session!r} beside another one", hint)
        if verdict is Verdict.OLD:
            return Problem("sequence", self._admission.words, SEQUENCES)
        self.publisher = envelope.publisher
        return self._stamp_or_content_problem(message, now)

    def _stamp_or_content_problem(self, message: Message, now: int) -> Problem | None:
        unfit, hint = self._unfit(message)
        end = message.stamp + (round(message.scan_time * 1e9) if isinstance(message, LaserScan) else 0)
        max_age = MAX_AGE_S if self.topic.hz else float("1e9")
        if self._rejections.judge(self.key, end, self._last, now, max_age, unfit):
            self._last = end
            return None
        words = self._rejections.last_problem(self.key)
        return Problem("configuration", words, hint) if words == unfit else Problem("stamp", words, STAMPS)

    def _unfit(self, message: Any) -> tuple[str, str]:
        """Contradiction to the robot's file and its hint; empty without one."""
        if isinstance(message, LaserScan):
            laser = {topic.key: laser for topic, laser in lasers_by_topic(self._robot).items()}.get(self.key)
            return (mismatch(message, laser) if laser is not None else NO_SECOND_LASER), SCAN_UNLIKE.hint
        if isinstance(message, BoardReport):
            self._monitor.update(message)
            wrap, counts = self._robot.drive.encoder_wrap, max(message.left_counts, message.right_counts)
            if counts >= wrap:
                return f"{counts} encoder counts, robot.drive.encoder_wrap is {wrap}", "count modulo encoder_wrap"
            return self._monitor.mismatch, WRONG_RANGES.hint
        return "", ""


def check_topic(robot: str, stack: str, key: str, seconds: float) -> int:
    """Writes why messages do not pass, a line and a hint each; 0 where they pass."""
    key, topic = topic_named(key)
    file = load_robot(robot)
    check = KeyCheck(key, topic, file.robot)
    rejected: dict[tuple[str, str], list[int]] = {}  # service, cause: counts in its health messages

    def hear(health: Health) -> None:
        for of, why, n in health.rejected:
            if of == key:
                rejected.setdefault((health.name, why), []).append(n)

    with stop_on_signal() as stop, Client(file.robot.name, stack_address(stack)) as client:
        client.listen(topics.HEALTH, lambda health, _: hear(health))
        client.listen_raw(key, lambda _, payload: check.take(payload, client.now()))
        stop.wait(seconds)
    if not check.n:
        raise UserError(f"nothing on {key} in {seconds:g} s", does_it_run(key, topic))
    problems = check.problems()
    for (service, why), counts in rejected.items():
        if counts[-1] > counts[0]:
            hint = f"see zenav topic echo health/{service}"
            problems.append(
                Problem("health", f"{service} rejects {key}: {why} ({counts[-1] - counts[0]} meanwhile)", hint)
            )
    for problem in problems:
        sys.stdout.write(f"{problem.what}\nhint: {problem.hint}\n")
    if check.note:
        sys.stdout.write(f"{key}: {check.note}\n")
    if not problems:
        rate = f", {check.rate():.1f} Hz" if check.n_passed > 1 else ""
        sys.stdout.write(f"{key}: {check.n_passed} messages of {check.publisher} pass{rate}\n")
    return 1 if problems else 0
