# SPDX-License-Identifier: Apache-2.0
"""Made-up rooms of line segments, what a laser sees in them, and a mapper that drives through."""

from collections.abc import Iterator
from math import hypot, pi
from typing import Any

import numpy as np

from services.mapper.config import MapperConfig
from services.mapper.service import MapperService
from shared.config import Laser, Mount, Robot, load_robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, MapUpdate, Odometry, PoseEstimate
from shared.service import Job, Log, handlers
from shared.topics import Publication
from shared.types import NS_PER_S, Float64s


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


ROOM = np.array([*box(-3, -2, 4, 3), *box(2.2, 1.2, 3.1, 2.0), *box(-2.0, -1.4, -1.5, -0.3), (0.5, 3.0, 1.2, 2.2)])
RING = np.array(
    [*box(0, 0, 16, 11), *box(2.2, 2.2, 13.8, 8.8), *box(5.0, -0.4, 5.9, 0.5), *box(10.5, 0, 11.1, 0.4),
     *box(15.3, 4.0, 16.2, 4.7), *box(13.8, 6.0, 14.3, 7.1), *box(8.0, 10.2, 8.6, 11.2), *box(3.1, 8.8, 4.4, 9.2),
     *box(-0.2, 6.1, 0.6, 6.8), *box(1.8, 3.0, 2.2, 3.7)]
)  # fmt: skip
CORNERS = ((1.1, 1.1), (14.9, 1.1), (14.9, 9.9), (1.1, 9.9))
START = Pose2(*CORNERS[0], 0.0)
STEP, TURN = 0.3, pi / 6
CORRIDOR = np.array([(-50.0, -1.0, 50.0, -1.0), (-50.0, 1.0, 50.0, 1.0)])


def laps() -> Iterator[Pose2]:
    """Motions from START round the ring, on and on: STEP m straight, TURN rad at the corners."""
    while True:
        for k in range(4):
            (x0, y0), (x1, y1) = CORNERS[k], CORNERS[(k + 1) % 4]
            yield from [Pose2(STEP, 0, 0)] * round(hypot(x1 - x0, y1 - y0) / STEP)
            yield from [Pose2(0, 0, TURN)] * round(pi / 2 / TURN)


LAP = sum(round(side / STEP) + 3 for side in (13.8, 8.8, 13.8, 8.8))  # motions


def cast(segments: Float64s, origins: Float64s, angles: Float64s) -> Float64s:
    """(n,) m to the nearest segment (k, 4) from origins (n, 2) along angles (n,); inf where there is none."""
    direction = np.column_stack((np.cos(angles), np.sin(angles)))[:, None]
    from_origin = segments[None, :, :2] - origins[:, None]
    along = segments[:, 2:] - segments[:, :2]
    cross = direction[..., 0] * along[:, 1] - direction[..., 1] * along[:, 0]
    with np.errstate(all="ignore"):
        t = (from_origin[..., 0] * along[:, 1] - from_origin[..., 1] * along[:, 0]) / cross
        u = (from_origin[..., 0] * direction[..., 1] - from_origin[..., 1] * direction[..., 0]) / cross
    return np.min(np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf), axis=1)


def sweep(
    segments: Float64s, pose: Pose2, n: int = 360, noise: float = 0.0, seed: int = 0
) -> tuple[Float64s, Float64s]:
    """Origins and ends (n, 2) in `base` of an instant full turn at a pose, laser at the base."""
    angles = np.arange(n) * 2 * pi / n
    ranges = cast(segments, np.tile((pose.x, pose.y), (n, 1)), pose.yaw + angles)
    ranges += noise * np.random.default_rng(seed).normal(size=n)
    ranges[ranges > 8] = np.nan
    return np.zeros((n, 2)), ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))


ROBOT = load_robot("x80sv_xv11").robot.model_copy(
    update={
        "laser": Laser(
            mount=Mount(x=0.1, y=-0.02, yaw=0.3), angle_min=-3.0, angle_increment=2 * pi / 240, n_beams=240,
            scan_time=0.1, rate=5, range_min=0.05, range_max=8.0,
        )
    }
)  # fmt: skip


