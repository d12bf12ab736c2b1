# SPDX-License-Identifier: Apache-2.0
"""A base that controls its own speed and does its own odometry: its motion as epochs, and as angles of two wheels."""

from dataclasses import replace

from services.base_driver.encoders import EncoderConfig
from services.base_driver.kinematics import wheel_speeds
from shared.config import Drive
from shared.messages import BaseOdometry

JITTER_S = 0.02  # s, one period of the reports: a base that stamps on arrival


class VelocityBase:
    """Integrates the motion to wheel angles `left`, `right` (rad), by which stuck and lagging wheels are judged.

    A step beyond the drive's maximum speed is a jump, of a restarted base. `n_jumps` counts it, and a new epoch begins.
    So does one when the base's own epoch changes.
    """

    def __init__(self, config: EncoderConfig, drive: Drive) -> None:
        self.config, self.drive = config, drive
        self.epoch: int | None = None
        self.left = self.right = 0.0
        self.n_jumps = 0
        self._last: BaseOdometry | None = None

    def restart(self) -> None:
        """Begins a new epoch with the next report."""
        self.epoch, self.left, self.right, self._last = None, 0.0, 0.0, None

    def update(self, report: BaseOdometry, now: int) -> BaseOdometry:
        """The report with the driver's epoch, ns. now: ns."""
        last, epoch = self._last, self.epoch
        if epoch is None or last is None or last.epoch != report.epoch or not self._add_step(last, report):
            epoch = now if epoch is None else max(now, epoch + 1)
        self._last, self.epoch = report, epoch
        return replace(report, epoch=epoch)

    def _add_step(self, before: BaseOdometry, after: BaseOdometry) -> bool:
        """Adds the motion between two reports; False where no base can move so."""
        elapsed = min((after.stamp - before.stamp) * 1e-9, self.config.longest_step)
        if after.has_pose:
            step = before.odom_from_base.inverse() @ after.odom_from_base
            forward, turn = step.x, step.yaw
            distance = before.odom_from_base.distance(after.odom_from_base)
        else:
            forward, turn = after.v * elapsed, after.w * elapsed
            distance = abs(forward)
        limit = self.config.speed_margin * (elapsed + JITTER_S)
        if distance > limit * self.drive.max_speed or abs(turn) > limit * self.drive.max_turn_rate:
            self.n_jumps += 1
            return False
        left, right = wheel_speeds(forward, turn, self.drive)
        self.left += left
        self.right += right
        return True
