# SPDX-License-Identifier: Apache-2.0
"""How long a scan takes to become a velocity at the base, by a recording: journals say when each service took what.

    sim sends scan -> local_ctrl takes it ... its next tick begins -> guard takes cmd/nav -> base_driver takes cmd/vel

Between taking a scan and the tick that plans with it lies up to one control period: that wait is the rate's, not the
transport's: figures are given with it and without. Everything else counts: encoding, Zenoh, queues, the solver, the
guard. A scan that leads to no command is counted, by where it ended.
"""

from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared.codec import decode, envelope_of
from shared.messages import Health
from shared.recording import Recording
from shared.runners.host import MESSAGE, TICK
from shared.runners.journal import Event

Float64s = NDArray[np.float64]
Int64s = NDArray[np.int64]

HANDLERS = ("sim", "local_ctrl", "guard")
"""Whose handlers lie on the way."""


NOT_TAKEN, NO_COMMAND, NOT_AT_BASE = "not taken by local_ctrl", "no cmd/nav at the guard", "no cmd/vel at the base"
"""Where a scan may end without a command at the base."""

SECOND = 1_000_000_000
NONE = "", -1  # the source of nothing
END = 0.2  # s before the last command at the base: what was sent later may be cut off by the recording's end


@dataclass(frozen=True, slots=True)
class Chain:
    """One value a scan that reached the base, s. total = latency + wait."""

    stamps: Int64s  # ns, when each scan was sent
    to_control: Float64s  # scan sent -> local_ctrl takes it
    wait: Float64s  # local_ctrl has it -> its tick begins
    control: Float64s  # tick begins -> guard takes cmd/nav: the solver and a hop
    guard: Float64s  # guard takes it -> base_driver takes cmd/vel: the guard and a hop
    handlers: dict[str, Float64s]  # by service (k, 2): end of a second, ns; slowest handler of that second, s
    lost: dict[str, int]  # scans that led to no command, by where they ended
    n_scans: int  # with the lost ones

    @property
    def latency(self) -> Float64s:
        return self.to_control + self.control + self.guard

    @property
    def total(self) -> Float64s:
        return self.latency + self.wait

    @property
    def by_second(self) -> Float64s:
        """(k, 2) s: the slowest latency of each second, and the sum of the slowest handler of each service in it.

        A service's seconds begin when it likes: of each, the one that overlaps most counts. A second of which a
        service tells nothing is left out.
        """
        reports = list(self.handlers.values())
        if not reports or any(not len(rows) for rows in reports):
            return np.zeros((0, 2))
        found = []
        for end in reports[-1][:, 0]:
            here = (self.stamps >= end - SECOND) & (self.stamps < end)
            nearest = [rows[np.abs(rows[:, 0] - end).argmin()] for rows in reports]
            if here.any() and all(abs(row[0] - end) <= SECOND / 2 for row in nearest):
                found.append((self.latency[here].max(), sum(row[1] for row in nearest)))
        return np.array(found).reshape(-1, 2)


def chain(path: Path, since: int = 0) -> Chain:
    """The chain of every scan that was sent from `since` (ns) on.

    One that led to no command and was sent within END of the last command at the base is not counted as lost.
    """
    recording = Recording(path)
    sent = {key: _sent(recording, key) for key in ("scan", "cmd/nav", "cmd/vel")}
    events = {
        name: [event for life in lives for event in life.events]
        for name, lives in recording.lives().items()
        if name in ("local_ctrl", "guard", "base_driver")
    }
    control = events.get("local_ctrl", [])
    at_control = _taken(control, "scan")
    at_guard = _taken(events.get("guard", []), "cmd/nav")
    at_base = _taken(events.get("base_driver", []), "cmd/vel")
    by_time = {key: {when: source for source, when in sent[key].items()} for key in ("cmd/nav", "cmd/vel")}
    ticks = [event.now for event in control if event.kind == TICK]
    until = max(at_base.values(), default=0) - round(END * SECOND)
    rows: list[tuple[int, int, int, int, int]] = []
    lost = dict.fromkeys((NOT_TAKEN, NO_COMMAND, NOT_AT_BASE), 0)
    for begun, source in sorted((when, source) for source, when in sent["scan"].items() if when >= since):
        taken = at_control.get(source)
        i = bisect_left(ticks, taken) if taken is not None else len(ticks)
        guarded = at_guard.get(by_time["cmd/nav"].get(ticks[i], NONE)) if i < len(ticks) else None
        based = at_base.get(by_time["cmd/vel"].get(guarded, NONE)) if guarded is not None else None
        if taken is not None and guarded is not None and based is not None:
            rows.append((begun, taken - begun, ticks[i] - taken, guarded - ticks[i], based - guarded))
        elif begun <= until:
            lost[NOT_TAKEN if taken is None else NO_COMMAND if guarded is None else NOT_AT_BASE] += 1
    stamps, *parts = np.array(rows, np.int64).reshape(-1, 5).T
    to_control, wait, solved, guarded_for = np.array(parts, float) / SECOND
    n_scans = len(rows) + sum(lost.values())
    return Chain(stamps, to_control, wait, solved, guarded_for, _handlers(recording, since), lost, n_scans)


def _sent(recording: Recording, key: str) -> dict[tuple[str, int], int]:
    """(session, sequence) -> ns of every message on a key."""
    found = {}
    for entry in recording.entries((key,)):
        envelope = envelope_of(entry.payload)
        found[(envelope.session, envelope.sequence)] = envelope.sent
    return found


def _taken(events: list[Event], key: str) -> dict[tuple[str, int], int]:
    """(session, sequence) -> ns at which a service took a message on a key."""
    return {(e.session, e.number): e.now for e in events if e.kind == MESSAGE and e.key == key}


def _handlers(recording: Recording, since: int) -> dict[str, Float64s]:
    """By service (k, 2): when a second ended, ns, and its slowest handler, s; from `since` (ns) on."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in HANDLERS}
    for entry in recording.entries(tuple(f"health/{name}" for name in HANDLERS)):
        health, envelope = decode(Health, entry.payload)
        if envelope.sent >= since + SECOND:
            found[health.name].append((envelope.sent, health.handler_ms / 1e3))
    return {name: np.array(values).reshape(-1, 2) for name, values in found.items()}
