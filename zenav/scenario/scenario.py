# SPDX-License-Identifier: Apache-2.0
"""A run's robot, world and goals, and what is known when it is over: what demo and benchmark share."""

import json
from dataclasses import dataclass, field
from typing import Any

from services.sim.config import SimConfig
from services.sim.world import World
from shared.config import RobotFile, UserError, configured
from shared.geometry import Pose2
from zenav.metrics.evaluation import RunTrack, evaluation_summary
from zenav.scenario.mission import Mission
from zenav.stack.config_report import read_sections
from zenav.stack.hardware import Hardware, services_for, settings_for, simulated_world

HOME = "back at the start"


@dataclass(frozen=True, slots=True)
class Scenario:
    """goals: in `map`, whose origin is the robot's start; the last is the start itself. settings: as for `--set`."""

    robot: str
    settings: list[str]
    file: RobotFile
    world: World
    goals: list[tuple[str, Pose2]]
    names: list[str]
    seed: int
    hardware: Hardware

    @property
    def radius(self) -> float:
        """m: of the circle around the footprint."""
        return self.file.robot.circumscribed_radius


def load_scenario(
    robot: str,
    world: str,
    seed: int,
    settings: list[str],
    hardware: Hardware = Hardware.MESSAGES,
    meets_robots: bool = False,
) -> Scenario:
    """Reads robot and world. Raises UserError where they are wrong, or the world names no goals.

    meets_robots: whether other robots drive in this world.
    """
    settings = [f"sim.world={json.dumps(world)}", f"sim.seed={seed}", *settings]
    file = configured(robot, settings)
    settings += settings_for(hardware, file, None)
    file = configured(robot, settings)
    read_sections(file)
    built = simulated_world(file)
    if not built.goals:
        raise UserError(f"world {world} names no goals", "add some under `goals:`, or take --world office")
    goals = [(name, built.start.inverse() @ pose) for name, pose in built.goals.items()]
    names = services_for(hardware, file, meets_robots)
    return Scenario(
        robot=robot,
        settings=settings,
        file=file,
        world=built,
        goals=[*goals, (HOME, Pose2())],
        names=names,
        seed=file.section("sim", SimConfig).seed,
        hardware=hardware,
    )


@dataclass
class ScenarioResult:
    """A run that is over. `processes`: CPU (share of a core) and memory (MB) by name."""

    scenario: Scenario
    track: RunTrack
    mission: Mission
    wall_seconds: float
    first_motion: float | None = None  # real s since the command was given
    processes: dict[str, dict[str, float]] = field(default_factory=dict)
    restarts: dict[str, int] = field(default_factory=dict)
    trouble: str = ""  # why it ended before its time, if it did

    @property
    def good(self) -> bool:
        """Every goal reached, exploring ended well or for time, and nothing touched."""
        contacts = self.track.truth.n_contacts if self.track.truth is not None else 0
        return self.mission.explored and self.mission.n_reached == self.mission.n_goals > 0 and contacts == 0

    def report(self) -> dict[str, Any]:
        """Everything that is known of the run, with `summary`."""
        summary = {
            "good": self.good,
            "goals_reached": self.mission.n_reached,
            "goals": self.mission.n_goals,
            "explored": self.mission.explored,
            **evaluation_summary(
                self.track, self.scenario.world, self.scenario.radius, self.scenario.file.robot.laser.range_max
            ),
            "wall_seconds": round(self.wall_seconds, 1),
        }
        if self.first_motion is not None:
            summary["first_motion_s"] = round(self.first_motion, 2)
        return {
            "summary": summary,
            "robot": self.scenario.robot,
            "world": self.scenario.world.name,
            "seed": self.scenario.seed,
            "trouble": self.trouble,
            "legs": [
                {
                    "name": leg.name,
                    "state": str(leg.state),
                    "reason": leg.reason,
                    "seconds": round(leg.seconds, 1),
                    "recoveries": leg.n_recoveries,
                }
                for leg in self.mission.legs
            ],
            "processes": self.processes,
            "restarts": self.restarts,
        }
