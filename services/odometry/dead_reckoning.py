# SPDX-License-Identifier: Apache-2.0
"""Where did the wheels carry the robot? Pose increments and their uncertainty from what each wheel rolled.

left, right: m rolled by each wheel since the last step, positive forward.
"""

from math import atan2, cos, sin
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shared.config import Section
from shared.geometry import Pose2, arc

Float64s = NDArray[np.float64]


class OdometryConfig(Section):
    """Dead reckoning from the wheels."""

    integration: Literal["exact", "document"] = Field(
        "exact", description="exact: a circular arc; document: atan2 and the old heading, as the X80SV's own driver"
    )
    wheel_variance: float = Field(
        2e-5, ge=0, le=1, description="m^2 of variance for each m that a wheel rolls: slip, radius, floor"
    )


def exact(left: float, right: float, distance: float) -> tuple[Pose2, Float64s]:
    """Motion along the circular arc that both wheels rolled, and its Jacobian.

    distance: m between the wheels.  Returns `before_from_after` and (3, 2) d(x, y, yaw) / d(left, right).
    """
    forward, turn = (left + right) / 2, (right - left) / distance
    half = turn / 2
    if abs(half) > 1e-4:
        chord = sin(half) / half
        bend = (cos(half) - chord) / half
    else:
        chord, bend = 1 - half * half / 6, -half / 3
    c, s = cos(half), sin(half)
    along = np.array([chord * c, chord * s, 0.0])
    turning = np.array([forward * (bend * c - chord * s) / 2, forward * (bend * s + chord * c) / 2, 1.0])
    return arc(forward, turn), _by_wheel(along, turning / distance)


def document(left: float, right: float, distance: float) -> tuple[Pose2, Float64s]:
    """The X80SV document's step: d_theta = atan2(d_right - d_left, wheelDistance), position along the old heading.

    Arguments and result as `exact`.
    """
    forward, turn = (left + right) / 2, atan2(right - left, distance)
    along = np.array([1.0, 0.0, 0.0])
    turning = np.array([0.0, 0.0, distance / (distance**2 + (right - left) ** 2)])
    return Pose2(forward, 0.0, turn), _by_wheel(along, turning)


INTEGRATIONS = {"exact": exact, "document": document}


def _by_wheel(along: Float64s, turning: Float64s) -> Float64s:
    """(3, 2) by wheel, of derivatives by mean travel and by the wheels' difference."""
    return np.column_stack((along / 2 - turning, along / 2 + turning))


def grown(
    covariance: Float64s,
    heading: float,
    motion: Pose2,
    jacobian: Float64s,
    rolled: tuple[float, float],
    variance: float,
) -> Float64s:
    """The pose's covariance (3, 3) after a motion that began at `heading` (rad), seen in the odometry frame.

    Each wheel's travel errs independently, with `variance` m^2 for each m rolled.
    Siegwart, Nourbakhsh, Scaramuzza 2011, equations 5.8 to 5.11.
    """
    c, s = cos(heading), sin(heading)
    dx, dy = c * motion.x - s * motion.y, s * motion.x + c * motion.y
    carry = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    add = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ jacobian
    noise = np.diag([variance * abs(rolled[0]), variance * abs(rolled[1])])
    after = carry @ covariance @ carry.T + add @ noise @ add.T
    return np.asarray((after + after.T) / 2)
