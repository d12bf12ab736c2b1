# SPDX-License-Identifier: Apache-2.0
"""A run for people: a table that is drawn over and over on a terminal, or plain lines."""

import sys
import time
from collections import deque
from typing import Any

from shared import topics
from shared.messages import Health, NavStatus
from shared.reasons import told
from zenav.client import Client
from zenav.drive import why_standing
from zenav.launch import Launcher
from zenav.live_run import Processes, View
from zenav.pilot import LegState, Pilot
from zenav.scene import Scene

SILENT = 3.0  # s without health after which a row says so
EVERY = 10.0  # s between two plain lines
MARKS = {LegState.WAITING: "·", LegState.UNDER_WAY: "▶", LegState.REACHED: "✓", LegState.FAILED: "✗"}


class Lines(View):
    """A line every 10 s, and whatever goes wrong."""

    def __init__(self) -> None:
        self._told = float("-inf")
        self._states: list[LegState] = []

    def show_line(self, name: str, line: str) -> None:
        if not (" INFO " in line or " DEBUG " in line):
            sys.stderr.write(f"{name:<12} {line}\n")

    def look(self, client: Client, pilot: Pilot, seconds: float) -> None:
        nav, guard = client.latest(topics.NAV), client.latest(topics.GUARD)
        self.line(pilot, nav, why_standing(nav, guard), seconds)

    def line(self, pilot: Pilot, nav: NavStatus | None, reason: str, seconds: float) -> None:
        """Writes how far it is: every 10 s, and when a leg is over."""
        states = [leg.state for leg in pilot.legs]
        if seconds - self._told < EVERY and states == self._states:
            return
        self._told, self._states = seconds, states
        sys.stderr.write(f"{seconds:7.1f} s  {progress(pilot, nav)}" + (f"  ({reason})" if reason else "") + "\n")
        sys.stderr.flush()


class Table(View):
    """The live table."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
        self._lines: deque[str] = deque(maxlen=4)
        self._drawn = 0.0

    def start(self, scene: Scene, launcher: Launcher, processes: Processes) -> None:
        self._launcher, self._processes = launcher, processes
        self._live.start()

    def show_line(self, name: str, line: str) -> None:
        if not (" INFO " in line or " DEBUG " in line):
            self._lines.append(f"{name}: {line}")

    def look(self, client: Client, pilot: Pilot, seconds: float) -> None:
        if time.monotonic() - self._drawn < 0.25:
            return
        self._drawn = time.monotonic()
        self._live.update(self._drawing(client, pilot, seconds), refresh=True)

    def end(self) -> None:
        self._live.stop()

    def _drawing(self, client: Client, pilot: Pilot, seconds: float) -> Any:
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
            silent = time.monotonic() - self._processes.heard.get(name, float("-inf"))
            style = "" if health is not None and silent < SILENT else "red"
            cells = row(health, silent, child.running, child.n_restarts)
            table.add_row(name, *(Text(cell) for cell in cells), style=style)
        nav, guard = client.latest(topics.NAV), client.latest(topics.GUARD)
        reason = why_standing(nav, guard)
        standing = Text(f"stands or slows: {reason}", "yellow") if reason else Text("drives freely", "green")
        words = [Text(progress(pilot, nav)), standing, *(Text(line, "dim") for line in self._lines)]
        return Group(table, Text(), Text(legs(pilot)), *words)


def row(health: Health | None, silent: float, running: bool, n_restarts: int) -> tuple[str, ...]:
    """The cells of a service's row, after its name."""
    if health is None or silent > SILENT:
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


def legs(pilot: Pilot) -> str:
    """Every leg with a mark for how far it is."""
    return "   ".join(f"{MARKS[leg.state]} {leg.name}" for leg in pilot.legs)


def progress(pilot: Pilot, nav: NavStatus | None) -> str:
    """Where the run is, in a line."""
    leg = pilot.leg
    if leg is None:
        return f"done: {pilot.n_reached} of {pilot.n_goals} goals reached"
    if nav is None:
        return "the stack is starting"
    if leg.state is LegState.WAITING:
        return f"{leg.name}: asked for"
    goals = f"goal {pilot.n_reached + 1} of {pilot.n_goals}, " if leg.pose is not None else ""
    recovery = f", recovery: {nav.recovery}" if nav.recovery else ""
    why = f", {told(nav.reason)}" if nav.reason and leg.pose is None else ""
    return f"{leg.name}: {goals}{nav.state}, {nav.distance_left:.1f} m and {nav.time_left:.0f} s left{recovery}{why}"
