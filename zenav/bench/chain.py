# SPDX-License-Identifier: Apache-2.0
"""How long a scan takes to become a velocity at the base, by a recording: journals say when each service took what.

    sim sends scan -> local_ctrl takes it ... its next tick begins -> guard takes cmd/nav -> base_driver takes cmd/vel

Between taking a scan and the tick that plans with it lies up to one control period: that wait is the rate's, not the
transport's, and is told apart. Everything else counts: encoding, Zenoh, queues, the solver, the guard.
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

HANDLERS = ("sim", "local_ctrl", "guard")
"""Whose handlers lie on the way."""


@dataclass(frozen=True, slots=True)
class Chain:
    """One value a scan that reached the base, all s. total = latency + wait."""

    to_control: Float64s  # scan sent -> local_ctrl takes it
    wait: Float64s  # local_ctrl has it -> its tick begins
    control: Float64s  # tick begins -> guard takes cmd/nav: the solver and a hop
    guard: Float64s  # guard takes it -> base_driver takes cmd/vel: the guard and a hop
    handlers: dict[str, Float64s]  # the slowest handler of each second, by service

    @property
    def latency(self) -> Float64s:
        return self.to_control + self.control + self.guard

    @property
    def total(self) -> Float64s:
        return self.latency + self.wait


def chain(path: Path, since: int = 0) -> Chain:
    """The chain of every scan that was sent after `since` (ns) and led to a command at the base."""
    recording = Recording(path)
    sent = {key: _sent(recording, key) for key in ("scan", "cmd/nav", "cmd/vel")}
    events = {
        name: [event for life in lives for event in life.events]
        for name, lives in recording.lives().items()
        if name in ("local_ctrl", "guard", "base_driver")
    }
    at_guard = _taken(events.get("guard", []), "cmd/nav")
    at_base = _taken(events.get("base_driver", []), "cmd/vel")
    by_time = {key: {when: source for source, when in sent[key].items()} for key in ("cmd/nav", "cmd/vel")}
    rows: list[tuple[float, float, float, float]] = []
    control = events.get("local_ctrl", [])
    ticks = [event.now for event in control if event.kind == TICK]
    for event in control:
        begun = (
            sent["scan"].get((event.session, event.number)) if event.kind == MESSAGE and event.key == "scan" else None
        )
        i = bisect_left(ticks, event.now)
        if begun is None or begun < since or i == len(ticks):
            continue
        guarded = at_guard.get(by_time["cmd/nav"].get(ticks[i], ("", -1)))
        based = at_base.get(by_time["cmd/vel"].get(guarded, ("", -1))) if guarded is not None else None
        if guarded is not None and based is not None:
            rows.append((event.now - begun, ticks[i] - event.now, guarded - ticks[i], based - guarded))
    to_control, wait, solved, guarded_for = np.array(rows, float).reshape(-1, 4).T / 1e9
    return Chain(to_control, wait, solved, guarded_for, _handlers(recording, since))


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
    found: dict[str, list[float]] = {name: [] for name in HANDLERS}
    for entry in recording.entries(tuple(f"health/{name}" for name in HANDLERS)):
        health, envelope = decode(Health, entry.payload)
        if envelope.sent > since:
            found[health.name].append(health.handler_ms / 1e3)
    return {name: np.array(values) for name, values in found.items()}
