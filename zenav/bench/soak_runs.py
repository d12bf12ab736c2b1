# SPDX-License-Identifier: Apache-2.0
"""The runs of `zenav bench soak`: processes in real time, or all services on the virtual clock."""

import time
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from shared.messages import NavStatus
from shared.runners.lockstep import Lockstep
from shared.topics import Topic
from zenav.bench.service_faults import FaultReport, Faults, Hear, LaunchedStack
from zenav.bench.soak_samples import ServiceSample, joined_small, process_sample, state_mb
from zenav.client import Client
from zenav.console.shutdown import StopFlag
from zenav.metrics.latency import latency_chain
from zenav.scenario.live_run import ProcessStats, RunView, run_live
from zenav.scenario.lockstep_run import RECORDER, run_lockstep
from zenav.scenario.mission import Mission
from zenav.scenario.scenario import Scenario, ScenarioResult
from zenav.stack.launch import Launcher
from zenav.stack.service_loader import build_service

SAMPLE_EVERY = 5.0  # s
STATE_EVERY = 30.0  # s of the virtual clock
DEAD_S = 0.4  # s that a killed service is away on the virtual clock, as with the launcher
OUT_OF_TIME = "out of time", "not done after"


@dataclass
class SoakRun:
    """A run that is over. waiting: (s, events) that waited in lockstep.  cpu: (s, CPU s so far) in lockstep."""

    outcome: ScenarioResult
    samples: dict[str, list[ServiceSample]]
    faults: list[FaultReport]
    waiting: list[tuple[float, int]] = field(default_factory=list)
    cpu: list[tuple[float, float]] = field(default_factory=list)

    @property
    def trouble(self) -> str:
        """Why it ended before its time; empty where its time was over."""
        return "" if self.outcome.trouble.startswith(OUT_OF_TIME) else self.outcome.trouble

    @property
    def drifting(self) -> str:
        """What `drift` compares: scan to cmd/vel, or the CPU of all services for a second of the stack's time."""
        return "cpu_ms_per_s" if self.cpu else "latency_p99_ms"

    def drift(self, recording: Path, window: float) -> tuple[float, float]:
        """ms, over the first and the last `window` s of driving; zeros where there is none."""
        if not self.cpu:
            return latency_drift(recording, self.outcome, window)
        at, cpu = np.array(self.cpu).T
        middle = np.interp([at[0] + window, at[-1] - window], at, cpu)
        return float(middle[0] - cpu[0]) / window * 1e3, float(cpu[-1] - middle[1]) / window * 1e3


class SoakView(RunView):
    """Samples the processes, and lets faults happen; called ten times a second by the run."""

    def __init__(self, faults: Faults | None) -> None:
        self.samples: dict[str, list[ServiceSample]] = {}
        self._faults = faults
        self._launcher: Launcher | None = None
        self._processes: ProcessStats | None = None
        self._sampled = -inf

    def start(self, scenario: Scenario, launcher: Launcher, processes: ProcessStats) -> None:
        self._launcher, self._processes = launcher, processes

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        if self._launcher is None or self._processes is None:
            return
        if self._faults is not None:
            if not self._faults.has_begun:
                self._faults.begin(LaunchedStack(client, self._launcher))
            self._faults.step(seconds, is_driving=bool(mission.legs[0].seconds))
        if seconds - self._sampled < SAMPLE_EVERY:
            return
        self._sampled = seconds
        for name, child in self._launcher.children.items():
            if child.running and child.process is not None:
                health = self._processes.latest.get(name)
                of_this = health if health is not None and health.pid == child.process.pid else None
                newest = process_sample(child.process.pid, seconds, of_this)
                if newest is not None:
                    self.samples.setdefault(name, []).append(newest)

    def end(self) -> None:
        if self._faults is not None:
            self._faults.end()


class VirtualStack:
    """Services on the virtual clock. A killed one is away for DEAD_S. There is no process to freeze."""

    freezes = False

    def __init__(self, lockstep: Lockstep, scenario: Scenario) -> None:
        self._lockstep, self._scenario = lockstep, scenario
        self.lives = {name: 1 for name in scenario.names if name != RECORDER}
        self._dead: set[str] = set()

    def now(self) -> int:
        return self._lockstep.now

    def listen(self, topic: Topic[Any], hear: Hear) -> None:
        self._lockstep.watch(topic.key, lambda message: hear(message, self._lockstep.now))

    def kill(self, name: str) -> bool:
        if name in self._dead:
            return False
        self._lockstep.kill(name)
        self._dead.add(name)
        self._lockstep.at(DEAD_S, lambda: self._start(name))
        return True

    def freeze(self, name: str) -> bool:
        return False

    def thaw(self) -> None:
        return None

    def states(self, seconds: float) -> dict[str, ServiceSample]:
        """The size of each running service's state, by name."""
        running = [name for name in self.lives if name not in self._dead]
        size = {name: state_mb(self._lockstep.service(name)) for name in running}
        return {name: ServiceSample(seconds, self.lives[name], mb) for name, mb in size.items()}

    def _start(self, name: str) -> None:
        file = self._scenario.file
        self._lockstep.start(name, build_service(name, file, file.robot))
        self._dead.discard(name)
        self.lives[name] += 1


def run_processes(tours: Scenario, seconds: float, recording: Path, stop: StopFlag, faults: Faults | None) -> SoakRun:
    """The live stack, in real time."""
    view = SoakView(faults)
    outcome = run_live(tours, seconds, recording.parent, recording, stop, view)
    return SoakRun(outcome, view.samples, faults.reports if faults is not None else [])


def run_virtual(tours: Scenario, seconds: float, recording: Path, stop: StopFlag, faults: Faults | None) -> SoakRun:
    """All services in this process, as fast as it goes."""
    samples: dict[str, list[ServiceSample]] = {}
    waiting: list[tuple[float, int]] = []
    cpu: list[tuple[float, float]] = []
    stacks: list[tuple[Lockstep, VirtualStack]] = []
    looking = 0.0  # CPU s of taking samples

    def begin(lockstep: Lockstep) -> None:
        stack = VirtualStack(lockstep, tours)
        stacks.append((lockstep, stack))
        if faults is not None:
            faults.begin(stack)

    def step(at: float, mission: Mission, nav: NavStatus | None) -> bool:
        nonlocal looking
        lockstep, stack = stacks[0]
        if faults is not None:
            faults.step(at, is_driving=bool(mission.legs[0].seconds))
        if not waiting or at - waiting[-1][0] >= STATE_EVERY:
            begun = time.process_time()
            for name, found in stack.states(at).items():
                samples.setdefault(name, []).append(found)
            waiting.append((at, lockstep.n_waiting))
            looking += time.process_time() - begun
            cpu.append((at, time.process_time() - looking))
        return not stop.is_set()

    outcome = run_lockstep(tours, seconds, recording, step, begin)
    reports = faults.reports if faults is not None else []
    return SoakRun(outcome, joined_small(samples), reports, waiting, cpu)


def latency_drift(recording: Path, outcome: ScenarioResult, window: float) -> tuple[float, float]:
    """p99 of scan to cmd/vel, ms, over the first and the last `window` s of driving; zeros where there is none."""
    first = outcome.track.first_motion
    if first is None:
        return 0.0, 0.0
    chain = latency_chain(recording, first)
    if not len(chain.latency):
        return 0.0, 0.0
    n = max(1, round(len(chain.latency) * min(0.5, window / max(outcome.wall_seconds, 1.0))))
    first_ms, last_ms = (float(np.percentile(part, 99)) * 1e3 for part in (chain.latency[:n], chain.latency[-n:]))
    return first_ms, last_ms
