# SPDX-License-Identifier: Apache-2.0
"""Kills and freezes services of a running stack, one after the other, and measures what the robot does."""

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from math import inf
from typing import Any, Protocol

import numpy as np

from shared import topics
from shared.messages import BaseStatus, GuardStatus, Message, MotorCommand, NavStatus, Truth
from shared.topics import Topic
from zenav.client import Client
from zenav.stack.launch import Launcher

VELOCITY_PATH = ("base_driver", "odometry", "local_ctrl", "guard")
"""Services without whose messages the robot must not drive on."""
FREEZE = 1.0, 8.0  # s, at least and at most
BOARD_STOPS = 0.2  # s without a motor command after which the board stops by itself
MOVES = 0.05  # m/s, or rad/s
SETTLES = 20.0  # s of driving before the first fault
ALL_BUT = ("sim", "recorder")
"""Not the hardware's stand-in; and the recorder's loss is no matter of driving."""
TOPICS: tuple[Topic[Any], ...] = topics.TRUTH, topics.MOTORS, topics.GUARD, topics.NAV_STATUS, topics.BASE_STATUS
"""What a fault is measured by."""

Hear = Callable[[Message, int], None]
"""(message, ns on the stack's clock when it was sent)"""


class StackToBreak(Protocol):
    """A running stack whose services are killed and frozen."""

    freezes: bool
    """Whether it can freeze a service."""

    def now(self) -> int: ...

    def listen(self, topic: Topic[Any], hear: Hear) -> None: ...

    def kill(self, name: str) -> bool:
        """Kills a service, which is then started again; False where it does not run."""

    def freeze(self, name: str) -> bool:
        """Stops a service's process; False where it does not run."""

    def thaw(self) -> None:
        """Lets the frozen service go on; without effect where none is."""


class LaunchedStack:
    """Processes of a launcher, over Zenoh."""

    freezes = True

    def __init__(self, client: Client, launcher: Launcher) -> None:
        self._client, self._launcher = client, launcher
        self._frozen: int | None = None  # pid

    def now(self) -> int:
        return self._client.now()

    def listen(self, topic: Topic[Any], hear: Hear) -> None:
        self._client.listen(topic, lambda message, envelope: hear(message, envelope.sent))

    def kill(self, name: str) -> bool:
        if not self._launcher.children[name].running:
            return False
        self._launcher.kill(name)
        return True

    def freeze(self, name: str) -> bool:
        child = self._launcher.children[name]
        if child.process is None or not child.running:
            return False
        self._frozen = child.process.pid
        os.kill(self._frozen, signal.SIGSTOP)
        return True

    def thaw(self) -> None:
        if self._frozen is not None:
            with suppress(ProcessLookupError):
                os.kill(self._frozen, signal.SIGCONT)
            self._frozen = None


@dataclass(slots=True)
class FaultReport:
    """One fault. at: s since the run's start; lasts: s that it was frozen, 0 where it was killed.

    zero_s: from the fault to the last motor command that moves.   blur_s: by which zero_s may be too large.
    resumed_s: from the fault's end to motion; inf where none came until the next fault.
    reasons: why the robot stood, by guard, navigator and base driver.
    """

    service: str
    kind: str
    at: float
    lasts: float
    was_driving: bool
    zero_s: float = 0.0
    blur_s: float = 0.0
    resumed_s: float = inf
    reasons: tuple[str, ...] = ()

    @property
    def in_velocity_path(self) -> bool:
        return self.service in VELOCITY_PATH

    @property
    def description(self) -> str:
        return f"{self.kind} {self.service}" + (f" for {self.lasts:.1f} s" if self.lasts else "")

    def as_json(self) -> dict[str, Any]:
        """With null for what never came."""
        return {name: None if value == inf else value for name, value in asdict(self).items()}

    @staticmethod
    def longest(rows: list[dict[str, Any]], field: str) -> str:
        """The largest value of a field as text; `-` where one is missing."""
        values = [row[field] for row in rows]
        return "-" if None in values else f"{max(values):.2f}"


