# SPDX-License-Identifier: Apache-2.0
"""Does a wheel follow its command? One that runs the other way, or falls far behind, is swapped, blocked or broken."""

from collections import deque
from math import exp, nan

from pydantic import Field

from shared.config import Section


class FollowingConfig(Section):
    """How far a wheel may fall behind what it is told."""

    commanded_over: float = Field(0.05, gt=0, le=1, description="m/s at the rim; slower commands are not judged")
    delay: float = Field(0.2, ge=0, le=2, description="s that a command may take to the motor; the X80SV's took 0.2")
    lag: float = Field(0.3, ge=0, le=5, description="s, time constant of the slowest wheel that still counts as sound")
    margin: float = Field(0.05, ge=0, le=1, description="m/s that a sound wheel may be slower than that")
    share: float = Field(0.2, ge=0, le=1, description="of the command that a sound wheel may be slower, besides")
    behind: float = Field(0.008, gt=0, le=1, description="m that a wheel may fall behind all this")
    longer_than: float = Field(0.06, ge=0, le=5, description="s that it must last")
    longest_step: float = Field(0.25, gt=0, le=5, description="s between reports over which nothing can be judged")


class FollowWatch:
    """Watches one wheel: it shall be no slower than a sluggish wheel would be under the same commands.

    Only falling behind counts: a robot that rolls downhill or is pushed by hand is not broken.
    """

    def __init__(self, config: FollowingConfig) -> None:
        self.config = config
        self.forget()

    def forget(self) -> None:
        """Begins anew: the angle has jumped."""
        self._stamp: int | None = None
        self._commands: deque[tuple[int, float]] = deque()  # ns, m/s: what may still be on its way to the motor
        self._angle = self._sluggish = self._behind = self._since = 0.0

    @property
    def behind(self) -> bool:
        """Whether the wheel is on its way to being astray."""
        return self._behind > 0

    def astray(self, stamp: int, angle: float, commanded: float, radius: float) -> float:
        """After a report: stamp (ns), the wheel's angle (rad), commanded speed (rad/s), the wheel's radius (m).

        Returns the wheel's speed at the rim, m/s and positive along the command, while it is astray; else NaN.
        """
        config = self.config
        before, self._stamp = self._stamp, stamp
        rolled, self._angle = (angle - self._angle) * radius, angle
        elapsed = (stamp - before) * 1e-9 if before is not None else 0.0
        command = commanded * radius
        if not 0 < elapsed <= config.longest_step:
            self._sluggish, self._behind, self._since = 0.0, 0.0, 0.0
            self._commands.clear()
            return nan
        self._commands.append((stamp, command))
        while len(self._commands) > 1 and (stamp - self._commands[1][0]) * 1e-9 >= config.delay:
            self._commands.popleft()
        arrived = self._commands[0][1]
        kept = exp(-elapsed / config.lag) if config.lag else 0.0
        self._sluggish = arrived + (self._sluggish - arrived) * kept
        direction = 1.0 if command > 0 else -1.0
        least = min(self._sluggish * direction, *(sent * direction for _, sent in self._commands))
        speed = rolled * direction / elapsed
        short = least - config.margin - config.share * abs(command) - speed
        if abs(command) <= config.commanded_over or short <= 0:
            self._behind = self._since = 0.0
            return nan
        self._behind += short * elapsed
        self._since += elapsed
        return speed if self._behind > config.behind and self._since >= config.longer_than else nan
