# SPDX-License-Identifier: Apache-2.0
"""The motion model: limits of velocity and acceleration, exact arcs, delay of actuation.

Arcs are those of the velocity motion model without its noise (Thrun et al., "Probabilistic Robotics", 2005, section
5.3). The steps of speed within the drive's limits are our own.
"""

from math import cos, inf, sin
from typing import NamedTuple

from numba import njit

from shared.config import Drive
from shared.geometry import Pose2, wrapped
from shared.types import Float32s, Float64s

DT = 0.05  # s a step of a rollout: the tick of 20 Hz
MAX_STEP_NS = 20_000_000  # ns: accelerations are predicted this finely


class Limits(NamedTuple):
    """Limits of the drive: m/s, rad/s, m/s^2, rad/s^2, 1/m. `v_min` is not positive.

    `curvature`: of the tightest arc, inf without a limit. `spins`: it may turn in place.
    """

    v_min: float
    v_max: float
    w_max: float
    acceleration: float
    braking: float
    turn_acceleration: float
    curvature: float = inf
    spins: bool = True


class Motion(NamedTuple):
    """A pose in `odom` and the robot's twist there, m/s and rad/s."""

    pose: Pose2
    v: float
    w: float


class SentCommand(NamedTuple):
    """A velocity command (m/s, rad/s) and when it was sent, ns."""

    sent: int
    v: float
    w: float


def limits_of(drive: Drive, max_speed: float, max_reverse_speed: float) -> Limits:
    """The drive's limits, with the configured speeds (m/s) where these are lower.

    A robot with a turning radius brakes no harder than its turn rate can follow.
    """
    radius = drive.min_turning_radius
    return Limits(
        v_min=-min(drive.max_reverse_speed, max_reverse_speed),
        v_max=min(drive.max_speed, max_speed),
        w_max=drive.max_turn_rate,
        acceleration=drive.max_acceleration,
        braking=min(drive.max_braking, drive.max_turn_acceleration * radius) if radius else drive.max_braking,
        turn_acceleration=drive.max_turn_acceleration,
        curvature=1.0 / radius if radius else inf,
        spins=drive.turns_in_place,
    )


@njit(cache=True, nogil=True, inline="always")
def speed_after(v: float, target: float, limits: Limits, dt: float) -> float:
    """The forward speed, m/s, `dt` s after v, on the way to `target`. It needs at least one step to pass zero."""
    target = min(max(target, limits.v_min), limits.v_max)
    least = max(v - limits.braking * dt, 0.0) if v > 0.0 else v - limits.acceleration * dt
    most = min(v + limits.braking * dt, 0.0) if v < 0.0 else v + limits.acceleration * dt
    return min(max(target, least), most)


@njit(cache=True, nogil=True, inline="always")
def turn_rate_after(w: float, target: float, limits: Limits, dt: float) -> float:
    """The turn rate, rad/s, `dt` s after w, on the way to `target`."""
    target = min(max(target, -limits.w_max), limits.w_max)
    change = limits.turn_acceleration * dt
    return min(max(target, w - change), w + change)


@njit(cache=True, nogil=True, inline="always")
def limited_turn_rate(v: float, w: float, limits: Limits) -> float:
    """The turn rate, rad/s, nearest to w on an arc that the drive may drive at a speed of v m/s."""
    if limits.curvature == inf:
        return w
    most = abs(v) * limits.curvature
    return min(max(w, -most), most)


@njit(cache=True, nogil=True, inline="always")
def arc_step(v: float, w: float, dt: float) -> tuple[float, float, float, float]:
    """Motion at v m/s and w rad/s for dt s: chord (m), its direction's cosine and sine, and half the turn (rad).

    The chord points half the turn away from the first heading; the last heading is as far again.
    """
    half = 0.5 * w * dt
    if abs(half) < 0.3:  # series to the 8th power: under 1e-11, a third of the time of sin and cos
        q = half * half
        sinc = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0))
        cosine = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0)))
        return v * dt * sinc, cosine, half * sinc, half
    return v * dt * sin(half) / half, cos(half), sin(half), half


@njit(cache=True, nogil=True)
def fill_rollout(
    target_v: float, target_w: float, v: float, w: float, limits: Limits, velocities: Float64s | Float32s
) -> None:
    """Fills velocities (steps, 2), m/s and rad/s, with those of the drive from (v, w) on, towards the target.

    target_v, v: m/s. target_w, w: rad/s.
    """
    for t in range(len(velocities)):
        v, w = speed_after(v, target_v, limits, DT), turn_rate_after(w, target_w, limits, DT)
        w = limited_turn_rate(v, w, limits)
        velocities[t, 0], velocities[t, 1] = v, w


def predicted_motion(
    motion: Motion, limits: Limits, commands: list[SentCommand], since: int, until: int, delay: int
) -> Motion:
    """The motion at `until` (ns) from that at `since`, when the commands sent act `delay` ns later.

    commands: oldest first. Before the first known one acts the robot keeps its twist.
    """
    x, y, yaw = motion.pose.x, motion.pose.y, motion.pose.yaw
    v, w = motion.v, motion.w
    changes = [c for c in commands if c.sent + delay < until]
    n_before = sum(c.sent + delay <= since for c in changes)
    active = changes[n_before - 1] if n_before else None
    at = since
    for following in (*changes[n_before:], None):
        end = until if following is None else following.sent + delay
        while at < end:
            step = min(end - at, MAX_STEP_NS)
            dt = step / 1e9
            if active is not None:
                v, w = speed_after(v, active.v, limits, dt), turn_rate_after(w, active.w, limits, dt)
            chord, cosine, sine, half = arc_step(v, w, dt)
            c, s = cos(yaw), sin(yaw)
            x, y, yaw = x + chord * (c * cosine - s * sine), y + chord * (s * cosine + c * sine), yaw + 2 * half
            at += step
        active = following
    return Motion(Pose2(x, y, wrapped(yaw)), v, w)
