# SPDX-License-Identifier: Apache-2.0
"""The scenario in this process on the virtual clock: the same seed gives the same recording, byte for byte."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from shared.config import UserError
from shared.messages import NavStatus
from shared.recording import CONFIG, Writer, about, sink
from shared.requests import Reply, Request
from shared.runners.lockstep import START, Lockstep
from shared.service import Service
from zenav.metrics.evaluation import TRACK_TOPICS, RunTrack
from zenav.scenario.mission import Mission
from zenav.scenario.scenario import Scenario, ScenarioResult
from zenav.stack.hardware import wires
from zenav.stack.service_loader import build_service

STEP_S = 0.2  # s of virtual time between two looks of the mission
RECORDER = "recorder"  # records files by itself; here the runner's own sink does

OnStep = Callable[[float, Mission, NavStatus | None], bool]
"""(virtual s, mission, status) -> whether to go on."""
OnStart = Callable[[Lockstep], None]
"""Receives the stack before its first event."""


def lockstep_services(scenario: Scenario) -> dict[str, Service]:
    """The scenario's services, but for the recorder."""
    robot = scenario.file.robot
    return {name: build_service(name, scenario.file, robot) for name in scenario.names if name != RECORDER}


def run_lockstep(
    scenario: Scenario,
    seconds: float,
    record: Path | None,
    tell: OnStep = lambda at, mission, nav: True,
    begin: OnStart = lambda lockstep: None,
) -> ScenarioResult:
    """Runs the scenario for at most `seconds` of virtual time."""
    services, joined = lockstep_services(scenario), wires(scenario.hardware, scenario.file)
    if record is None:
        return _run(scenario, Lockstep(services, wires=joined), seconds, tell, begin)
    with Writer(record, about(scenario.file.robot.name), {CONFIG: scenario.file.text.encode()}) as writer:
        return _run(scenario, Lockstep(services, sink(writer), joined), seconds, tell, begin)


def _run(scenario: Scenario, lockstep: Lockstep, seconds: float, tell: OnStep, begin: OnStart) -> ScenarioResult:
    begun, cpu = time.monotonic(), time.process_time()
    begin(lockstep)
    track, newest = RunTrack(), list[NavStatus]()

    def keep_newest(message: NavStatus) -> None:
        newest[:] = [message]

    for key in TRACK_TOPICS:
        lockstep.watch(key, lambda message: track.add(message, lockstep.now))
    lockstep.watch("nav/status", keep_newest)
    mission = Mission(scenario.goals, partial(_ask, lockstep), seconds=seconds)
    goes_on = True
    while goes_on and mission.leg is not None and lockstep.now - START < seconds * 1e9:
        lockstep.run(STEP_S)
        nav = newest[0] if newest else None
        mission.step(lockstep.now / 1e9, nav)
        goes_on = tell((lockstep.now - START) / 1e9, mission, nav)
    lockstep.flush()
    wall = time.monotonic() - begun
    outcome = ScenarioResult(scenario, track, mission, wall)
    outcome.processes["lockstep"] = {"cpu": round((time.process_time() - cpu) / wall, 3), "memory_mb": memory_mb()}
    if mission.leg is not None:
        outcome.trouble = f"not done after {seconds:g} s" if goes_on else "interrupted"
    return outcome


def _ask(lockstep: Lockstep, request: Request[Any, Reply], message: Any) -> Reply:
    try:
        return lockstep.ask(request, message)
    except KeyError:
        raise UserError(f"{request.by} does not run", "it was killed, and starts again") from None


def memory_mb() -> float:
    """MB that this process holds."""
    import psutil

    return round(psutil.Process().memory_info().rss / 1e6, 1)
