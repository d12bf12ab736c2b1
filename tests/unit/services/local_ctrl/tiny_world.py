# SPDX-License-Identifier: Apache-2.0
"""A closed loop of a few lines: a unicycle with delay on a grid world, a laser, a path from plain A*."""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import cos, hypot, inf, pi, sin

import numpy as np
from numba import njit

from services.local_ctrl.mppi import MppiConfig
from services.local_ctrl.service import LocalCtrlConfig, LocalCtrlService
from shared import messages as m
from shared.config import Robot
from shared.distance_field import distance_field
from shared.geometry import Pose2, arc
from shared.messages import FollowState, RecoveryKind
from shared.polygon_kernels import distance_to_polygon
from shared.types import NS_PER_S, Bools, Float32s, Float64s

START = 100 * NS_PER_S  # ns: the clock is not at its zero
MAP_FROM_ODOM = Pose2(0.7, -0.4, 0.3)
QUICK = LocalCtrlConfig(mppi=MppiConfig(rollouts=300))  # a quarter of the usual rollouts: what holds with these holds


class TinyWorld:
    """(h, w) cells of `cell` m, lower left corner at the origin of `map`; its rim is wall."""

    def __init__(self, width: float, height: float, cell: float = 0.025) -> None:
        self.cell = cell
        self.occupied: Bools = np.zeros((round(height / cell), round(width / cell)), bool)
        self.occupied[[0, -1]] = self.occupied[:, [0, -1]] = True
        self._room: Float32s | None = None

    @property
    def room(self) -> Float32s:
        """(h, w) m to the nearest occupied cell."""
        if self._room is None:
            self._room = distance_field(self.occupied, self.cell)
        return self._room

    def box(self, x0: float, y0: float, x1: float, y1: float, full: bool = True) -> "TinyWorld":
        c = self.cell
        self.occupied[max(0, round(y0 / c)) : round(y1 / c), max(0, round(x0 / c)) : round(x1 / c)] = full
        self._room = None
        return self

    def disc(self, x: float, y: float, radius: float) -> "TinyWorld":
        row, column = np.indices(self.occupied.shape)
        self.occupied |= np.hypot((column + 0.5) * self.cell - x, (row + 0.5) * self.cell - y) <= radius
        self._room = None
        return self

    def clearance(self, robot: Robot, pose: Pose2) -> float:
        """m between the true footprint and the nearest occupied cell's centre within a metre; 0 is contact."""
        return float(_clearance(self.occupied, self.cell, robot.corners, pose.x, pose.y, pose.yaw))


@njit(cache=True)
def _clearance(occupied: Bools, cell: float, corners: Float64s, x: float, y: float, yaw: float) -> float:
    c, s = cos(yaw), sin(yaw)
    least = 1.0
    reach = int((1.0 + np.abs(corners).max()) / cell)
    row, column = int(y / cell), int(x / cell)
    for i in range(max(0, row - reach), min(len(occupied), row + reach)):
        for j in range(max(0, column - reach), min(len(occupied[0]), column + reach)):
            if occupied[i, j]:
                dx, dy = (j + 0.5) * cell - x, (i + 0.5) * cell - y
                least = min(least, distance_to_polygon(corners, c * dx + s * dy, c * dy - s * dx))
    return least


@njit(cache=True)
def cast(room: Float32s, cell: float, poses: Float64s, angles: Float64s, range_max: float) -> Float32s:
    """Ranges of beams from poses (n, 2) m in directions (n,), to a third of a cell; NaN where nothing is hit."""
    out = np.full(len(angles), np.nan, np.float32)
    for i in range(len(angles)):
        dx, dy = cos(angles[i]), sin(angles[i])
        away = 0.0
        while away < range_max:
            row, column = int((poses[i, 1] + away * dy) / cell), int((poses[i, 0] + away * dx) / cell)
            if not (0 <= row < room.shape[0] and 0 <= column < room.shape[1]):
                break
            if room[row, column] == 0.0:
                out[i] = away
                break
            away += max(cell / 3, room[row, column] - 1.5 * cell)
    return out


