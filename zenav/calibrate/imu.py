# SPDX-License-Identifier: Apache-2.0
"""How an inertial sensor sits on the robot: its turns beside the scans', its accelerations beside the wheels'."""

from dataclasses import dataclass
from math import atan2, cos, sin

import numpy as np

from shared.config import UserError
from shared.messages import Imu
from shared.types import Bools, Float64s, Int64s
from zenav.calibrate.hand_eye import MotionIntervals
from zenav.calibrate.rolling import WheelGeometry, WheelTravel
from zenav.render.chart import AFTER, TRUE, Chart

WINDOW_NS = 200_000_000  # over which accelerations are compared
MAX_GAP_NS = 200_000_000  # between two readings, over which a turn is still known
MIN_TURN_RAD = 3.0  # in all pieces together, for the gyro's scale
MIN_ACCELERATION = 0.05  # m/s^2, rms by the wheels, for the direction of the sensor
MAX_SCALE_ERROR = 0.05  # from 1, or from -1, for which the axis of the gyro is right
AXES = "acceleration_x", "acceleration_y"


@dataclass(frozen=True, slots=True)
class ImuSolution:
    """scale: the gyro's turn to the scans' turn; -1 is a sensor upside down.  bias: rad/s, of the gyro.

    yaw: rad, by which the sensor is turned further than the robot's file says; None where it accelerated too little.
    scans, gyro: (n,) rad, the turn of each piece, the gyro's without its bias.
    """

    scale: float
    sigma_scale: float
    bias: float
    yaw: float | None
    sigma_yaw: float
    scans: Float64s
    gyro: Float64s

    @property
    def is_upside_down(self) -> bool:
        """Whether it sits the other way up than the robot's file says."""
        return self.scale < 0

    @property
    def has_right_axis(self) -> bool:
        """Whether the gyro turns as the robot does, or against it."""
        return abs(abs(self.scale) - 1.0) <= MAX_SCALE_ERROR


def solve(imus: list[Imu], pieces: MotionIntervals, rolled: WheelTravel, wheels: WheelGeometry) -> ImuSolution:
    """The least-squares scale and bias of the gyro over the pieces, and the direction that fits the accelerations.

    Raises UserError where there are no readings, or too few turns.
    """
    if len(imus) < 2:
        raise UserError("there is no imu in this drive", "does a sensor publish? zenav topic hz imu")
    stamps = np.array([imu.stamp for imu in imus], np.int64)
    begin, end = pieces.path.stamps[pieces.begin], pieces.path.stamps[pieces.end]
    known = _is_heard(stamps, begin, end)
    scans = pieces.laser[known, 2]
    if np.abs(scans).sum() < MIN_TURN_RAD:
        raise UserError("the robot turns too little in this drive", "record some turns on the spot, both ways")
    angles = _turned(stamps, np.array([imu.yaw_rate for imu in imus]))
    seconds = (end - begin)[known] * 1e-9
    gyro = _at(stamps, angles, end[known]) - _at(stamps, angles, begin[known])
    design = np.column_stack((scans, seconds))
    (scale, bias), *_ = np.linalg.lstsq(design, gyro, rcond=None)
    spread = gyro - design @ (scale, bias)
    variance = float(spread @ spread) / max(len(gyro) - 2, 1) * np.linalg.inv(design.T @ design)[0, 0]
    yaw, sigma_yaw = _direction(imus, stamps, rolled, wheels)
    return ImuSolution(
        scale=float(scale),
        sigma_scale=float(np.sqrt(variance)),
        bias=float(bias),
        yaw=yaw,
        sigma_yaw=sigma_yaw,
        scans=scans,
        gyro=gyro - bias * seconds,
    )


def charts(solution: ImuSolution) -> list[Chart]:
    """The turn of each piece by the gyro, over that by the scans."""
    chart = Chart("Each piece of the way: turn by the gyro, over that by the scans", "scans, rad", "gyro, rad", True)
    chart.dots(solution.scans, solution.scans, TRUE, "equal")
    chart.dots(solution.scans, solution.gyro, AFTER, "gyro")
    return [chart]


