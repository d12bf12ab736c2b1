# SPDX-License-Identifier: Apache-2.0
"""Hostile clients of the page: what they send commands nothing, and the benchmark sees a robot that they slow."""

import asyncio
import threading
import time

import numpy as np
import pytest

from services.dashboard.frames import FrameError, checked_frame, checked_operation, unpacked_frame
from tests.unit.services.dashboard.browser import Browser, serving
from zenav.bench.hostile_clients import HostileClients, arbitrary_frame
from zenav.bench.page import ATTACKS, PHASE_S, QUIET, Phase, figures
from zenav.metrics.latency import LatencyChain

PHASE_NS = round(PHASE_S * 1e9)


def test_no_arbitrary_frame_commands_the_robot_and_most_are_refused():
    rng, n_valid = np.random.default_rng(1), 0
    for _ in range(20_000):
        try:
            kind, values = unpacked_frame(arbitrary_frame(rng))
            fields = checked_frame(kind, values)
            if kind == "do":
                checked_operation(fields["op"], fields.get("args", {}))
        except FrameError:
            continue
        n_valid += 1
        assert kind in ("let_go", "ping", "name", "want", "ask")
    assert n_valid < 4000


def phases_and_chain(slow: float):
    """Ten scans a second; in the attack `frames` each takes `slow` times as long."""
    names = [name for attack in ATTACKS for name in (QUIET, attack)]
    phases = [Phase(name, i * PHASE_NS, (i + 1) * PHASE_NS, 0.4, {"served": 2}) for i, name in enumerate(names)]
    sent = np.arange(0, len(names) * PHASE_NS, 100_000_000)
    latency = np.full(len(sent), 0.01)
    frames = phases[names.index("frames")]
    latency[(sent >= frames.begin) & (sent < frames.end)] *= slow
    nothing = np.zeros(len(sent))
    parts = {"wait": nothing, "control": nothing, "guard": nothing, "member": nothing, "handlers": nothing}
    return phases, LatencyChain(to_control=latency, **parts, sent=sent, lost={}, n_scans=len(sent))


@pytest.mark.parametrize(("slow", "kept"), [(1.0, True), (1.08, True), (1.2, False)])
def test_an_attack_that_slows_the_robot_by_over_a_tenth_is_seen(slow, kept):
    phases, chain = phases_and_chain(slow)
    report = figures(chain, phases)
    assert report["summary"]["ratios"]["frames"] == pytest.approx(slow)
    assert report["summary"]["ratios"]["slowloris"] == pytest.approx(1.0)
    assert report["summary"]["kept"] is kept
    assert report["rows"]["frames"]["cpu"] == pytest.approx(0.4 / PHASE_S)
    assert report["rows"][QUIET]["counts"] == {"served": 2 * len(ATTACKS)}


def test_an_honest_page_is_served_while_all_attack_at_once(monkeypatch):
    with serving(monkeypatch) as served, Browser(served.port) as honest:
        honest.first("hello")
        hostile = HostileClients(served.port)

        def all_happened() -> bool:
            counts = hostile.counts
            return counts["frames"] > 100 and counts["half requests"] > 0 and counts["oversized frames"] > 0

        async def all_at_once() -> None:
            for seconds in (3, 10, 30):  # a slow machine opens few of the connections in the first seconds
                until = time.monotonic() + seconds
                await asyncio.gather(
                    hostile.frames(until),
                    hostile.oversized(until),
                    hostile.slowloris(until),
                    hostile.connections(until),
                )
                if all_happened():
                    break

        attack = threading.Thread(target=lambda: asyncio.run(all_at_once()))
        attack.start()
        n_answered = 0
        while attack.is_alive():
            n_answered += 1
            honest.send("ping", id=n_answered)
            honest.until(lambda n=n_answered: any(pong["id"] == n for pong in honest.of("pong")))
            attack.join(0.1)
        assert n_answered > 3
        assert not served.published, "commands of hostile clients"
        assert all_happened(), hostile.counts
        assert served.request("GET", "/session")[0] == 200
