# SPDX-License-Identifier: Apache-2.0
"""Wheel angles since the driver's start: wrapping encoder counters in, unwrapped angles out."""

from typing import Protocol

from pydantic import Field

from services.base_driver.kinematics import count_difference, max_wheel_speed, wheel_angles
from shared.config import Drive, Section
from shared.messages import BoardReport, WheelState

RESTART_M = 0.05  # m of a rim; counters that are closer to 0 after a pause began there again
MAX_ANGLE_RAD = 900_000.0  # rad; below WheelState's bound of 1e6; then a new epoch begins (77 km of an X80SV)


class WheelAngles(Protocol):
    """rad that both wheels have turned in this epoch (ns), and the number of jumps so far."""

    epoch: int | None
    left: float
    right: float
    n_jumps: int


class EncoderConfig(Section):
    """Maximum step of a counter; a larger one is a jump, not motion."""

    speed_margin: float = Field(
        2.0, ge=1, le=10, description="maximum speed of a step, as a multiple of the wheels' maximum speed"
    )
    longest_step: float = Field(0.5, gt=0, le=10, description="maximum duration, s, of motion between two reports")


class Encoders:
    """Integrates the counters of successive reports to wheel angles `left`, `right` (rad).

    A step beyond the wheels' maximum speed is a jump, of a restarted board or a broken counter. So is a step back to
    about 0 over a pause longer than `longest_step`. `n_jumps` counts it, the angles stay, and counting continues from
    the new reading. A step of half the counter's range is ambiguous.
    """

    def __init__(self, config: EncoderConfig, drive: Drive) -> None:
        self.config, self.drive = config, drive
        self.epoch: int | None = None
        self.left = self.right = 0.0
        self.n_jumps = 0
        self._last: BoardReport | None = None

    def restart(self) -> None:
        """Begins a new epoch with the next report."""
        self.epoch, self.left, self.right, self._last = None, 0.0, 0.0, None

    def update(self, report: BoardReport, now: int) -> list[WheelState]:
        """Wheel state after a report that is newer than the last one; two states when a new epoch begins. now: ns."""
        if self.epoch is None:
            self.epoch = now
        if self._last is not None:
            self._add_step(self._last, report)
        self._last = report
        states = [self._state(self.epoch, report)]
        if max(abs(self.left), abs(self.right)) > MAX_ANGLE_RAD:
            self.epoch, self.left, self.right = max(now, self.epoch + 1), 0.0, 0.0
            states.append(self._state(self.epoch, report))
        return states

    def _add_step(self, before: BoardReport, after: BoardReport) -> None:
        left = count_difference(before.left_counts, after.left_counts, self.drive.encoder_wrap)
        right = count_difference(before.right_counts, after.right_counts, self.drive.encoder_wrap)
        left_angle, right_angle = wheel_angles(left, right, self.drive)
        pause = (after.stamp - before.stamp) * 1e-9
        elapsed = min(pause, self.config.longest_step)
        # a board that stamps on arrival shows one report period of jitter
        max_angle = self.config.speed_margin * max_wheel_speed(self.drive) * (elapsed + 0.02)
        is_restart = pause > elapsed and self._is_at_zero(after) and not self._is_at_zero(before)
        if is_restart or max(abs(left_angle), abs(right_angle)) > max_angle:
            self.n_jumps += 1
            return
        self.left += left_angle
        self.right += right_angle

    def _is_at_zero(self, report: BoardReport) -> bool:
        """Whether both counters are about 0, as after the board's start."""
        wrap = self.drive.encoder_wrap
        counts = count_difference(0, report.left_counts, wrap), count_difference(0, report.right_counts, wrap)
        left, right = wheel_angles(*counts, self.drive)
        return max(abs(left) * self.drive.left_radius, abs(right) * self.drive.right_radius) < RESTART_M

    def _state(self, epoch: int, report: BoardReport) -> WheelState:
        left_speed, right_speed = wheel_angles(report.left_speed, report.right_speed, self.drive)
        return WheelState(
            stamp=report.stamp,
            epoch=epoch,
            left=self.left,
            right=self.right,
            left_speed=_clamp_speed(left_speed),
            right_speed=_clamp_speed(right_speed),
        )


def _clamp_speed(speed: float) -> float:
    """A wheel speed (rad/s) limited to WheelState's bounds."""
    return min(max(speed, -1000.0), 1000.0)
