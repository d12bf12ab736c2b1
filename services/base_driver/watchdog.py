# SPDX-License-Identifier: Apache-2.0
"""Which command moves the motors now? The last watchdog, by the age of commands, not by their arrival."""

from pydantic import Field

from shared.config import Section
from shared.messages import Velocity
from shared.stamps import FUTURE


class WatchdogConfig(Section):
    """Ages of commands."""

    command_age: float = Field(0.2, gt=0, le=0.23, description="maximum age of a command, s")
    silence: float = Field(
        0.5, gt=0, le=10, description="s without commands after which a stream of commands counts as new"
    )


class Watchdog:
    """Holds the last accepted command, valid up to an age of `command_age`.

    A command is accepted if it is newer than the last accepted one, not too old and not from the future. So a burst of
    old commands after a network outage moves nothing. After `disarm` the robot stands until a command of zero, or until
    no command came for `silence`. It follows a released stop, a repaired fault or a restored link.
    """

    def __init__(self, config: WatchdogConfig) -> None:
        self.config = config
        self.armed = True
        self.refused = ""
        self._age = round(config.command_age * 1e9)
        self._silence = round(config.silence * 1e9)
        self._last = 0  # stamp of the last accepted command
        self._quiet_since = 0
        self._began: int | None = None  # ns, start of the command's age
        self._velocity = (0.0, 0.0)

    def offer(self, command: Velocity, now: int) -> bool:
        """Accepts a command at `now` (ns) and returns True; else gives the cause in `refused`."""
        if self._quiet_since > now + FUTURE:  # the clock was set back: earlier stamps do not count
            self._last, self._quiet_since = 0, now
        if now - command.stamp > self._age:
            self.refused = f"commands are refused: {(now - command.stamp) * 1e-9:.1f} s old"
            return False
        if command.stamp - now > FUTURE:
            self.refused = f"commands are refused: {(command.stamp - now) * 1e-9:.1f} s ahead of this clock"
            return False
        if command.stamp <= self._last:
            return False
        if (command.v == 0 and command.w == 0) or command.stamp - self._quiet_since >= self._silence:
            self.armed = True
        self.refused = ""
        self._last = self._quiet_since = command.stamp
        self._began = min(command.stamp, now)
        self._velocity = (command.v, command.w)
        return True

    def disarm(self, now: int) -> None:
        """Blocks motion until a command of zero, or a pause of `silence` in the commands."""
        self.armed = False
        self._began = None
        self._quiet_since = max(self._last, now)

    def velocity(self, now: int) -> tuple[float, float]:
        """v (m/s), w (rad/s) at `now` (ns): the accepted command while it is recent, else zero."""
        if self._began is None or not self.armed or not 0 <= now - self._began <= self._age:
            return 0.0, 0.0
        return self._velocity
