# SPDX-License-Identifier: Apache-2.0
"""How long does a scan take to become a velocity at the base? A recording's journals have the times of each event.

    sim sends scan -> local_ctrl takes it ... its next tick begins -> guard takes cmd/nav -> base_driver takes cmd/vel

A scan waits up to one control period for the tick that plans with it. The rate causes that wait, not the transport, so
there are figures with it and without. Everything else counts: encoding, Zenoh, queues, the solver, the guard.
A scan that leads to no command is counted, by where it ended.
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import nan
from pathlib import Path
from time import thread_time
from types import MappingProxyType
from typing import Any

import numpy as np

from shared.codec import CodecError, envelope_of
from shared.messages import Message
from shared.recording import Recording
from shared.runners.host import MESSAGE, TICK
from shared.runners.journal import Event
from shared.runners.replay import Build, replay
from shared.service import Out, Service, handlers
from shared.types import NS_PER_S, Bools, Float64s, Int64s

HandlerTimes = Mapping[str, Mapping[int, float]]
Source = tuple[str, int]
"""Session and sequence of a message."""

CHAIN_SERVICES = ("sim", "local_ctrl", "guard")
"""Whose handlers lie on the way: of the tick that sends the scan, the tick that plans, and the command's."""


NOT_TAKEN, NO_COMMAND, NOT_AT_BASE = "not taken by local_ctrl", "no cmd/nav at the guard", "no cmd/vel at the base"
"""Where a scan may end without a command at the base."""

NO_SOURCE: Source = "", -1  # the source of nothing
AT_MEMBER = "scan to cmd/vel at the member, without that wait"
END_S = 0.2  # s before the last command at the base: what was sent later may be cut off by the recording's end


@dataclass(frozen=True, slots=True)
class LatencyChain:
    """One value a scan that reached the base, s. total = latency + wait."""

    to_control: Float64s  # scan sent -> local_ctrl takes it
    wait: Float64s  # local_ctrl has it -> its tick begins
    control: Float64s  # tick begins -> guard takes cmd/nav: the solver and a hop
    guard: Float64s  # guard takes it -> base_driver takes cmd/vel: the guard and a hop
    member: Float64s  # guard takes it -> a member of the gateway takes cmd/vel; NaN where it did not
    handlers: Float64s  # the handlers of sim, local_ctrl and guard that made it, CPU s, run alone; NaN where unknown
    sent: Int64s  # ns on the stack's clock when the scan was sent
    lost: dict[str, int]  # scans that led to no command, by where they ended
    n_scans: int  # with the lost ones

    @property
    def latency(self) -> Float64s:
        return self.to_control + self.control + self.guard

    @property
    def member_latency(self) -> Float64s:
        return self.to_control + self.control + self.member

    @property
    def total(self) -> Float64s:
        return self.latency + self.wait


def latency_chain(
    path: Path,
    since: int = 0,
    spent: HandlerTimes = MappingProxyType({}),
    at_member: Mapping[Source, int] = MappingProxyType({}),
) -> LatencyChain:
    """The chain of every scan that was sent from `since` (ns) on. spent: as from `handler_times`.

    at_member: ns at which a member of the gateway took each `cmd/vel`.
    One that led to no command and was sent within END of the last command at the base is not counted as lost.
    """
    recording = Recording(path)
    sent = {key: _times_sent(recording, key) for key in ("scan", "cmd/nav", "cmd/vel")}
    events = {
        name: [event for life in lives for event in life.events]
        for name, lives in recording.lives().items()
        if name in ("local_ctrl", "guard", "base_driver")
    }
    control = events.get("local_ctrl", [])
    times_at_control = _times_taken(control, "scan")
    times_at_guard = _times_taken(events.get("guard", []), "cmd/nav")
    times_at_base = _times_taken(events.get("base_driver", []), "cmd/vel")
    by_time = {key: {when: source for source, when in sent[key].items()} for key in ("cmd/nav", "cmd/vel")}
    ticks = [event.now for event in control if event.kind == TICK]
    until = max(times_at_base.values(), default=0) - round(END_S * NS_PER_S)
    rows: list[tuple[float, float, float, float, float]] = []
    spent_by: list[float] = []
    reached: list[int] = []
    lost = dict.fromkeys((NOT_TAKEN, NO_COMMAND, NOT_AT_BASE), 0)
    for begun, source in sorted((when, source) for source, when in sent["scan"].items() if when >= since):
        control_at = times_at_control.get(source)
        i = bisect_left(ticks, control_at) if control_at is not None else len(ticks)
        guard_at = times_at_guard.get(by_time["cmd/nav"].get(ticks[i], NO_SOURCE)) if i < len(ticks) else None
        command = by_time["cmd/vel"].get(guard_at, NO_SOURCE) if guard_at is not None else NO_SOURCE
        base_at = times_at_base.get(command)
        if control_at is not None and guard_at is not None and base_at is not None:
            to_member = at_member.get(command, nan) - guard_at
            rows.append((control_at - begun, ticks[i] - control_at, guard_at - ticks[i], base_at - guard_at, to_member))
            reached.append(begun)
            begins = zip(CHAIN_SERVICES, (begun, ticks[i], guard_at))
            spent_by.append(sum(spent.get(name, {}).get(when, nan) for name, when in begins))
        elif begun <= until:
            lost[NOT_TAKEN if control_at is None else NO_COMMAND if guard_at is None else NOT_AT_BASE] += 1
    to_control, wait, solved, guarded_for, to_member = np.array(rows, float).reshape(-1, 5).T / NS_PER_S
    n_scans = len(rows) + sum(lost.values())
    return LatencyChain(
        to_control=to_control,
        wait=wait,
        control=solved,
        guard=guarded_for,
        member=to_member,
        handlers=np.array(spent_by, float),
        sent=np.array(reached, np.int64),
        lost=lost,
        n_scans=n_scans,
    )


