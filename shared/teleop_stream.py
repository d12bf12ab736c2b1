# SPDX-License-Identifier: Apache-2.0
"""Teleoperation by the clients of one service: the velocity to publish, and when. Times: ns on the stack's clock."""

from shared.messages import Velocity
from shared.teleop_arbiter import TeleopArbiter
from shared.types import NS_PER_S

MIN_INTERVAL_NS = 40_000_000
"""between two commands: a client sends 20 a second, and a burst is one command."""


class TeleopStream:
    """Teleop arbitration among clients, with their commands as messages. hold: s for which a command counts.

    A message carries the time of its command. So the guard, too, ends it some time after the command.
    """

    def __init__(self, hold: float) -> None:
        self.arbiter = TeleopArbiter(hold)
        self._commanded_at = 0
        self._published_at = 0
        self._is_unsent = False

    def take(self, client: int, name: str, v: float, w: float, now: int) -> Velocity | None:
        """A command in m/s and rad/s. Returns the message to publish at once, if any. Raises TeleopRefusedError."""
        self.arbiter.request(client, name, v, w, now / NS_PER_S)
        self._commanded_at, self._is_unsent = now, True
        return self._command(now) if not 0 <= now - self._published_at < MIN_INTERVAL_NS else None

    def let_go(self, client: int, now: int) -> Velocity | None:
        """A client lets go, or is gone. Returns zero if it drove."""
        driver = self.arbiter.driver
        if driver is None or driver.client != client:
            return None
        self.arbiter.remove_client(client, now / NS_PER_S)
        return self._zero(now)

    def tick(self, now: int) -> Velocity | None:
        """The command that is due: a new one of the driver, zero after the end of a drive, or nothing."""
        command = self.arbiter.command(now / NS_PER_S)
        if command is None:
            return None
        if self.arbiter.driver is None:
            return self._zero(now)
        return self._command(now) if self._is_unsent else None

    def on_other_command(self, now: int) -> None:
        """Another tool drives: it has the robot."""
        self.arbiter.on_other_command(now / NS_PER_S)

    def is_driven_elsewhere(self, now: int) -> bool:
        """Whether another tool drives."""
        return self.arbiter.is_driven_elsewhere(now / NS_PER_S)

    def _command(self, now: int) -> Velocity | None:
        command = self.arbiter.command(now / NS_PER_S)
        if command is None:
            return None
        self._published_at, self._is_unsent = now, False
        return Velocity(min(self._commanded_at, now), *command, reason="")

    def _zero(self, now: int) -> Velocity:
        self._published_at, self._is_unsent = now, False
        return Velocity(now, 0.0, 0.0, "")
