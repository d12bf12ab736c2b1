# SPDX-License-Identifier: Apache-2.0
"""Does a wheel follow its command? A wheel in the wrong direction or far behind is swapped, blocked or broken."""

from collections import deque
from math import exp, nan

from pydantic import Field

from shared.config import Section

MIN_STEP_S = 0.015  # s; a count more or less in a shorter time is a speed error that no wheel has: see the next report
RECENT_S = 0.1  # s; two wheels that a board leaves without commands do not catch up with the same report


class WheelTrackingConfig(Section):
    """How far a wheel may fall behind its command."""

    commanded_over: float = Field(0.05, gt=0, le=1, description="minimum command that is judged, m/s at the rim")
    delay: float = Field(
        0.2, ge=0, le=2, description="maximum delay of a command to the motor, s; 0.2 measured on the X80SV"
    )
    lag: float = Field(0.3, ge=0, le=5, description="maximum time constant of a healthy wheel, s")
    margin: float = Field(0.05, ge=0, le=1, description="further speed error of a healthy wheel, m/s")
    share: float = Field(
        0.2, ge=0, le=1, description="further speed error of a healthy wheel, as a share of the command"
    )
    behind: float = Field(
        0.008, gt=0, le=1, description="maximum distance that a wheel may fall behind these limits, m"
    )
    longer_than: float = Field(0.06, ge=0, le=5, description="minimum duration, s")
    longest_step: float = Field(0.25, gt=0, le=5, description="maximum time between reports that are judged, s")


class WheelTrackingMonitor:
    """Compares one wheel with a model of the slowest healthy wheel under the same commands.

    Only a slower wheel is a fault: a robot may roll downhill or be pushed.
    """

    def __init__(self, config: WheelTrackingConfig) -> None:
        self.config = config
        self.reset()

    def reset(self) -> None:
        """Restarts with the next report, after a jump of the angle."""
        self._stamp: int | None = None
        self._commands: deque[tuple[int, float]] = deque()  # ns, m/s: commands that may not have reached the motor
        self._angle = self._lagged = self._deficit_m = self._behind_for_s = 0.0
        self._behind_at: int | None = None  # ns

    @property
    def was_behind(self) -> bool:
        """Whether the wheel was behind the model within RECENT_S, though not yet at fault."""
        if self._stamp is None or self._behind_at is None:
            return False
        return (self._stamp - self._behind_at) * 1e-9 <= RECENT_S

    def update(self, stamp: int, angle: float, commanded: float, radius: float) -> float:
        """Adds a report: stamp (ns), the wheel's angle (rad), commanded speed (rad/s), the wheel's radius (m).

        Returns the speed at the rim, m/s and positive along the command, of a wheel that does not follow; else NaN.
        """
        config = self.config
        before, command = self._stamp, commanded * radius
        elapsed = (stamp - before) * 1e-9 if before is not None else 0.0
        if 0 < elapsed < MIN_STEP_S:
            self._commands.append((stamp, command))
            return nan
        self._stamp = stamp
        travel, self._angle = (angle - self._angle) * radius, angle
        if not 0 < elapsed <= config.longest_step:
            self._lagged, self._deficit_m, self._behind_for_s = 0.0, 0.0, 0.0
            self._commands.clear()
            return nan
        self._commands.append((stamp, command))
        while len(self._commands) > 1 and (stamp - self._commands[1][0]) * 1e-9 >= config.delay:
            self._commands.popleft()
        motor_command = self._commands[0][1]
        decay = exp(-elapsed / config.lag) if config.lag else 0.0
        self._lagged = motor_command + (self._lagged - motor_command) * decay
        direction = 1.0 if command > 0 else -1.0
        min_speed = min(self._lagged * direction, *(queued * direction for _, queued in self._commands))
        speed = travel * direction / elapsed
        deficit = min_speed - config.margin - config.share * abs(command) - speed
        if abs(command) <= config.commanded_over or deficit <= 0:
            self._deficit_m = self._behind_for_s = 0.0
            return nan
        self._behind_at = stamp
        self._deficit_m += deficit * elapsed
        self._behind_for_s += elapsed
        return speed if self._deficit_m > config.behind and self._behind_for_s >= config.longer_than else nan
