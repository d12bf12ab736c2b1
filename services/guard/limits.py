# SPDX-License-Identifier: Apache-2.0
"""Acceleration limits of the velocity, for m/s and rad/s.

As in Nav2's velocity smoother, with its `scale_velocities` only from standstill.
"""

from shared.config import Drive


def ramped_velocity(
    before: tuple[float, float], wanted: tuple[float, float], elapsed: float, drive: Drive
) -> tuple[float, float]:
    """The velocity (m/s, rad/s) `elapsed` s after `before`, on the way to `wanted`, within the drive's accelerations.

    From standstill it keeps the wanted arc, so that the start follows the path that the field tested.
    """
    if before == (0.0, 0.0):
        grown = abs(wanted[0]) / drive.max_acceleration, abs(wanted[1]) / drive.max_turn_acceleration
        share = min(1.0, elapsed / max(grown)) if max(grown) > 0 else 1.0
        return wanted[0] * share, wanted[1] * share
    v = _ramped_axis(before[0], wanted[0], elapsed, drive.max_acceleration, drive.max_braking)
    w = _ramped_axis(before[1], wanted[1], elapsed, drive.max_turn_acceleration, drive.max_turn_acceleration)
    return v, w


def _ramped_axis(now: float, wanted: float, elapsed: float, acceleration: float, braking: float) -> float:
    """One axis: braking while the speed falls, acceleration while it rises. A reversal passes zero."""
    if now < 0 or (now == 0 and wanted < 0):
        return -_ramped_axis(-now, -wanted, elapsed, acceleration, braking)
    if wanted >= now:
        return min(wanted, now + acceleration * elapsed)
    standing = now / braking  # s until it stands
    if wanted >= 0 or elapsed <= standing:
        return max(wanted, now - braking * elapsed)
    return max(wanted, -acceleration * (elapsed - standing))
