# SPDX-License-Identifier: Apache-2.0
"""A tool at a site, a process of benchmarks: `python -m zenav.bench.site_observer ROUTER ROBOT`.

It listens as `zenav fleet list` does, and writes `ready`. Each line on stdin is a word, and gets a line of JSON:

- `watch`, `unwatch`: it shows the robot from now on as a page does, or no more;
- `goal`: it sends a goal; `stop`, `release`: it presses or releases STOP, and waits for the guard;
- `report`: messages by topic, and the median time from sending to arrival (s), since the last report.

It ends with its stdin.
"""

import json
import os
import sys
import threading
import time
from collections import Counter
from statistics import median
from typing import Any

from shared import requests, topics
from shared.codec import CodecError, envelope_of
from shared.config import UserError
from shared.crossing import OUTWARD_KEYS
from shared.geometry import Pose2
from shared.requests import Navigate, Watch
from shared.robot_view import FLEET_TOPICS
from shared.runners.stop_confirmation import confirm_stop
from shared.runners.transport import stack_address
from zenav.client import Client

LEASE_S = 10.0
AGAIN_S = 2.0


class Observer:
    """See the module."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._counts: Counter[str] = Counter()
        self._delays: list[float] = []
        self._endings: list[Any] = []
        self._watching = threading.Event()
        for topic in FLEET_TOPICS:
            client.listen_raw(topic.key, self._hear)
        client.follow(topics.GUARD)
        threading.Thread(target=self._watch, daemon=True).start()

    def do(self, word: str) -> dict[str, Any]:
        """The answer to a word."""
        try:
            return self._done(word)
        except UserError as error:
            return {"error": error.what}

    def _done(self, word: str) -> dict[str, Any]:
        if word == "watch":
            shown = set(OUTWARD_KEYS) - {topic.key for topic in FLEET_TOPICS}
            self._endings = [self.client.listen_raw(key, self._hear) for key in sorted(shown)]
            self._watching.set()
        elif word == "unwatch":
            self._watching.clear()
            for end in self._endings:
                end()
            self._endings = []
        elif word == "goal":
            goal = Navigate(self.client.now(), (Pose2(0.3, 0.3, 0.0),), 0.0, 1, True)
            reply = self.client.ask(requests.NAVIGATE, goal)
            return {"accepted": reply.accepted, "reason": reply.reason}
        elif word in ("stop", "release"):
            begun = time.monotonic()
            confirm_stop(self.client, word == "stop", "zenav bench site")
            return {"seconds": time.monotonic() - begun}
        counts, delays = dict(self._counts), list(self._delays)
        self._counts.clear()
        self._delays.clear()
        return {"messages": counts, "delay": median(delays) if delays else None}

    def _hear(self, key: str, payload: bytes) -> None:
        self._counts[key.partition("/")[0] if key.startswith(("health/", "log/")) else key] += 1
        try:
            self._delays.append((time.time_ns() - envelope_of(payload).sent) * 1e-9)
        except CodecError:
            self._counts["not a message"] += 1

    def _watch(self) -> None:
        while True:
            self._watching.wait()
            try:
                self.client.ask(requests.WATCH_LINK, Watch(self.client.now(), LEASE_S))
            except UserError:
                self._counts["watch without an answer"] += 1
            threading.Event().wait(AGAIN_S)


def main(router: str, robot: str) -> None:
    """Observes until stdin ends."""
    with Client(robot, stack_address(router)) as client:
        observer = Observer(client)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        for line in sys.stdin:
            sys.stdout.write(json.dumps(observer.do(line.strip())) + "\n")
            sys.stdout.flush()
    os._exit(0)  # Zenoh's threads are not daemons


if __name__ == "__main__":
    main(*sys.argv[1:])
