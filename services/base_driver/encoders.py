# SPDX-License-Identifier: Apache-2.0
"""How far has each wheel turned since the driver started? Wrapping counters in, unwrapped angles out."""

from pydantic import Field

from services.base_driver.kinematics import count_difference, max_wheel_speed, wheel_angles
from shared.config import Drive, Section
from shared.messages import BoardReport, WheelState

MAX_ANGLE_RAD = 900_000.0  # rad; before WheelState's bound of 1e6 the driver begins a new epoch (77 km of an X80SV)


class EncoderConfig(Section):
    """What a counter's step may be before it is a jump and not motion."""

    speed_margin: float = Field(2.0, ge=1, le=10, description="times the fastest wheel that a step may show")
    longest_step: float = Field(0.5, gt=0, le=10, description="s of such motion that a gap between reports may hide")


class Encoders:
    """The wheels' angles, kept from report to report.

    A step that no wheel can turn (a restarted board, a broken counter) moves nothing: the angles stay, counting goes on
    from the new reading, and `n_jumps` says so. A step of half the counter's range is ambiguous by nature.
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
        """The wheels' state after a report that is newer than the last; two where an epoch ends and the next begins."""
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
        elapsed = min((after.stamp - before.stamp) * 1e-9, self.config.longest_step)
        # a board that stamps on arrival shows one report period of jitter
        max_angle = self.config.speed_margin * max_wheel_speed(self.drive) * (elapsed + 0.02)
        if max(abs(left_angle), abs(right_angle)) > max_angle:
            self.n_jumps += 1
            return
        self.left += left_angle
        self.right += right_angle

    def _state(self, epoch: int, report: BoardReport) -> WheelState:
        left_speed, right_speed = wheel_angles(report.left_speed, report.right_speed, self.drive)
        return WheelState(
            report.stamp, epoch, self.left, self.right, _clamp_speed(left_speed), _clamp_speed(right_speed)
        )


def _clamp_speed(speed: float) -> float:
    """A wheel speed within WheelState's bounds, whatever the board says."""
    return min(max(speed, -1000.0), 1000.0)
