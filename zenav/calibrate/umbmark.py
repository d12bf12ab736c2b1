# SPDX-License-Identifier: Apache-2.0
"""UMBmark: which wheel radii and wheel distance follow from squares that were driven in both directions?

Source: Borenstein & Feng 1996, "Measurement and correction of systematic odometry errors in mobile robots".
It is in IEEE Transactions on Robotics and Automation 12 (6). Equation numbers are the paper's.
x points along the first side, y to its left. An error is the true end position minus odometry's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sin

import numpy as np

from shared.config import UserError
from shared.types import Float64s, Int64s
from zenav.calibrate.rolling import WheelGeometry, WheelTravel, relative_poses

STANDS = 1.0  # s without motion that part one run from the next; at corners the robot stands for less
MOVES = 0.002  # m at a wheel's rim within that time that count as motion
MIN_SIDE_M = 0.5
ROUND = 0.6  # rad by which a run's whole turn may differ from a full one
OPEN = 0.25  # share of its length by which a run's end may lie off its start
ROUNDS = 10  # of correcting what is left after the last: the paper's equations hold for small angles
MAX_TURNING_ERROR_RAD = pi / 8  # per corner or side: the equations assume small angles


@dataclass(frozen=True, slots=True)
class SquareRun:
    """One way round a square. begin, end: indices into the wheels' samples; side: m; clockwise or not."""

    begin: int
    end: int
    side: float
    clockwise: bool


@dataclass(frozen=True, slots=True)
class UmbmarkResult:
    """The result: wheels, and the errors (n, 2) m of each way round, from which they come."""

    wheels: WheelGeometry
    side: float
    clockwise: Float64s
    counterclockwise: Float64s
    alpha: float  # rad that each corner lacks of a right angle, both ways round: the wheel distance
    beta: float  # rad by which each side bends to the left, both ways round: unequal wheels

    @property
    def sigmas(self) -> tuple[float, float] | None:
        """Standard deviations of ratio and wheel distance (m) by the runs' scatter; None where a way has one run."""
        if min(len(self.clockwise), len(self.counterclockwise)) < 2:
            return None
        means = sum(off.var(axis=0, ddof=1).sum() / len(off) for off in (self.clockwise, self.counterclockwise))
        angle = float(np.sqrt(means)) / (8 * self.side)
        return angle * self.wheels.distance / self.side, angle * self.wheels.distance / (pi / 2)


def largest_error(clockwise: Float64s, counterclockwise: Float64s) -> float:
    """m: E_max,syst, the paper's measure of odometric accuracy (4, 5)."""
    centres = np.array((clockwise.mean(axis=0), counterclockwise.mean(axis=0)))
    return float(np.hypot(centres[:, 0], centres[:, 1]).max())


def square_runs(rolled: WheelTravel, wheels: WheelGeometry) -> list[SquareRun]:
    """The ways round a square in a drive: from standstill to standstill, once round, back to where they began."""
    poses = rolled.poses(wheels)
    runs = []
    for begin, end in moving(rolled, wheels.radius):
        if rolled.broken[begin + 1 : end + 1].any():
            continue
        path = poses[begin : end + 1]
        steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
        # on the spot the base stands but for slip: only what is driven straight on makes the sides
        side = float(steps.sum()) / 4
        turn = float(path[-1, 2] - path[0, 2])
        off = float(np.hypot(*(path[-1, :2] - path[0, :2])))
        if side >= MIN_SIDE_M and abs(abs(turn) - 2 * pi) < ROUND and off < OPEN * 4 * side:
            runs.append(SquareRun(int(begin), int(end), side, turn < 0))
    return runs


def moving(rolled: WheelTravel, radius: float) -> list[tuple[int, int]]:
    """(begin, end) samples of each stretch that stands before and after it for STANDS, and moves between."""
    window = np.searchsorted(rolled.stamps, rolled.stamps + round(STANDS * 1e9), "right") - 1
    away = np.maximum(np.abs(rolled.left[window] - rolled.left), np.abs(rolled.right[window] - rolled.right)) * radius
    whole = rolled.stamps[-1] - rolled.stamps >= round(STANDS * 1e9)
    still = np.zeros(len(away), bool)
    for i in np.flatnonzero((away < MOVES) & whole):
        still[i : window[i] + 1] = True
    edges = np.flatnonzero(np.diff(still.astype(np.int8)))
    starts = [int(i) for i in edges if still[i]]
    ends = [int(i) + 1 for i in edges if not still[i]]
    ends = [e for e in ends if not starts or e > starts[0]]
    return list(zip(starts, ends))  # a drive that ends while it moves has a start without an end


