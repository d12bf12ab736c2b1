# SPDX-License-Identifier: Apache-2.0
"""Teleoperation from pages: which velocity is published, and when. Times are ns on the stack's clock."""

from services.dashboard.sessions import PageSession
from shared.messages import Velocity
from shared.teleop_arbiter import TeleopArbiter
from shared.types import NS_PER_S

HOLD_S = 0.2
"""s after the last frame of a page at which the robot gets zero."""
MIN_INTERVAL_NS = 40_000_000
"""between two commands: a page sends 20 a second, and a burst of frames is one command."""


class PageDriving:
    """Teleop arbitration among pages, with their commands as messages.

    A command carries the time of its frame. So the guard, too, ends it HOLD_S after the frame.
    """

    def __init__(self) -> None:
        self.arbiter = TeleopArbiter(HOLD_S)
        self._frame_at = 0
        self._published_at = 0
        self._is_unsent = False

    def take(self, page: PageSession, v: float, w: float, n: int, now: int) -> Velocity | None:
        """A teleop frame. Returns the command to publish at once, if any. Raises TeleopRefusedError."""
        if n <= page.n:
            return None
        self.arbiter.request(page.client, page.name, v, w, now / NS_PER_S)
        page.n, self._frame_at, self._is_unsent = n, now, True
        return self._command(now) if not 0 <= now - self._published_at < MIN_INTERVAL_NS else None

    def let_go(self, client: int, now: int) -> Velocity | None:
        """A page lets go, or is gone. Returns zero if it drove."""
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
        return Velocity(min(self._frame_at, now), *command, reason="")

    def _zero(self, now: int) -> Velocity:
        self._published_at, self._is_unsent = now, False
        return Velocity(now, 0.0, 0.0, "")
