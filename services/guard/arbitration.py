# SPDX-License-Identifier: Apache-2.0
"""Whose command counts? Teleop before nav, young before old, and after a released STOP only who asked for zero."""

from pydantic import Field

from shared.config import Section
from shared.messages import Velocity
from shared.stamps import FUTURE, fresh, supersedes


class ArbitrationConfig(Section):
    """Command sources."""

    command_age: float = Field(0.2, gt=0, le=0.3, description="s after its stamp that a command ends")
    teleop_hold: float = Field(0.5, ge=0, le=10, description="s after its last command that teleop keeps nav out")
    silence: float = Field(0.5, gt=0, le=10, description="s without commands after which a stream counts as new")


class Source:
    """One stream of commands. A stream that ran while STOP was released counts again after a zero or a silence."""

    def __init__(self, name: str, config: ArbitrationConfig) -> None:
        self.name = name
        self.config = config
        self.command: Velocity | None = None
        self.armed = True
        self._quiet_since = 0
        self._began = 0  # ns from when on the command ages: its stamp, or when it came if that was ahead

    def take(self, command: Velocity, now: int) -> bool:
        """Takes a command that is newer than the last and young; False where it is neither."""
        last = None if self.command is None else self.command.stamp
        if not supersedes(command.stamp, last, now) or not fresh(command.stamp, now, self.config.command_age):
            return False
        if self._quiet_since > now + FUTURE:
            self._quiet_since = now  # the clock was set back
        if self.wants_zero(command) or command.stamp - self._quiet_since >= round(self.config.silence * 1e9):
            self.armed = True
        self._quiet_since = command.stamp
        self.command, self._began = command, min(command.stamp, now)
        return True

    def disarm(self, now: int) -> None:
        """STOP was released: the stream must ask for zero, or pause, before it moves the robot again."""
        self.armed = False
        self._quiet_since = max(now, self._quiet_since)

    def younger_than(self, age: float, now: int) -> bool:
        """Whether the stream's last command is at most `age` s old."""
        return self.command is not None and fresh(self._began, now, age)

    @staticmethod
    def wants_zero(command: Velocity) -> bool:
        return command.v == 0 and command.w == 0

    @property
    def moving(self) -> bool:
        """Whether the last command asked for motion."""
        return self.command is not None and not self.wants_zero(self.command)


def in_charge(teleop: Source, nav: Source, now: int) -> Source:
    """The source whose command counts: teleop until it has been silent for `teleop_hold`, else nav."""
    return teleop if teleop.younger_than(teleop.config.teleop_hold, now) else nav
