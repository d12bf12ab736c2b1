# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning: pose increments and their covariance from the travel of each wheel.

left, right: travel of each wheel since the last step, m, positive forward.
"""

from math import atan2, cos, sin
from typing import Literal

import numpy as np
from pydantic import Field

from services.odometry.gyro import GyroConfig
from shared.config import Section
from shared.geometry import Pose2, arc
from shared.types import Float64s


class DeadReckoningConfig(Section):
    """Dead reckoning from the wheels."""

    integration: Literal["exact", "document"] = Field(
        "exact", description="exact: circular arc; document: atan2 and the previous heading, as in the X80SV's driver"
    )
    gyro: GyroConfig = Field(GyroConfig(), description="heading by the gyro of an inertial sensor")
    wheel_variance: float = Field(
        2e-5, ge=0, le=1, description="variance, m^2, for each m of travel of a wheel: slip, radius, floor"
    )
    base_distance_scale: float = Field(
        1.0,
        ge=0.5,
        le=2,
        description="of a base with odometry of its own: true distance over the one that it reports; "
        "measure: zenav calibrate odometry",
    )
    base_turn_scale: float = Field(1.0, ge=0.5, le=2, description="the same of its turns")


def exact_step(left: float, right: float, distance: float) -> tuple[Pose2, Float64s]:
    """Motion along the circular arc of both wheels' travel, and its Jacobian.

    left, right: m, travel of the wheels.  distance: m between the wheels.
    Returns `before_from_after` (m, rad) and (3, 2) d(x, y, yaw) / d(left, right).
    """
    forward, turn = (left + right) / 2, (right - left) / distance
    motion, by_forward, by_turn = arc_motion(forward, turn)
    return motion, _wheel_jacobian(by_forward, by_turn / distance)


def arc_motion(forward: float, turn: float) -> tuple[Pose2, Float64s, Float64s]:
    """Motion along an arc of length `forward` m that turns by `turn` rad, and its derivatives (3,) by both."""
    half = turn / 2
    if abs(half) > 1e-4:
        chord = sin(half) / half
        bend = (cos(half) - chord) / half
    else:
        chord, bend = 1 - half * half / 6, -half / 3
    c, s = cos(half), sin(half)
    by_forward = np.array([chord * c, chord * s, 0.0])
    by_turn = np.array([forward * (bend * c - chord * s) / 2, forward * (bend * s + chord * c) / 2, 1.0])
    return arc(forward, turn), by_forward, by_turn


def document_step(left: float, right: float, distance: float) -> tuple[Pose2, Float64s]:
    """Motion by the X80SV document: d_theta = atan2(d_right - d_left, wheelDistance), along the previous heading.

    Arguments and result as `exact_step`.
    """
    forward, turn = (left + right) / 2, atan2(right - left, distance)
    by_forward = np.array([1.0, 0.0, 0.0])
    by_turn = np.array([0.0, 0.0, distance / (distance**2 + (right - left) ** 2)])
    return Pose2(forward, 0.0, turn), _wheel_jacobian(by_forward, by_turn)


INTEGRATIONS = {"exact": exact_step, "document": document_step}


def _wheel_jacobian(by_forward: Float64s, by_turn: Float64s) -> Float64s:
    """(3, 2) derivatives by the travel of each wheel, from those by mean travel and by the difference of both."""
    return np.column_stack((by_forward / 2 - by_turn, by_forward / 2 + by_turn))


def propagated_covariance(
    covariance: Float64s,
    heading: float,
    motion: Pose2,
    jacobian: Float64s,
    variances: tuple[float, float],
) -> Float64s:
    """Covariance (3, 3) of x, y (m) and yaw (rad) in `odom` after a motion that began at `heading` (rad).

    motion: m, rad.  jacobian: (3, 2) its derivatives by two independent quantities.  variances: of these.
    The quantities are the travel of each wheel (m), or the mean travel (m) and the gyro's turn (rad).
    Siegwart, Nourbakhsh, Scaramuzza 2011, equations 5.8 to 5.11; with the exact arc where they take the mean heading.
    """
    c, s = cos(heading), sin(heading)
    dx, dy = c * motion.x - s * motion.y, s * motion.x + c * motion.y
    pose_jacobian = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    motion_jacobian = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ jacobian
    noise = np.diag(variances)
    after = pose_jacobian @ covariance @ pose_jacobian.T + motion_jacobian @ noise @ motion_jacobian.T
    return np.asarray((after + after.T) / 2)
