# SPDX-License-Identifier: Apache-2.0
"""Which command moves the motors now, if any? The last watchdog: on the age of commands, never on their arrival."""

from pydantic import Field

from shared.config import Section
from shared.messages import Velocity
from shared.stamps import FUTURE


class WatchdogConfig(Section):
    """When a command is too old to drive on."""

    command_age: float = Field(0.2, gt=0, le=0.23, description="s after its stamp that a command ends")
    silence: float = Field(0.5, gt=0, le=10, description="s without commands after which a stream counts as new")


class Watchdog:
    """Holds the last accepted command and lets it act for `command_age`.

    Accepted is what is newer than the last accepted one, not over-aged and not from the future: a burst of old commands
    after a healed partition moves nothing. After `disarm` (a released stop, a mended fault, a link that came back) the
    robot stands until its commander has asked for zero, or has been silent for `silence` since.
    """

    def __init__(self, config: WatchdogConfig) -> None:
        self.config = config
        self.armed = True
        self.refused = ""
        self._age = round(config.command_age * 1e9)
        self._silence = round(config.silence * 1e9)
        self._last = 0  # stamp of the last accepted command
        self._quiet_since = 0
        self._began: int | None = None  # when the command began to age
        self._velocity = (0.0, 0.0)

    def offer(self, command: Velocity, now: int) -> bool:
        """Takes a command, or refuses it and says why in `refused`."""
        if self._quiet_since > now + FUTURE:  # our clock was set back: what we accepted before it says nothing
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
        """No motion until the commander has asked for zero or been silent."""
        self.armed = False
        self._began = None
        self._quiet_since = max(self._last, now)

    def velocity(self, now: int) -> tuple[float, float]:
        """v, w that holds now: the accepted command while it is young, else zero."""
        if self._began is None or not self.armed or not 0 <= now - self._began <= self._age:
            return 0.0, 0.0
        return self._velocity