def handler_times(path: Path, build: Build) -> HandlerTimes:
    """How long the handlers of HANDLERS take alone: CPU time of their recorded events, replayed here.

    By service and by the time (ns) of the event: s. build: makes a service as it stood at its start.
    """
    spent: dict[str, dict[int, float]] = {name: {} for name in CHAIN_SERVICES}
    replay(Recording(path), list(CHAIN_SERVICES), lambda name: _timed(build(name), spent[name]))
    return spent


def _timed(service: Service, spent: dict[int, float]) -> Service:
    """The service, whose handlers of messages and ticks add the s that they take to `spent`, by `now`."""
    named = handlers(type(service))
    for name in {name for _, name in named.topics.values()} | {name for _, name, _ in named.ticks}:
        setattr(service, name, _timed_handler(service, getattr(service, name), spent))
    return service


def _timed_handler(service: Service, handler: Callable[..., Out], spent: dict[int, float]) -> Callable[..., Out]:
    def timed(*message: Message) -> Out:
        begun = thread_time()
        out = tuple(handler(*message))
        spent[service.now] = spent.get(service.now, 0.0) + thread_time() - begun
        return out

    return timed


def _times_sent(recording: Recording, key: str) -> dict[Source, int]:
    """(session, sequence) -> ns of every message on a key that can be read."""
    times = {}
    for entry in recording.entries((key,)):
        try:
            envelope = envelope_of(entry.payload)
        except CodecError:
            continue
        times[(envelope.session, envelope.sequence)] = envelope.sent
    return times


def _times_taken(events: list[Event], key: str) -> dict[Source, int]:
    """(session, sequence) -> ns at which a service took a message on a key."""
    return {(e.session, e.number): e.now for e in events if e.kind == MESSAGE and e.key == key}


def latency_figures(chain: LatencyChain) -> dict[str, Any]:
    """Percentiles of the chain and its parts, ms.

    The ratio compares equal percentiles over the same scans. Its numerator is the time from scan to cmd/vel without the
    wait for the tick. Its denominator is the time of that command's handlers, run alone.
    """
    is_timed, came = np.isfinite(chain.handlers), np.isfinite(chain.member)
    parts = {
        "scan to cmd/vel, with the wait for the control tick": chain.total,
        "without that wait": chain.latency,
        **({"the handlers on the way, alone": chain.handlers[is_timed]} if is_timed.any() else {}),
        "scan to local_ctrl": chain.to_control, "wait for the control tick": chain.wait,
        "tick to guard": chain.control, "guard to base_driver": chain.guard,
        **({AT_MEMBER: chain.member_latency[came]} if came.any() else {}),
    }  # fmt: skip
    rows = {name: {f"p{p}": round(_ms(values, p), 2) for p in (50, 95, 99, 100)} for name, values in parts.items()}
    return {
        "summary": {
            "n_scans": chain.n_scans,
            "n_scans_without_command": sum(chain.lost.values()),
            "with_wait_p50_ms": round(_ms(chain.total, 50), 2),
            "with_wait_p99_ms": round(_ms(chain.total, 99), 2),
            "latency_p50_ms": round(_ms(chain.latency, 50), 2),
            "latency_p99_ms": round(_ms(chain.latency, 99), 2),
            "handlers_p50_ms": round(_ms(chain.handlers[is_timed], 50), 2),
            "handlers_p99_ms": round(_ms(chain.handlers[is_timed], 99), 2),
            "ratio_to_handlers_p50": _ratio(chain, is_timed, 50),
            "ratio_to_handlers": _ratio(chain, is_timed, 99),
            **(
                {"n_member": int(came.sum()), "member_p99_ms": round(_ms(chain.member_latency[came], 99), 2)}
                if came.any()
                else {}
            ),
        },
        "parts": rows,
        "scans_without_command": chain.lost,
    }


def _ratio(chain: LatencyChain, is_timed: Bools, percentile: float) -> float | None:
    """Latency to handlers, of the same scans; None where no handler's time is known."""
    handlers = _ms(chain.handlers[is_timed], percentile)
    return round(_ms(chain.latency[is_timed], percentile) / handlers, 2) if handlers else None


def _ms(values: Float64s, percentile: float) -> float:
    return float(np.percentile(values, percentile)) * 1e3 if len(values) else 0.0