class RoomDrive:
    """A mapper with the measurements of a robot in a room; `true` is the robot's pose in the room."""

    def __init__(
        self, segments: Float64s, config: MapperConfig | None = None, noise: float = 0.0, robot: Robot = ROBOT
    ) -> None:
        self.mapper = MapperService(config or MapperConfig(), robot)
        self.segments, self.noise = segments, noise
        self.rng = np.random.default_rng(1)
        self.now = 10 * NS_PER_S
        self.true = self.first = Pose2()
        self.odom_from_start = Pose2(3.0, -1.0, 2.0)
        self.poses: list[PoseEstimate] = []
        self.maps: list[MapUpdate] = []
        self.logs: list[str] = []
        self.jobs: list[Job] = []
        self.busy = False  # jobs wait until `work`

    def take(self, out: object) -> None:
        for item in out or ():  # type: ignore[attr-defined]
            if isinstance(item, Job):
                self.jobs.append(item)
                if not self.busy:
                    self.work()
            elif isinstance(item, Log):
                self.logs.append(item.text)
            elif isinstance(item, Publication) and isinstance(item.message, PoseEstimate):
                self.poses.append(item.message)
            elif isinstance(item, Publication) and isinstance(item.message, MapUpdate):
                self.maps.append(item.message)

    def work(self) -> None:
        """Does what is to be done beside the scans."""
        while self.jobs:
            job = self.jobs.pop(0)
            self.mapper.now = self.now
            self.take(getattr(self.mapper, job.done)(job.function(*job.arguments)))

    def odometry(self, stamp: int, pose: Pose2, v: float = 0.0, w: float = 0.0) -> None:
        self.mapper.now = self.now
        self.take(self.mapper.odometry(Odometry(stamp, self.odom_from_start @ pose, v, w, np.zeros(9))))

    def step(self, motion: Pose2, with_odometry: bool = True) -> None:
        """Moves by `motion` within 0.2 s, the second half of it during a sweep; the sweep comes at its end."""
        begin, start = self.now, self.true
        parts = 20
        moved = [
            start @ Pose2(motion.x * k / parts, motion.y * k / parts, motion.yaw * k / parts) for k in range(parts + 1)
        ]
        for k in range(1, parts + 1):
            self.now = begin + k * NS_PER_S // 100
            if with_odometry:
                self.odometry(self.now, moved[k])
        self.true = moved[-1]
        self.mapper.now = self.now
        self.take(self.mapper.scan(self.scan(moved[parts // 2 :], self.now - NS_PER_S // 10)))
        if len(self.poses) == 1 and not self.maps:
            self.first = self.true

    def scan(self, poses: list[Pose2], stamp: int, laser: Laser | None = None) -> LaserScan:
        """A sweep of a laser, or of the first one, during which the robot passes `poses` at even times."""
        laser = laser or self.mapper.robot.laser
        shares = np.linspace(0, len(poses) - 1, laser.n_beams)
        rows = np.array([(p.x, p.y, p.yaw) for p in poses])
        rows[:, 2] = np.unwrap(rows[:, 2])
        x, y, yaw = (np.interp(shares, np.arange(len(poses)), rows[:, i]) for i in range(3))
        mount = laser.mount
        origins = np.column_stack(
            (x + np.cos(yaw) * mount.x - np.sin(yaw) * mount.y, y + np.sin(yaw) * mount.x + np.cos(yaw) * mount.y)
        )
        angles = yaw + mount.yaw + laser.angle_min + np.arange(laser.n_beams) * laser.angle_increment
        ranges = cast(self.segments, origins, angles) + self.noise * self.rng.normal(size=laser.n_beams)
        ranges[(ranges > laser.range_max) | (ranges < laser.range_min)] = np.nan
        return LaserScan(
            stamp, laser.angle_min, laser.angle_increment, laser.scan_time, laser.range_min, laser.range_max,
            ranges.astype(np.float32),
        )  # fmt: skip

    def publish_map(self) -> None:
        self.mapper.now = self.now
        self.take(self.mapper.publish_map())

    @property
    def error(self) -> Pose2:
        """What is left between the last pose and the truth."""
        return (self.first.inverse() @ self.true).inverse() @ self.poses[-1].map_from_base

    @property
    def grid(self) -> OccupancyGrid:
        """The map as a reader has it."""
        grid = OccupancyGrid()
        for update in self.maps:
            grid.apply(update)
        return grid


class MapRequester:
    """A tool that talks to a mapper directly."""

    def __init__(self, driven: RoomDrive) -> None:
        self.driven = driven

    def now(self) -> int:
        return self.driven.now

    def ask(self, request: Any, message: Any) -> Any:
        mapper = self.driven.mapper
        mapper.now = self.driven.now
        answering = getattr(mapper, handlers(type(mapper)).requests[request.key][1])(message)
        while True:
            try:
                self.driven.take([next(answering)])
            except StopIteration as end:
                return end.value

    def wait(self, seconds: float) -> None:
        self.driven.now += round(seconds * NS_PER_S)
        self.driven.publish_map()
        self.driven.work()