def planned(world: TinyWorld, start: Pose2, goal: Pose2, radius: float, cell: float = 0.05) -> Float64s:
    """(n, 2) m: cost-aware A* over the 8-connected grid for a disc; raises ValueError without a way."""
    step = round(cell / world.cell)
    h, w = world.occupied.shape[0] // step, world.occupied.shape[1] // step
    coarse = world.occupied[: h * step, : w * step].reshape(h, step, w, step).any(axis=(1, 3))
    room = distance_field(coarse, cell) - radius
    cost = np.where(room > 0, 1 + 3 * np.clip(1 - room / 0.4, 0, 1) ** 2, inf)
    goal_cell = int(goal.y / cell), int(goal.x / cell)
    first = int(start.y / cell), int(start.x / cell)
    best, came, heap = {first: 0.0}, {first: first}, [(0.0, first)]
    while heap:
        _, at = heapq.heappop(heap)
        if at == goal_cell:
            break
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            to = at[0] + dr, at[1] + dc
            if not (0 <= to[0] < h and 0 <= to[1] < w) or cost[to] == inf:
                continue
            value = best[at] + hypot(dr, dc) * cost[to]
            if value < best.get(to, inf):
                best[to], came[to] = value, at
                heapq.heappush(heap, (value + hypot(to[0] - goal_cell[0], to[1] - goal_cell[1]), to))
    else:
        raise ValueError("no way")
    cells = [goal_cell]
    while cells[-1] != first:
        cells.append(came[cells[-1]])
    inner = [((c + 0.5) * cell, (r + 0.5) * cell) for r, c in cells[-2:0:-1]]
    points = np.array([(start.x, start.y), *inner, (goal.x, goal.y)])
    for _ in range(6):  # the staircase of the grid, smoothed
        points[1:-1] = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
    return points


def path_message(points: Float64s, goal: m.Goal, stamp: int) -> m.Path:
    heading = np.arctan2(np.gradient(points[:, 1]), np.gradient(points[:, 0])) if len(points) > 1 else np.zeros(1)
    heading[-1] = goal.map_from_goal.yaw
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    return m.Path(stamp, goal.id, 1, "", points[:, 0].copy(), points[:, 1].copy(), heading, length, length)


def drive_goal(pose: Pose2, goal_id: int = 1, tolerance: float = 0.15, yaw_tolerance: float = 0.2) -> m.Goal:
    return m.Goal(START, goal_id, True, pose, tolerance, yaw_tolerance, False)


def recovery(kind: RecoveryKind, amount: float, order_id: int = 1) -> m.Recovery:
    return m.Recovery(START, order_id, kind, amount)


@dataclass
class TinyRun:
    """What happened: truth and commands at every tick."""

    poses: list[Pose2] = field(default_factory=list)
    v: list[float] = field(default_factory=list)
    commands: list[m.Velocity] = field(default_factory=list)
    statuses: list[m.FollowStatus] = field(default_factory=list)
    least_clearance: float = inf

    @property
    def reached(self) -> bool:
        return self.statuses[-1].state is FollowState.ARRIVED

    @property
    def seconds(self) -> float:
        return len(self.commands) * 0.05


