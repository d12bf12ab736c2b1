# SPDX-License-Identifier: Apache-2.0
"""Selects the active command source: teleop over navigation. After an e-stop release a source must first send zero.

The priority with a timeout is that of twist_mux of ROS. The first zero is our own rule for ISO 13850, by which a reset
must not start a motion.
"""

from pydantic import Field

from shared.config import Section
from shared.messages import Velocity
from shared.stamps import FUTURE, fresh, supersedes


class ArbitrationConfig(Section):
    """Command sources."""

    command_age: float = Field(0.2, gt=0, le=0.3, description="s after its stamp at which a command ends")
    teleop_hold: float = Field(
        0.5, ge=0, le=10, description="s after its last command for which teleop keeps the control"
    )
    silence: float = Field(0.5, gt=0, le=10, description="s without commands after which a source counts as new")


class CommandSource:
    """One source of commands. After an e-stop release it counts again after a zero command or a silence.

    now: ns.
    """

    def __init__(self, name: str, config: ArbitrationConfig) -> None:
        self.name = name
        self.config = config
        self.command: Velocity | None = None
        self.is_armed = True
        self._silent_since = 0
        self._valid_from = 0  # ns from which the command ages: its stamp, or its arrival where the stamp was ahead

    def accept(self, command: Velocity, now: int) -> bool:
        """Takes a command that is newer than the last one and recent. Returns whether it did."""
        last = None if self.command is None else self.command.stamp
        if not supersedes(command.stamp, last, now) or not fresh(command.stamp, now, self.config.command_age):
            return False
        if self._silent_since > now + FUTURE:
            self._silent_since = now  # the clock was set back
        if self.is_zero(command) or command.stamp - self._silent_since >= round(self.config.silence * 1e9):
            self.is_armed = True
        self._silent_since = command.stamp
        self.command, self._valid_from = command, min(command.stamp, now)
        return True

    def heard(self, command: Velocity, now: int) -> None:
        """A command came that is not used, as a late one: a source that asks for motion is not silent, and not new."""
        if not self.is_armed and not self.is_zero(command):
            self._silent_since = max(self._silent_since, now)

    def disarm(self, now: int) -> None:
        """Requires a zero command or a silence before the source moves the robot again, after an e-stop release."""
        self.is_armed = False
        self._silent_since = max(now, self._silent_since)

    def is_newer_than(self, age: float, now: int) -> bool:
        """Whether the last command is at most `age` s old."""
        return self.command is not None and fresh(self._valid_from, now, age)

    @staticmethod
    def is_zero(command: Velocity) -> bool:
        """Whether a command asks for standstill."""
        return command.v == 0 and command.w == 0

    @property
    def wants_motion(self) -> bool:
        """Whether the last command asked for motion."""
        return self.command is not None and not self.is_zero(self.command)


def active_source(teleop: CommandSource, nav: CommandSource, now: int) -> CommandSource:
    """The active source at `now` (ns): teleop until it has been silent for `teleop_hold`, else navigation."""
    return teleop if teleop.is_newer_than(teleop.config.teleop_hold, now) else nav