class Faults:
    """`step` is called some times a second, with the s since the start of the run."""

    def __init__(self, names: list[str], every: float, random: np.random.Generator) -> None:
        self.reports: list[FaultReport] = []
        self._names = [name for name in names if name not in ALL_BUT]
        self._every, self._random = every, random
        self._next: float | None = None
        self._frozen_until = inf  # s since the start; inf: no service is frozen
        self._stack: StackToBreak | None = None
        self._lock = threading.Lock()
        self._truth: Truth | None = None
        self._fault_ns = 0
        self._last_motion_command = 0
        self._goes_on = False  # the motion from before the fault: no command of zero, and no gap, since
        self._why: dict[str, None] = {}
        self._resumes_from = inf

    @property
    def has_begun(self) -> bool:
        return self._stack is not None

    def begin(self, stack: StackToBreak) -> None:
        """The stack that is to be broken, before its first step."""
        self._stack = stack
        for topic in TOPICS:
            stack.listen(topic, self._hear)

    def step(self, seconds: float, is_driving: bool) -> None:
        """Lets the next fault begin, or the present one end, where its time has come."""
        if self._stack is None:
            return
        if seconds >= self._frozen_until:
            self.end()
            self._resumes_from = seconds
        if self._next is None:
            self._next = seconds + SETTLES if is_driving else None
        self._measure(seconds)
        if self._next is not None and seconds >= self._next and self._frozen_until == inf:
            self._next = seconds + self._every
            self._inject(self._stack, seconds)

    def end(self) -> None:
        """Lets a frozen process go on."""
        if self._stack is not None:
            self._stack.thaw()
        self._frozen_until = inf

    def _inject(self, stack: StackToBreak, seconds: float) -> None:
        name = str(self._random.choice(self._names))
        freezes = self._random.random() < 0.5 and stack.freezes
        lasts = float(self._random.uniform(*FREEZE)) if freezes else 0.0
        begun = stack.now()
        if not (stack.freeze(name) if freezes else stack.kill(name)):
            return
        blur = (stack.now() - begun) * 1e-9  # this process waits for a busy CPU too
        with self._lock:
            driving = self._truth is not None and _moves(self._truth)
            self._fault_ns = self._last_motion_command = begun
            self._why, self._goes_on = {}, True
        kind = "freeze" if freezes else "kill"
        self.reports.append(FaultReport(name, kind, seconds, lasts, driving, blur_s=round(blur, 3)))
        self._frozen_until = seconds + lasts if freezes else inf
        self._resumes_from = inf if freezes else seconds

    def _measure(self, seconds: float) -> None:
        if not self.reports:
            return
        report = self.reports[-1]
        with self._lock:
            report.reasons = tuple(self._why)
            if report.resumed_s == inf:
                report.zero_s = max(0.0, (self._last_motion_command - self._fault_ns) * 1e-9)
            # of what moves on, nothing can be seen: it counts as resumed from half a second on
            since = seconds - self._resumes_from
            if report.resumed_s == inf and since > 0.5 and self._truth is not None and _moves(self._truth):
                report.resumed_s = round(since, 2)

    def _hear(self, message: Message, sent: int) -> None:
        with self._lock:
            if isinstance(message, Truth):
                self._truth = message
            elif isinstance(message, MotorCommand):
                self._goes_on = self._goes_on and sent - self._last_motion_command <= BOARD_STOPS * 1e9
                self._goes_on = self._goes_on and bool(message.left or message.right)
                if self._goes_on:
                    self._last_motion_command = sent
            elif isinstance(message, GuardStatus | NavStatus) and message.reason:
                self._why[message.reason] = None
            elif isinstance(message, BaseStatus) and message.fault:
                self._why[message.fault] = None


def _moves(truth: Truth) -> bool:
    return abs(truth.v) > MOVES or abs(truth.w) > MOVES
