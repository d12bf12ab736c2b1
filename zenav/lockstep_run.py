# SPDX-License-Identifier: Apache-2.0
"""The scenario in this process on the virtual clock: the same seed gives the same recording, byte for byte."""

import time
from collections.abc import Callable
from pathlib import Path

from shared.messages import NavStatus
from shared.recording import CONFIG, Writer, about, sink
from shared.runners.lockstep import START, Lockstep
from shared.service import Service
from zenav.classes import made
from zenav.hardware import wires
from zenav.pilot import Pilot
from zenav.scene import Outcome, Scene
from zenav.score import KEYS, Track

STEP = 0.2  # s of virtual time between two looks of the pilot
RECORDER = "recorder"  # records files by itself; here the runner's own sink does

Tell = Callable[[float, Pilot, NavStatus | None], bool]
"""(virtual s, pilot, status) -> whether to go on."""


def stack(scene: Scene) -> dict[str, Service]:
    """The scene's services, but for the recorder."""
    robot = scene.file.robot
    return {name: made(name, scene.file, robot) for name in scene.names if name != RECORDER}


def run(scene: Scene, seconds: float, record: Path | None, tell: Tell = lambda at, pilot, nav: True) -> Outcome:
    """Runs the scenario for at most `seconds` of virtual time."""
    services, joined = stack(scene), wires(scene.hardware, scene.file)
    if record is None:
        return _run(scene, Lockstep(services, wires=joined), seconds, tell)
    with Writer(record, about(scene.file.robot.name), {CONFIG: scene.file.text.encode()}) as writer:
        return _run(scene, Lockstep(services, sink(writer), joined), seconds, tell)


def _run(scene: Scene, lockstep: Lockstep, seconds: float, tell: Tell) -> Outcome:
    begun, cpu = time.monotonic(), time.process_time()
    track, newest = Track(), list[NavStatus]()

    def heard(message: NavStatus) -> None:
        newest[:] = [message]

    for key in KEYS:
        lockstep.watch(key, lambda message: track.take(message, lockstep.now))
    lockstep.watch("nav/status", heard)
    pilot = Pilot(scene.goals, lockstep.ask, seconds=seconds)
    goes_on = True
    while goes_on and pilot.leg is not None and lockstep.now - START < seconds * 1e9:
        lockstep.run(STEP)
        nav = newest[0] if newest else None
        pilot.step(lockstep.now / 1e9, nav)
        goes_on = tell((lockstep.now - START) / 1e9, pilot, nav)
    lockstep.flush()
    wall = time.monotonic() - begun
    outcome = Outcome(scene, track, pilot, wall)
    outcome.processes["lockstep"] = {"cpu": round((time.process_time() - cpu) / wall, 3), "memory_mb": memory()}
    if pilot.leg is not None:
        outcome.trouble = f"not done after {seconds:g} s" if goes_on else "interrupted"
    return outcome


def memory() -> float:
    """MB that this process holds."""
    import psutil

    return round(psutil.Process().memory_info().rss / 1e6, 1)