class ControlLoop:
    """Robot, world and service, stepped by 10 ms."""

    def __init__(
        self, robot: Robot, world: TinyWorld, start: Pose2, config: LocalCtrlConfig | None = None, delay: float = 0.1
    ) -> None:
        self.robot, self.world, self.truth, self.delay = robot, world, start, round(delay * NS_PER_S)
        self.service = LocalCtrlService(config or QUICK, robot)
        self.now, self.v, self.w = START, 0.0, 0.0
        self.next_sweep = START
        self.trace: deque[tuple[int, Pose2]] = deque(maxlen=64)
        self.sent: deque[tuple[int, float, float]] = deque([(0, 0.0, 0.0)])
        self.rng = np.random.default_rng(7)
        self.run = TinyRun()
        self.lost: set[str] = set()  # inputs that no longer come
        self.goal: m.Goal | None = None
        self.plan: Float64s | None = None
        self.send = self._send

    def _send(self, method: str, message: m.Message) -> None:
        if method not in self.lost:
            self.service.now = self.now
            list(getattr(self.service, method)(message))

    def give(self, order: m.Goal | m.Recovery, plan: Float64s | None = None) -> "ControlLoop":
        order = replace(order, stamp=self.now)
        self.goal, self.plan = order if isinstance(order, m.Goal) else None, plan
        self.send("new_goal" if isinstance(order, m.Goal) else "new_recovery", order)
        self._publish_plan()
        return self

    def _publish_plan(self) -> None:
        if self.plan is not None and self.goal is not None:
            self.send("new_plan", path_message(self.plan, self.goal, self.now))

    def drive(self, seconds: float, until: Callable[["ControlLoop"], bool] | None = None) -> TinyRun:
        """Runs on for so long, or until the service says ARRIVED or the condition holds."""
        for _ in range(round(seconds * 100)):
            since_start = self.now - START
            if since_start % (NS_PER_S // 50) == 0:
                odom_from_base = MAP_FROM_ODOM.inverse() @ self.truth
                self.send("odometry", m.Odometry(self.now, odom_from_base, self.v, self.w, np.zeros(9)))
            if self.now >= self.next_sweep + round(self.robot.laser.scan_time * NS_PER_S):
                self._scan()
            if since_start % (NS_PER_S // 2) == 0:
                self._publish_plan()
            if since_start % (NS_PER_S // 20) == 0:
                self._tick()
                if self.run.reached or (until is not None and until(self)):
                    break
            self._move()
        return self.run

    def _scan(self) -> None:
        laser, first = self.robot.laser, self.next_sweep
        self.next_sweep += round(NS_PER_S / laser.rate)
        share = np.linspace(0, 1, laser.n_beams)
        stamps = first + share * laser.scan_time * NS_PER_S
        times = np.array([t for t, _ in self.trace] + [self.now], float)
        poses = [p for _, p in self.trace] + [self.truth]
        x = np.interp(stamps, times, [p.x for p in poses])
        y = np.interp(stamps, times, [p.y for p in poses])
        yaw = np.interp(stamps, times, np.unwrap([p.yaw for p in poses]))
        mount = laser.mount
        origins = np.column_stack(
            (x + np.cos(yaw) * mount.x - np.sin(yaw) * mount.y, y + np.sin(yaw) * mount.x + np.cos(yaw) * mount.y)
        )
        angles = yaw + mount.yaw + laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
        ranges = cast(self.world.room, self.world.cell, origins, angles, laser.range_max)
        ranges += self.rng.normal(0, 0.01, laser.n_beams).astype(np.float32)
        ranges[self.rng.random(laser.n_beams) < 0.01] = np.nan
        ranges[(ranges < laser.range_min) | (ranges > laser.range_max)] = np.nan
        scan = m.LaserScan(
            first,
            laser.angle_min,
            laser.angle_increment,
            laser.scan_time,
            laser.range_min,
            laser.range_max,
            ranges.astype(np.float32),
        )
        scan.ranges.setflags(write=False)
        self.send("scan", scan)
        pose = m.PoseEstimate(first, Pose2(x[0], y[0], yaw[0]), MAP_FROM_ODOM, np.zeros(9), 1.0, m.Localization.GOOD)
        self.send("pose", pose)

    def _tick(self) -> None:
        self.service.now = self.now
        command, status, *_ = (publication.message for publication in self.service.tick())
        assert isinstance(command, m.Velocity)
        assert isinstance(status, m.FollowStatus)
        self.sent.append((self.now + self.delay, command.v, command.w))
        self.run.commands.append(command)
        self.run.statuses.append(status)
        self.run.poses.append(self.truth)
        self.run.v.append(self.v)
        self.run.least_clearance = min(self.run.least_clearance, self.world.clearance(self.robot, self.truth))

    def _move(self) -> None:
        while len(self.sent) > 1 and self.sent[1][0] <= self.now:
            self.sent.popleft()
        _, v, w = self.sent[0]
        drive = self.robot.drive
        dt = 0.01
        rate = drive.max_acceleration if abs(v) > abs(self.v) else drive.max_braking
        self.v += float(np.clip(v - self.v, -rate * dt, rate * dt))
        self.w += float(np.clip(w - self.w, -drive.max_turn_acceleration * dt, drive.max_turn_acceleration * dt))
        self.trace.append((self.now, self.truth))
        self.truth = self.truth @ arc(self.v * dt, self.w * dt)
        self.now += NS_PER_S // 100


def off(a: Pose2, b: Pose2) -> tuple[float, float]:
    """m and rad between two poses."""
    return a.distance(b), abs((a.yaw - b.yaw + pi) % (2 * pi) - pi)