def _is_heard(stamps: Int64s, begin: Int64s, end: Int64s) -> Bools:
    """(n,) bool: whether readings come without a gap from each begin to its end (ns)."""
    n_gaps = np.concatenate(([0], np.cumsum(np.diff(stamps) > MAX_GAP_NS)))
    first, last = np.searchsorted(stamps, begin, "right") - 1, np.searchsorted(stamps, end, "left")
    inside = (first >= 0) & (last < len(stamps))
    clipped = np.clip(first, 0, len(stamps) - 1), np.clip(last, 0, len(stamps) - 1)
    return np.asarray(inside & (n_gaps[clipped[1]] == n_gaps[clipped[0]]))


def _turned(stamps: Int64s, rates: Float64s) -> Float64s:
    """(n,) rad turned since the first reading: a rate is the mean since the reading before."""
    return np.concatenate(([0.0], np.cumsum(rates[1:] * np.diff(stamps) * 1e-9)))


def _at(stamps: Int64s, values: Float64s, times: Int64s) -> Float64s:
    return np.asarray(np.interp((times - stamps[0]) * 1e-9, (stamps - stamps[0]) * 1e-9, values))


def _direction(
    imus: list[Imu], stamps: Int64s, rolled: WheelTravel, wheels: WheelGeometry
) -> tuple[float | None, float]:
    """The angle (rad) from the accelerations as published to those of the wheels' motion, and its deviation.

    Both are compared as means of windows, without their own means: the sensor may be tilted a little.
    """
    first, last = max(stamps[0], rolled.stamps[0]), min(stamps[-1], rolled.stamps[-1])
    edges = np.arange(first, last, WINDOW_NS)
    if len(edges) < 4:
        return None, 0.0
    path = rolled.with_samples(edges)
    poses = path.poses(wheels)[np.searchsorted(path.stamps, edges)]
    seconds, steps = WINDOW_NS * 1e-9, np.diff(poses, axis=0)
    v, w = np.hypot(steps[:, 0], steps[:, 1]) / seconds, steps[:, 2] / seconds
    ahead = np.cos(poses[:-1, 2]) * steps[:, 0] + np.sin(poses[:-1, 2]) * steps[:, 1]
    v = np.where(ahead < 0, -v, v)
    wheel = np.column_stack((np.diff(v) / seconds, ((v * w)[:-1] + (v * w)[1:]) / 2))  # between middles of windows
    middles = (edges[:-1] + edges[1:]) // 2
    sensed = np.column_stack([_means(stamps, [getattr(i, key) for i in imus], middles) for key in AXES])
    fits = np.isfinite(sensed).all(axis=1) & rolled.is_known(middles[:-1], middles[1:])
    wheel, sensed = wheel[fits] - wheel[fits].mean(axis=0), sensed[fits] - sensed[fits].mean(axis=0)
    if len(wheel) < 3 or np.sqrt((wheel**2).sum(axis=1).mean()) < MIN_ACCELERATION:
        return None, 0.0
    cross = float((sensed[:, 0] * wheel[:, 1] - sensed[:, 1] * wheel[:, 0]).sum())
    angle = atan2(cross, float((sensed * wheel).sum()))
    c, s = cos(angle), sin(angle)
    turned = sensed @ np.array(((c, s), (-s, c)))
    variance = float(((turned - wheel) ** 2).sum()) / (2 * len(wheel) - 1)
    return angle, float(np.sqrt(variance / (sensed**2).sum()))


def _means(stamps: Int64s, values: list[float], edges: Int64s) -> Float64s:
    """(n - 1,) the mean of the readings between two edges (ns); NaN without one."""
    sums = np.concatenate(([0.0], np.cumsum(values)))
    at = np.searchsorted(stamps, edges)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.diff(sums[at]) / np.diff(at))