def errors(true: Float64s, rolled: WheelTravel, runs: Sequence[SquareRun], wheels: WheelGeometry) -> Float64s:
    """(k, 2) m: each run's end as it was less as these wheels say. true: (k, 3) motion from start to end."""
    poses = rolled.poses(wheels)
    begin = poses[[run.begin for run in runs]]
    end = poses[[run.end for run in runs]]
    return np.asarray((true - relative_poses(begin, end))[:, :2])


def umbmark(true: Float64s, rolled: WheelTravel, runs: Sequence[SquareRun], wheels: WheelGeometry) -> UmbmarkResult:
    """Wheels that explain the errors. true: (k, 3) each run's motion from start to end; `wheels`: as believed so far.

    Raises UserError where one way round is missing, or the errors are too large for the method.
    """
    clockwise = np.array([run.clockwise for run in runs], bool)
    for direction, is_driven in (("clockwise", clockwise.any()), ("counter-clockwise", (~clockwise).any())):
        if not is_driven:
            raise UserError(
                f"there is no square {direction} round in this drive",
                "UMBmark needs both: zenav calibrate odometry drives them, stand for a second between two squares",
            )
    off = errors(true, rolled, runs, wheels)
    side = float(np.mean([run.side for run in runs]))
    alpha, beta = angles(off[clockwise], off[~clockwise], side)
    if max(abs(alpha), abs(beta)) > MAX_TURNING_ERROR_RAD:
        raise UserError(
            f"the squares end {largest_error(off[clockwise], off[~clockwise]):.1f} m off",
            "measure wheel_radius and wheel_distance with a tape, put them into the robot's file, and drive again",
        )
    better = wheels
    for _ in range(ROUNDS):
        left = errors(true, rolled, runs, better)
        better = corrected(better, *angles(left[clockwise], left[~clockwise], side), side)
    return UmbmarkResult(
        wheels=better, side=side, clockwise=off[clockwise], counterclockwise=off[~clockwise], alpha=alpha, beta=beta
    )


def angles(clockwise: Float64s, counterclockwise: Float64s, side: float) -> tuple[float, float]:
    """Alpha and beta, rad, from the errors' centres of gravity, each from x and from y (9 to 12, and their y)."""
    (cw_x, cw_y), (ccw_x, ccw_y) = clockwise.mean(axis=0), counterclockwise.mean(axis=0)
    alpha = ((cw_x + ccw_x) + (cw_y - ccw_y)) / 2 / (-4 * side)
    beta = ((cw_x - ccw_x) + (cw_y + ccw_y)) / 2 / (-4 * side)
    return float(alpha), float(beta)


def corrected(wheels: WheelGeometry, alpha: float, beta: float, side: float) -> WheelGeometry:
    """The wheels from the angles: E_d = (R + b / 2) / (R - b / 2), R = (L / 2) / sin(beta / 2) (15 to 18).

    The mean radius stays, because squares do not determine it (13, 14).
    """
    bend = 2 * sin(beta / 2) / side  # 1 / R, 1/m
    ratio = wheels.ratio * (1 + bend * wheels.distance / 2) / (1 - bend * wheels.distance / 2)
    distance = wheels.distance * (pi / 2) / (pi / 2 - alpha)
    left = 2 * wheels.radius / (1 + ratio)
    return WheelGeometry(left, left * ratio, distance)


def ends_at(track_stamps: Int64s, track_poses: Float64s, rolled: WheelTravel, runs: Sequence[SquareRun]) -> Float64s:
    """(k, 3) each run's motion by poses (n, 3) of a truth: the mean of those taken while the robot stood, or the last.

    Raises UserError where there is none at a standstill.
    """
    rows = []
    edges = sorted({(run.begin, run.end) for run in runs})
    for k, (begin, end) in enumerate(edges):
        before = edges[k - 1][1] if k else 0
        after = edges[k + 1][0] if k + 1 < len(edges) else len(rolled.stamps) - 1
        rows.append(
            (
                _standing(track_stamps, track_poses, int(rolled.stamps[before]), int(rolled.stamps[begin]), False),
                _standing(track_stamps, track_poses, int(rolled.stamps[end]), int(rolled.stamps[after]), True),
            )
        )
    starts, ends = (np.array(part).reshape(-1, 3) for part in zip(*rows))
    by_edges = dict(zip(edges, relative_poses(starts, ends)))
    return np.array([by_edges[(run.begin, run.end)] for run in runs]).reshape(-1, 3)


def _standing(stamps: Int64s, poses: Float64s, begin: int, end: int, first: bool) -> Float64s:
    """The mean pose of the standstill's nearest half second."""
    near, far = (begin, min(end, begin + 500_000_000)) if first else (max(begin, end - 500_000_000), end)
    chosen = (stamps >= near) & (stamps <= far)
    if not chosen.any():
        raise UserError("there is no pose where a square begins or ends", "record scan too: is the laser running?")
    return np.asarray(poses[chosen].mean(axis=0))
