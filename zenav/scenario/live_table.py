# SPDX-License-Identifier: Apache-2.0
"""A run for people: a table that is drawn over and over on a terminal, or plain lines."""

import sys
import time
from collections import deque
from typing import Any

from shared import topics
from shared.messages import Health, NavStatus
from shared.reasons import reason_text
from shared.task_state import stop_reason
from zenav.client import Client
from zenav.scenario.live_run import ProcessStats, RunView
from zenav.scenario.mission import LegState, Mission
from zenav.scenario.scenario import Scenario
from zenav.stack.launch import Launcher

MAX_SILENCE_S = 3.0  # s without health after which a row says so
LINE_PERIOD_S = 10.0  # s between two plain lines
MARKS = {LegState.WAITING: "·", LegState.UNDER_WAY: "▶", LegState.REACHED: "✓", LegState.FAILED: "✗"}


class LineView(RunView):
    """A line every 10 s, and whatever goes wrong."""

    def __init__(self) -> None:
        self._told = float("-inf")
        self._states: list[LegState] = []

    def show_line(self, name: str, line: str) -> None:
        if not (" INFO " in line or " DEBUG " in line):
            sys.stderr.write(f"{name:<12} {line}\n")

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        nav, guard = client.latest(topics.NAV_STATUS), client.latest(topics.GUARD)
        self.line(mission, nav, stop_reason(nav, guard), seconds)

    def line(self, mission: Mission, nav: NavStatus | None, reason: str, seconds: float) -> None:
        """Writes how far it is: every 10 s, and when a leg is over."""
        states = [leg.state for leg in mission.legs]
        if seconds - self._told < LINE_PERIOD_S and states == self._states:
            return
        self._told, self._states = seconds, states
        sys.stderr.write(
            f"{seconds:7.1f} s  {progress_line(mission, nav)}" + (f"  ({reason})" if reason else "") + "\n"
        )
        sys.stderr.flush()


class TableView(RunView):
    """The live table."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
        self._lines: deque[str] = deque(maxlen=4)
        self._drawn = 0.0

    def start(self, scenario: Scenario, launcher: Launcher, processes: ProcessStats) -> None:
        self._launcher, self._processes = launcher, processes
        self._live.start()

    def show_line(self, name: str, line: str) -> None:
        if not (" INFO " in line or " DEBUG " in line):
            self._lines.append(f"{name}: {line}")

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        if time.monotonic() - self._drawn < 0.25:
            return
        self._drawn = time.monotonic()
        self._live.update(self._drawing(client, mission, seconds), refresh=True)

    def end(self) -> None:
        self._live.stop()

    def _drawing(self, client: Client, mission: Mission, seconds: float) -> Any:
        from rich.console import Group
        from rich.table import Table as RichTable
        from rich.text import Text

        table = RichTable(title=f"zenav, stack {client.where.domain}, {seconds:.0f} s", title_justify="left", box=None)
        table.add_column("service")
        table.add_column("state", max_width=44, no_wrap=True)
        for column in ("in, Hz", "age, ms", "handler, ms", "CPU, %", "MB", "trouble"):
            table.add_column(column, justify="right" if column != "trouble" else "left", no_wrap=True)
        for name, child in self._launcher.children.items():
            health = self._processes.latest.get(name)
            silent = time.monotonic() - self._processes.received_at.get(name, float("-inf"))
            style = "" if health is not None and silent < MAX_SILENCE_S else "red"
            cells = service_row(health, silent, child.running, child.n_restarts)
            table.add_row(name, *(Text(cell) for cell in cells), style=style)
        nav, guard = client.latest(topics.NAV_STATUS), client.latest(topics.GUARD)
        reason = stop_reason(nav, guard)
        standing = Text(f"stands or slows: {reason}", "yellow") if reason else Text("drives freely", "green")
        lines = [Text(progress_line(mission, nav)), standing, *(Text(line, "dim") for line in self._lines)]
        return Group(table, Text(), Text(leg_marks(mission)), *lines)


def service_row(health: Health | None, silent: float, running: bool, n_restarts: int) -> tuple[str, ...]:
    """The cells of a service's row, after its name."""
    if health is None or silent > MAX_SILENCE_S:
        state = "dead" if not running else "starting" if health is None else f"silent for {silent:.0f} s"
        return (state, *("",) * 5, _trouble(health, n_restarts))
    streams = [(hz, age) for _, hz, age in health.rates if hz >= 1]
    rate = f"{sum(hz for hz, _ in streams):.0f}" if streams else ""
    age = f"{max(age for _, age in streams) * 1e3:.0f}" if streams else ""
    return (
        health.state, rate, age, f"{health.handler_ms:.1f}", f"{health.cpu * 100:.0f}", f"{health.memory:.0f}",
        _trouble(health, n_restarts),
    )  # fmt: skip


def _trouble(health: Health | None, n_restarts: int) -> str:
    counts = [(n_restarts, "restarts")]
    if health is not None:
        counts += [(sum(n for _, _, n in health.rejected), "rejected")]
        counts += [(health.bad_messages, "bad"), (health.dropped, "dropped"), (health.intruders, "intruders")]
    return ", ".join(f"{n} {what}" for n, what in counts if n)


def leg_marks(mission: Mission) -> str:
    """Every leg with a mark for how far it is."""
    return "   ".join(f"{MARKS[leg.state]} {leg.name}" for leg in mission.legs)


def progress_line(mission: Mission, nav: NavStatus | None) -> str:
    """Where the run is, in a line."""
    leg = mission.leg
    if leg is None:
        return f"done: {mission.n_reached} of {mission.n_goals} goals reached"
    if nav is None:
        return "the stack is starting"
    if leg.state is LegState.WAITING:
        return f"{leg.name}: asked for"
    goals = f"goal {mission.n_reached + 1} of {mission.n_goals}, " if leg.pose is not None else ""
    recovery = f", recovery: {nav.recovery}" if nav.recovery else ""
    why = f", {reason_text(nav.reason)}" if nav.reason and leg.pose is None else ""
    return f"{leg.name}: {goals}{nav.state}, {nav.distance_left:.1f} m and {nav.time_left:.0f} s left{recovery}{why}"
