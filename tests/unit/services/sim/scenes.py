# SPDX-License-Identifier: Apache-2.0
"""Simulators in worlds of a few lines, driven by hand."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from services.base_driver.kinematics import board_counts, wheel_speeds
from services.sim.config import SimConfig
from services.sim.service import SimService
from shared.config import Robot, load_robot
from shared.messages import MotorCommand
from shared.robot import Bumper, CliffSensor, ImuMount
from shared.topics import Publication

TICK = 20_000_000  # ns
START = 1_000_000_000_000
X80SV = load_robot("x80sv").robot
XV11 = load_robot("x80sv_xv11").robot  # a beam each degree
JACKAL = load_robot("jackal").robot

PERFECT: dict[str, Any] = {
    "drive": {"motor_lag": 0, "wheel_acceleration": 50, "radius_error": 0, "distance_error": 0, "slip": 0},
    "laser": {"sigma": 0, "sigma_share": 0, "resolution": 0, "dropout": 0},
    "ranges": {"sigma": 0, "resolution": 0, "n_rays": 9},
}
"""Settings of a simulator without any error."""
SENSING = X80SV.model_copy(
    update={
        "imu": ImuMount(),
        "bumpers": (Bumper(name="front", bearing=0.0, width=2.0),),
        "cliffs": (CliffSensor(name="ahead", x=0.2, y=0.0),),
        "estop_input": True,
        "lasers": (X80SV.laser, X80SV.laser.model_copy(update={"name": "rear", "mapping": False})),
    }
)
"""An X80SV with all that a fault can break."""


def simulator(world: str | Path, robot: Robot = X80SV, **settings: Any) -> SimService:
    """A simulator at START, before its first event."""
    service = SimService(SimConfig.model_validate({"world": str(world), **settings}), robot)
    service.now = START
    return service


def written(folder: Path, text: str, name: str = "world.yaml") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def drive(service: SimService, seconds: float, v: float, w: float) -> Iterator[Publication]:
    """Commands a velocity and ticks at 50 Hz; what the simulator publishes."""
    left, right = board_counts(*wheel_speeds(v, w, service.robot.drive), service.robot.drive)
    for _ in range(round(seconds * 50)):
        yield from service.motors(MotorCommand(service.now, left, right))  # type: ignore[misc]
        service.now += TICK
        yield from service.tick()  # type: ignore[misc]


def told(publications: Iterator[Publication] | list[Publication], key: str) -> list[Any]:
    return [p.message for p in publications if p.topic.key == key]


def laser(robot: Robot, **changes: Any) -> Robot:
    """The robot with other settings of its laser."""
    return robot.model_copy(update={"laser": robot.laser.model_copy(update=changes)})
