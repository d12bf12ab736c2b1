# SPDX-License-Identifier: Apache-2.0
"""A live service's counters, and its health message, once a second."""

import logging
import os
import time

import psutil

from shared.messages import Health
from shared.rejections import RejectionCause, Rejections
from shared.types import NS_PER_S

log = logging.getLogger("zenav")


class LinkStats:
    """Counters of received messages and of errors."""

    def __init__(self) -> None:
        self.bad = self.intruders = self.old = 0
        self.last_error = ""
        self.slowest = 0.0
        self.counts: dict[str, int] = {}
        self.ages: dict[str, float] = {}
        self._last_logged = 0
        self._rejected: dict[tuple[str, RejectionCause], int] = {}  # at the last call of log_rejections
        self._process = psutil.Process()
        self._cpu, self._wall = time.process_time(), time.monotonic()

    def count_message(self, key: str, age: float, spent: float) -> None:
        """Counts a message of a key. age: s since its stamp. spent: s in its handler."""
        self.counts[key] = self.counts.get(key, 0) + 1
        self.ages[key] = max(self.ages.get(key, 0.0), age)
        self.slowest = max(self.slowest, spent)

    def record_error(self, what: str, now: int) -> None:
        """Stores an error for health and logs it, once a second at most. now: ns."""
        self.last_error = what[:200]
        if now - self._last_logged > NS_PER_S or now < self._last_logged:
            self._last_logged = now
            log.warning(what)

    def log_rejections(self, rejections: Rejections, now: int) -> None:
        """Logs the messages that the service rejected since the last call. Call it once a second. now: ns."""
        new = {which: n - self._rejected.get(which, 0) for which, n in rejections.counts.items()}
        self._rejected = dict(rejections.counts)
        lines = [f"{key}: {n} rejected: {rejections.words[key, kind]}" for (key, kind), n in sorted(new.items()) if n]
        if lines:
            self.record_error("; ".join(lines), now)

    def health(self, name: str, state: str, n_events: int, dropped: int, rejections: Rejections, now: int) -> Health:
        """The health message for the time since the last one. Counts of errors are since the start."""
        cpu, wall = time.process_time(), time.monotonic()
        seconds = max(wall - self._wall, 1e-3)
        share = max(cpu - self._cpu, 0.0) / seconds
        self._cpu, self._wall = cpu, wall
        rates = tuple((key, n / seconds, self.ages[key]) for key, n in sorted(self.counts.items()))
        memory = self._process.memory_info().rss / 1e6
        slowest_ms = self.slowest * 1e3
        self.slowest, self.counts, self.ages = 0.0, {}, {}
        rejected = rejections.counts
        return Health(
            stamp=now,
            name=name,
            pid=os.getpid(),
            state=state,
            events=n_events,
            bad_messages=self.bad,
            dropped=dropped,
            intruders=self.intruders,
            last_error=self.last_error,
            cpu=share,
            memory=memory,
            handler_ms=slowest_ms,
            rates=rates,
            rejected=tuple((key, str(kind), n) for (key, kind), n in sorted(rejected.items())),
        )
