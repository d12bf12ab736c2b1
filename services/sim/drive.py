# SPDX-License-Identifier: Apache-2.0
"""From motor commands to motion: motor lag, acceleration limits, slip, systematic errors, encoders, battery."""

from math import cos, exp, floor, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from pydantic import Field

from shared.config import Drive, Section
from shared.types import Float32s, Float64s

CURVE = 0.0538  # how fast the widening falls with the straightness of the path: Wang et al. 2015


class DriveTruth(Section):
    """Differences of the true drive from `robot.drive`, which all other services use."""

    motor_lag: float = Field(0.08, ge=0, le=2, description="s, time constant of a wheel's speed")
    wheel_acceleration: float = Field(2.0, gt=0, le=50, description="m/s^2 at the rim that motor and floor can give")
    radius_error: float = Field(
        0.005, ge=-0.2, le=0.2, description="share by which the right wheel is larger than the left"
    )
    size_error: float = Field(0.0, ge=-0.2, le=0.2, description="share by which both wheels are larger")
    distance_error: float = Field(0.01, ge=-0.2, le=0.2, description="share by which the wheel distance is larger")
    turn_slip: float = Field(
        0.0,
        ge=0,
        le=1,
        description="widening of the wheel distance by skid steering in a turn on the spot",
    )
    slip: float = Field(0.02, ge=0, le=0.5, description="standard deviation of the share of its way that a wheel slips")
    slip_time: float = Field(0.2, gt=0, le=10, description="s over which the slip stays alike")
    command_life: float | None = Field(
        None, gt=0, le=60, description="s after which the board drops a command; none: it stands until the next"
    )


class Battery(Section):
    """A battery and what drains it."""

    full: float = Field(13.2, gt=0, le=60, description="V when full and idle")
    empty: float = Field(10.8, gt=0, le=60, description="V when empty and idle")
    capacity: float = Field(3.7, gt=0, le=1000, description="Ah")
    resistance: float = Field(0.08, ge=0, le=5, description="ohm inside")
    idle_current: float = Field(0.9, ge=0, le=50, description="A of computers and sensors")


class Wheels(NamedTuple):
    """The true drive in numbers: radii and distance m, lag s, limit rad/s^2, slip and how much of it a step keeps.

    distance: in a turn on the spot.  turn_slip: the share of widening in that; in a curve there is less.
    """

    left_radius: float
    right_radius: float
    distance: float
    turn_slip: float
    lag: float
    limit: float
    slip: float
    slip_memory: float


def true_wheels(drive: Drive, truth: DriveTruth, dt: float) -> Wheels:
    """The wheels as they are; `dt` is the step of the physics, s."""
    radius = drive.wheel_radius * (1 + truth.size_error)
    return Wheels(
        left_radius=radius * (1 - truth.radius_error / 2),
        right_radius=radius * (1 + truth.radius_error / 2),
        distance=drive.wheel_distance * (1 + truth.distance_error),
        turn_slip=truth.turn_slip,
        lag=truth.motor_lag,
        limit=truth.wheel_acceleration / drive.wheel_radius,
        slip=truth.slip,
        slip_memory=exp(-dt / truth.slip_time),
    )


@njit(cache=True, nogil=True)
def wheel_speed(speed: float, target: float, lag: float, limit: float, dt: float) -> float:
    """A wheel's speed after `dt` s, rad/s: first order towards the target, no faster than `limit` rad/s^2."""
    change = (target - speed) * (1.0 - exp(-dt / lag) if lag > 0.0 else 1.0)
    return speed + min(max(change, -limit * dt), limit * dt)


@njit(cache=True, nogil=True)
def next_slip(slip: float, draw: float, wheels: Wheels) -> float:
    """The slip share a step later: an Ornstein-Uhlenbeck process with standard deviation `wheels.slip`."""
    return wheels.slip_memory * slip + sqrt(1.0 - wheels.slip_memory * wheels.slip_memory) * wheels.slip * draw


@njit(cache=True, nogil=True)
def acting_distance(left: float, right: float, wheels: Wheels) -> float:
    """The wheel distance that acts, m, while the wheels roll `left` and `right` m: skid steering's depends on the path.

    Each side turns about a centre beyond its wheels. The distance of these centres is that of the wheels times
    1 + a / (1 + b sqrt|l|), with l = (right + left) / (right - left), 0 in a turn on the spot (Wang et al., Sensors
    15(5):9681, 2015, on a Pioneer 3-AT; a is `turn_slip`).  `wheels.distance` is the one in a turn on the spot.
    """
    if left == right or wheels.turn_slip == 0.0:
        return wheels.distance
    straightness = sqrt(abs((right + left) / (right - left)))
    return wheels.distance * (1.0 + wheels.turn_slip / (1.0 + CURVE * straightness)) / (1.0 + wheels.turn_slip)


@njit(cache=True, nogil=True)
def arc_pose(x: float, y: float, yaw: float, forward: float, turn: float) -> tuple[float, float, float]:
    """The pose after an arc of length `forward` m that turns by `turn` rad; yaw is not wrapped."""
    half = turn / 2.0
    chord = forward * (sin(half) / half if abs(half) > 1e-9 else 1.0)
    return x + chord * cos(yaw + half), y + chord * sin(yaw + half), yaw + turn


def wheel_targets(left: float, right: float, drive: Drive) -> tuple[float, float]:
    """The board's counts/s as wheel speeds, rad/s, forward positive: the document's leftCmd and rightCmd inverted."""
    scale = drive.motor_direction * 2 * pi / drive.counts_per_turn
    return -left * scale, right * scale


def encoder_counts(angle: float, first: int, drive: Drive) -> int:
    """The wrapped counter of an encoder that has turned by `angle` rad since it stood at `first`."""
    return (first + floor(angle * drive.counts_per_turn / (2 * pi))) % drive.encoder_wrap


def motor_currents(speeds: Float64s, targets: Float64s, limit: float, stuck: bool) -> Float32s:
    """(2,) A: friction with speed, torque with what is still missing to the target, more where something blocks.

    speeds, targets: (2,) rad/s.  limit: rad/s^2, the acceleration that takes full torque.
    """
    torque = np.minimum(np.abs(targets - speeds) / (0.1 * limit), 1.0)
    pushing = stuck * (np.abs(targets) > 0.1)
    turning = np.abs(speeds) > 0.01
    return (0.12 * turning + 0.04 * np.abs(speeds) + 0.8 * torque + 1.5 * pushing).astype(np.float32)


def battery_voltage(battery: Battery, used: float, current: float) -> float:
    """V at the terminals after `used` Ah while `current` A flow."""
    left = max(0.0, 1.0 - used / battery.capacity)
    return max(0.0, battery.empty + (battery.full - battery.empty) * left - battery.resistance * current)
