# SPDX-License-Identifier: Apache-2.0
"""Teleop arbitration: one client drives at a time, while it keeps sending. The rule of the page and of Foxglove.

No thread lock and no clock: its user gives the time of each call, in s on a clock of its own.
"""

from dataclasses import dataclass

OTHER_HOLD_S = 0.5
"""s after its last command for which another tool has the robot."""
STANDING_S = 0.5
"""s of zero after a client's last command. Then the navigator, or another tool, may drive."""
NEVER = float("-inf")


class TeleopRefusedError(ValueError):
    """The client may not drive now; the text names the driver."""


@dataclass(frozen=True, slots=True)
class TeleopDriver:
    """The client that drives, and its name for other users."""

    client: int
    name: str


class TeleopArbiter:
    """Grants the robot to one client. hold: s for which a command counts without the next one.

    Where the clock was set back, the client that drives has let go.
    """

    def __init__(self, hold: float) -> None:
        self.hold = hold
        self.driver: TeleopDriver | None = None
        self._velocity = (0.0, 0.0)
        self._commanded_at = self._ended_at = self._other_at = NEVER

    def request(self, client: int, name: str, v: float, w: float, at: float) -> None:
        """A client commands v (m/s) and w (rad/s) at `at` (s). Raises TeleopRefusedError while another one drives."""
        self.expire(at)
        if self.driver is not None and self.driver.client != client:
            raise TeleopRefusedError(f"{self.driver.name} drives: it must let go first")
        if self.is_driven_elsewhere(at):
            raise TeleopRefusedError("somebody drives from elsewhere, perhaps with zenav teleop: end that first")
        self.driver = TeleopDriver(client, name)
        self._velocity, self._commanded_at = (v, w), at

    def remove_client(self, client: int, at: float) -> None:
        """A client has let go, or is gone at `at` (s): the robot stands."""
        if self.driver is not None and self.driver.client == client:
            self.driver, self._ended_at = None, at

    def on_other_command(self, at: float) -> None:
        """Another tool commanded: it has the robot at once, and nothing is published here against it.

        The guard accepts one publisher at a time, and a second one only after the first fell silent.
        """
        self._other_at = at
        self.driver, self._ended_at = None, NEVER

    def is_driven_elsewhere(self, at: float) -> bool:
        """Whether another tool drives at `at` (s)."""
        return 0 <= at - self._other_at < OTHER_HOLD_S

    def command(self, at: float) -> tuple[float, float] | None:
        """The velocity (m/s, rad/s) to publish at `at` (s): zero for a while after the end, then None.

        None lets others drive.
        """
        self.expire(at)
        if self.driver is not None:
            return self._velocity
        return (0.0, 0.0) if 0 <= at - self._ended_at < STANDING_S else None

    def expire(self, at: float) -> None:
        """Ends the drive of a client that sent nothing for `hold` s until `at` (s)."""
        if self.driver is not None and not 0 <= at - self._commanded_at <= self.hold:
            self.driver, self._ended_at = None, at
