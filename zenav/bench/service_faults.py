# SPDX-License-Identifier: Apache-2.0
"""Kills and freezes services of a live stack, one after the other, and measures what the robot does."""

import os
import signal
import threading
from contextlib import suppress
from dataclasses import asdict, dataclass
from math import inf
from typing import Any

import numpy as np

from shared import topics
from shared.messages import BaseStatus, GuardStatus, Message, MotorCommand, NavStatus, Truth
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


@dataclass(slots=True)
class FaultReport:
    """One fault. at: s since the run's start; lasts: s that it was frozen, 0 where it was killed.

    zero_s: from the fault to the last motor command that moves.
    resumed_s: from the fault's end to motion; inf where none came until the next fault.
    reasons: why the robot stood, by guard, navigator and base driver.
    """

    service: str
    kind: str
    at: float
    lasts: float
    was_driving: bool
    zero_s: float = 0.0
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
        self._frozen: tuple[int, float] | None = None  # pid, until (s since the start)
        self._client: Client | None = None
        self._lock = threading.Lock()
        self._truth: Truth | None = None
        self._fault_ns = 0
        self._last_motion_command = 0
        self._goes_on = False  # the motion from before the fault: no command of zero, and no gap, since
        self._why: dict[str, None] = {}
        self._resumes_from = inf

    def step(self, client: Client, launcher: Launcher, seconds: float, is_driving: bool) -> None:
        """Lets the next fault begin, or the present one end, where its time has come."""
        if self._client is None:
            self._listen(client)
        if self._frozen is not None and seconds >= self._frozen[1]:
            self.end()
            self._resumes_from = seconds
        if self._next is None:
            self._next = seconds + SETTLES if is_driving else None
        self._measure(seconds)
        if self._next is not None and seconds >= self._next and self._frozen is None:
            self._next = seconds + self._every
            self._begin(client, launcher, seconds)

    def end(self) -> None:
        """Lets a frozen process go on."""
        if self._frozen is not None:
            with suppress(ProcessLookupError):
                os.kill(self._frozen[0], signal.SIGCONT)
            self._frozen = None

    def _begin(self, client: Client, launcher: Launcher, seconds: float) -> None:
        name = str(self._random.choice(self._names))
        lasts = float(self._random.uniform(*FREEZE)) if self._random.random() < 0.5 else 0.0
        process = launcher.children[name].process
        if process is None or not launcher.children[name].running:
            return
        with self._lock:
            driving = self._truth is not None and _moves(self._truth)
            self._fault_ns = self._last_motion_command = client.now()
            self._why, self._goes_on = {}, True
        self.reports.append(FaultReport(name, "freeze" if lasts else "kill", seconds, lasts, driving))
        if lasts:
            os.kill(process.pid, signal.SIGSTOP)
            self._frozen = process.pid, seconds + lasts
            self._resumes_from = inf
        else:
            launcher.kill(name)
            self._resumes_from = seconds

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

    def _listen(self, client: Client) -> None:
        self._client = client
        client.listen(topics.TRUTH, lambda message, envelope: self._hear(message, envelope.sent))
        client.listen(topics.MOTORS, lambda message, envelope: self._hear(message, envelope.sent))
        client.listen(topics.GUARD, lambda message, envelope: self._hear(message, envelope.sent))
        client.listen(topics.NAV_STATUS, lambda message, envelope: self._hear(message, envelope.sent))
        client.listen(topics.BASE_STATUS, lambda message, envelope: self._hear(message, envelope.sent))

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
