# SPDX-License-Identifier: Apache-2.0
"""Simulator, base driver, odometry and mapper on the virtual clock, driven by the driver through a world."""

import json
from collections.abc import Callable
from enum import Enum
from time import process_time

import numpy as np

from services.mapper.config import MapperConfig
from services.mapper.maps.map_file import SavedMap
from services.mapper.service import MapperService
from services.sim import dynamics
from services.sim.config import SimConfig
from services.sim.service import SimService
from shared import topics
from shared.config import RobotFile, configured
from shared.geometry import Pose2
from shared.messages import PoseEstimate, Truth, Velocity
from shared.runners.lockstep import Lockstep
from shared.service import Service
from zenav.bench.ground_truth_driver import MAX_GOAL_DISTANCE, GroundTruthDriver
from zenav.metrics.evaluation import TRACK_TOPICS, RunTrack
from zenav.scenario.path_finder import PathFinder
from zenav.stack.config_report import read_sections
from zenav.stack.hardware import Hardware, settings_for
from zenav.stack.service_loader import build_service

PERIOD = 0.05  # s between two commands
AT_FIRST = 1.0  # s that a robot stands when its stack has started


class DriveResult(Enum):
    """How a drive to a pose ended; the value is the words of a report."""

    REACHED = "reached"
    STOPPED = "stopped by its condition"
    GAVE_UP = "given up on the way"
    NO_PATH = "no path"


def harness_robot_file(robot: str, world: str, seed: int, start: Pose2 | None, settings: list[str]) -> RobotFile:
    """The robot in a world; at `start`, if not where the world says."""
    settings = [f"sim.world={json.dumps(world)}", f"sim.seed={seed}", *settings]
    if start is not None:
        settings.append(f"sim.start={json.dumps({'x': start.x, 'y': start.y, 'yaw': start.yaw})}")
    settings += settings_for(Hardware.MESSAGES, configured(robot, settings), None)
    file = configured(robot, settings)
    read_sections(file)
    return file


class SimSlamHarness:
    """A run. `saved`: the mapper only localises in it, from nowhere. `track` is what was heard."""

    def __init__(self, file: RobotFile, paths: PathFinder | None = None, saved: SavedMap | None = None) -> None:
        self.mapper = MapperService(file.section("mapper", MapperConfig), file.robot)
        self.sim = SimService(file.section("sim", SimConfig), file.robot)
        self.world = self.sim.world
        for _ in self.mapper.use_map(saved, fixed=True) if saved is not None else ():
            pass  # no service subscribes to the map yet
        services: dict[str, Service] = {"sim": self.sim, "mapper": self.mapper}
        services |= {name: build_service(name, file, file.robot) for name in ("base_driver", "odometry")}
        begun = process_time()
        self.lockstep = Lockstep(services)
        self.warming = process_time() - begun  # s of CPU
        self.paths = paths if paths is not None else PathFinder(self.world, file.robot)
        self.driver = GroundTruthDriver(self.paths)
        self.track = RunTrack()
        for key in TRACK_TOPICS:
            self.lockstep.watch(key, lambda message: self.track.add(message, self.lockstep.now))
        self.stand(AT_FIRST)

    @property
    def truth(self) -> Truth:
        assert self.track.truth is not None
        return self.track.truth

    def watch(self, watcher: Callable[[PoseEstimate], None]) -> None:
        """Calls `watcher` with each of the mapper's poses."""
        self.lockstep.watch(topics.POSE.key, watcher)

    def drive(self, goal: Pose2, until: Callable[[], bool] = lambda: False) -> DriveResult:
        """Drives to a pose, or until the condition holds. REACHED is judged by the true pose, not by the driver."""
        if not self.driver.go(goal, self.truth):
            return DriveResult.NO_PATH
        while not until():
            if (command := self.driver.command(self.truth, PERIOD)) is None:
                near = self.truth.world_from_base.distance(goal) <= MAX_GOAL_DISTANCE
                return DriveResult.REACHED if near else DriveResult.GAVE_UP
            self._command(*command)
        return DriveResult.STOPPED

    def stand(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Stands for this long, or until the condition holds."""
        for _ in range(round(seconds / PERIOD)):
            if until():
                break
            self._command(0.0, 0.0)

    def _command(self, v: float, w: float) -> None:
        self.lockstep.publish(topics.CMD_VEL(Velocity(self.lockstep.now, v, w, "")), "guard")
        self.lockstep.run(PERIOD)

    def carry(self, pose: Pose2) -> None:
        """Somebody lifts the standing robot and sets it down at another pose, in no time; its wheels do not turn."""
        sim = self.sim
        for column, value in zip((dynamics.X, dynamics.Y, dynamics.YAW), (pose.x, pose.y, pose.yaw)):
            sim.state_now[column] = value
        sim.history[:, :3] = pose.x, pose.y, pose.yaw

    def free_of_people(self, pose: Pose2, away: float) -> bool:
        """Whether no walking person is within `away` m of a pose."""
        distances = np.hypot(self.truth.people_x - pose.x, self.truth.people_y - pose.y)
        return bool((distances > away).all())
