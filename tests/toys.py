# SPDX-License-Identifier: Apache-2.0
"""A small stack of toy services that uses everything a runner offers: ticks, jobs, requests, logs, latched tiles."""

import numpy as np

from shared import requests, topics
from shared.config import Robot, Section, load_robot
from shared.geometry import Pose2
from shared.messages import Localization, MapUpdate, Odometry, Path, PoseEstimate, WheelState
from shared.requests import LoadMap, Reply
from shared.runners.lockstep import Lockstep, Sink
from shared.service import Answer, Job, Log, Out, Service, answer, every, on

ROBOT = load_robot("x80sv").robot
DEFAULTS = Section()


class ToyBase(Service):
    """Wheels that turn ever faster."""

    def __init__(self, config: Section = DEFAULTS, robot: Robot = ROBOT) -> None:
        super().__init__(config, robot)
        self.angle = 0.0

    @every(hz=50)
    def tick(self) -> Out:
        self.angle += 0.01 + 0.001 * np.sin(self.angle)
        yield topics.WHEELS(WheelState(self.now, 0, self.angle, 2 * self.angle, 0.0, 0.0))


class Dead(Service):
    """Odometry: what it publishes depends on everything it took so far."""

    def __init__(self, config: Section = DEFAULTS, robot: Robot = ROBOT, gain: float = 0.1) -> None:
        super().__init__(config, robot)
        self.x, self.gain = 0.0, gain

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        self.x += self.gain * (wheels.left + 0.5 * wheels.right) / (1 + self.x**2)
        yield topics.ODOM(Odometry(wheels.stamp, Pose2(self.x, 0.0, 0.0), 0.0, 0.0, np.eye(3).ravel()))
        if self.x > 1000:
            yield Log("WARNING", "far away")


def tile(number: int, value: int) -> np.ndarray:
    return np.full((1, 4096), (number * 7 + value) % 101, np.int8)


class Tiles(Service):
    """A mapper: a pose for each tenth odometry, a tile a second, slow work on the side, a map from outside."""

    def __init__(self, config: Section = DEFAULTS, robot: Robot = ROBOT) -> None:
        super().__init__(config, robot)
        self.n_odometries = self.version = self.bonus = self.map_id = 0

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        self.n_odometries += 1
        if self.n_odometries % 10 == 0:
            at = Pose2(odometry.odom_from_base.x + self.bonus, 0.0, 0.0)
            quality = 0.5
            yield topics.POSE(PoseEstimate(self.now, at, at, np.eye(3).ravel(), quality, Localization.GOOD))
        if self.n_odometries % 25 == 0:
            yield Job(slow, (self.n_odometries,), done="counted", takes=0.3)

    def counted(self, bonus: int) -> Out:
        self.bonus += bonus
        yield Log("INFO", f"bonus {self.bonus}")

    @on(topics.MAP)
    def take_up(self, kept: MapUpdate) -> Out:
        self.map_id, self.version = kept.map_id, kept.version + len(kept.rows)
        return ()

    @every(hz=2)
    def draw(self) -> Out:
        self.map_id = self.map_id or self.now
        self.version += 1
        row = np.array([self.version % 5], np.int32)
        cells = tile(self.version, self.bonus)
        yield topics.MAP(MapUpdate(self.now, self.map_id, self.version, 0.05, row, row, cells))

    @answer(requests.LOAD_MAP)
    def load(self, request: LoadMap) -> Answer[Reply]:
        self.bonus += 1000
        yield topics.MAP(request.map)
        return Reply(self.now, True, "", "")


def slow(n: int) -> int:
    return n % 13


class Plan(Service):
    """A planner: a path as long as the map is full."""

    def __init__(self, config: Section = DEFAULTS, robot: Robot = ROBOT) -> None:
        super().__init__(config, robot)
        self.map: MapUpdate | None = None
        self.x = 0.0

    @on(topics.MAP)
    def update(self, update: MapUpdate) -> Out:
        self.map = update if self.map is None else self.map.merged(update)
        return ()

    @on(topics.POSE)
    def pose(self, pose: PoseEstimate) -> Out:
        self.x = pose.map_from_base.x
        return ()

    @every(hz=5)
    def plan(self) -> Out:
        length = float(np.sum(self.map.cells, dtype=np.int64)) if self.map else 0.0
        xs = np.array([self.x, self.x + 1.0])
        version = self.map.version if self.map else 0
        yield topics.PLAN(Path(self.now, 1, version, "", xs, np.zeros(2), np.zeros(2), length, 0.0))


TOYS: dict[str, type[Service]] = {"base_driver": ToyBase, "odometry": Dead, "mapper": Tiles, "planner": Plan}


def build(name: str) -> Service:
    """A new toy of this name."""
    return TOYS[name](DEFAULTS, ROBOT)


def eventful(record: Sink) -> Lockstep:
    """A run of 3.3 s: a planner joins late, a mapper gets a map from outside, services are killed and come back."""
    lockstep = Lockstep({name: build(name) for name in ("base_driver", "odometry", "mapper")}, record)
    lockstep.run(1.0)
    lockstep.start("planner", build("planner"))
    lockstep.run(0.5)
    row = np.array([5], np.int32)
    given = MapUpdate(lockstep.now, 7, 1, 0.05, row, row, tile(5, 5))
    assert lockstep.ask(requests.LOAD_MAP, LoadMap(lockstep.now, given, Pose2(0.0, 0.0, 0.0))).accepted
    lockstep.run(0.5)
    lockstep.kill("odometry")
    lockstep.kill("planner")
    lockstep.run(0.1)
    lockstep.kill("mapper")
    lockstep.start("mapper", build("mapper"))
    lockstep.start("odometry", build("odometry"))
    lockstep.run(0.7)
    lockstep.start("planner", build("planner"))
    lockstep.run(0.5)
    lockstep.flush()
    return lockstep
