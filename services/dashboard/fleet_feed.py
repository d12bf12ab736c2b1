# SPDX-License-Identifier: Apache-2.0
"""The robots of a router as pages show them: a thread with a session of its own, while a page is open.

STOP of several robots is pressed from here too, of each in parallel, until its guard confirms it.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from math import radians
from typing import Any

from shared import topics
from shared.config import UserError
from shared.robot_view import FLEET_TOPICS, RobotView
from shared.runners.fleet_listener import FleetListener
from shared.runners.stop_confirmation import confirm_stop_of
from shared.runners.transport import stack_address

PERIOD_S = 0.5
ADDRESSES_EVERY_S = 5.0
FIRST_S = 3.0  # for which STOP of all robots waits until the first is heard
AGAIN_S = 5.0  # between two tries to reach the router
MAX_AT_ONCE = 256  # robots that are stopped at the same time: one that is away holds up no other
Rows = list[dict[str, Any]]


class FleetFeed:
    """deliver: gets the rows of all robots, on the thread of the feed."""

    def __init__(self, router: str, deliver: Callable[[Rows], None]) -> None:
        self._router, self._deliver = router, deliver
        self._ending = threading.Event()
        self._names: list[str] = []
        self._has_names = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it; the thread and its session follow within a second."""
        self._ending.set()

    def stop(self, robots: list[str] | None, press: bool, by: str) -> tuple[list[str], dict[str, str]]:
        """Presses STOP of robots, or releases it; None: of all that were heard. It blocks for some seconds at most.

        Returns the names of those that confirmed it, and by name why others did not.
        """
        if robots is None:  # a page from before a restart asks before the robots are heard again
            self._has_names.wait(FIRST_S)
        names, where = robots if robots is not None else list(self._names), stack_address(self._router)

        def one(name: str) -> str:
            try:
                confirm_stop_of(name, where, press, by)
            except UserError as error:
                return error.what
            return ""

        with ThreadPoolExecutor(MAX_AT_ONCE) as pool:
            outcome = dict(zip(names, pool.map(one, names), strict=True))
        return [name for name in names if not outcome[name]], {name: why for name, why in outcome.items() if why}

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                with FleetListener([self._router], (*FLEET_TOPICS, topics.PLAN)) as fleet:
                    self._hear(fleet)
            except UserError:
                self._ending.wait(AGAIN_S)

    def _hear(self, fleet: FleetListener) -> None:
        asked = float("-inf")
        while not self._ending.is_set():
            views = fleet.hear(PERIOD_S)
            if time.monotonic() - asked > ADDRESSES_EVERY_S:
                fleet.ask_addresses()
                asked = time.monotonic()
            self._names = [view.name for view in views]
            if views:
                self._has_names.set()
            self._deliver([fleet_row(view, time.monotonic()) for view in views])


def fleet_row(view: RobotView, at: float) -> dict[str, Any]:
    """One robot of the frame `fleet`. at: s, monotonic. x, y: m, yaw: rad; plan: x and y of its poses, m."""
    row = asdict(view.row(at))
    plan = view.latest(topics.PLAN)
    row["yaw"] = None if row["yaw"] is None else radians(row["yaw"])
    row["plan"] = [] if plan is None or plan.reason else [plan.xs.tolist(), plan.ys.tolist()]
    return row
