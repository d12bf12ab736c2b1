# SPDX-License-Identifier: Apache-2.0
"""The differential drive's equations, as the X80SV's document has them: body, wheels, encoder counts.

v, w: m/s and rad/s of the body.  left, right: rad/s of the wheels, positive when the robot drives forward.
Counts carry the board's signs: the left encoder counts down when the X80SV drives forward.
"""

from math import pi

from shared.config import Drive


def wheel_speeds(v: float, w: float, drive: Drive) -> tuple[float, float]:
    """Left and right wheel, rad/s: v_left = (2 v - w d) / (2 r), v_right = (2 v + w d) / (2 r), each by its radius."""
    turning = w * drive.wheel_distance
    return (2 * v - turning) / (2 * drive.left_radius), (2 * v + turning) / (2 * drive.right_radius)


def body_velocity(left: float, right: float, drive: Drive) -> tuple[float, float]:
    """v, w from the wheels' rad/s: the inverse of `wheel_speeds`."""
    left_rim, right_rim = drive.left_radius * left, drive.right_radius * right
    return (left_rim + right_rim) / 2, (right_rim - left_rim) / drive.wheel_distance


def board_counts(left: float, right: float, drive: Drive) -> tuple[float, float]:
    """Counts (or counts/s) with the board's signs from the wheels' rad (or rad/s).

    leftCmd = -motorDir v_left N / 2pi, rightCmd = +motorDir v_right N / 2pi.
    """
    counts_per_rad = drive.motor_direction * drive.counts_per_turn / (2 * pi)
    return -left * counts_per_rad, right * counts_per_rad


def wheel_angles(left_counts: float, right_counts: float, drive: Drive) -> tuple[float, float]:
    """Wheels' rad (or rad/s) from the board's counts (or counts/s): the inverse of `board_counts`."""
    rad_per_count = drive.motor_direction * 2 * pi / drive.counts_per_turn
    return -left_counts * rad_per_count, right_counts * rad_per_count


def count_difference(before: int, after: int, wrap: int) -> int:
    """Counts from one reading to the next, the short way round a counter that returns to 0 at `wrap`."""
    steps = (after - before) % wrap
    return steps - wrap if 2 * steps > wrap else steps


def max_wheel_speed(drive: Drive) -> float:
    """rad/s that a wheel reaches within the robot's limits."""
    smaller = min(drive.left_radius, drive.right_radius)
    return (drive.max_speed + drive.max_turn_rate * drive.wheel_distance / 2) / smaller
