# SPDX-License-Identifier: Apache-2.0
"""Who drives by hand from the app, and for how long: one at a time, and only while it keeps sending."""

import threading

from zenav.foxglove.inbound import InvalidMessageError

COMMAND_HOLD_S = (
    0.5  # s that a command counts without the next one: the Teleop panel must send more than twice a second
)
STANDS = 0.5  # s of zero after it ends, before the navigator may drive again


class TeleopArbiter:
    """Times are s on a clock that only goes on. Called from the server's threads and from the loop that publishes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._driver: int | None = None
        self._velocity = (0.0, 0.0)
        self._heard = self._ended = self._other = float("-inf")

    def request(self, client: int, v: float, w: float, at: float) -> None:
        """A client wants v m/s and w rad/s at `at`. Raises RefusedError while somebody else drives."""
        with self._lock:
            self._expire(at)
            if self._driver not in (None, client):
                raise InvalidMessageError("another client drives: it must let go first")
            if at - self._other < COMMAND_HOLD_S:
                raise InvalidMessageError("somebody drives from elsewhere, perhaps with zenav teleop: end that first")
            self._driver, self._velocity, self._heard = client, (v, w), at

    def remove_client(self, client: int, at: float) -> None:
        """A client has left, or ended its channel: the robot stands."""
        with self._lock:
            if client == self._driver:
                self._driver, self._ended = None, at

    def on_other_command(self, at: float) -> None:
        """A command of another tool went over the wire: it has the robot, at once and without a word from here.

        The guard takes one publisher at a time, and a second one only after the first fell silent.
        """
        with self._lock:
            self._other = at
            self._driver, self._ended = None, float("-inf")

    def command(self, at: float) -> tuple[float, float] | None:
        """What to publish now; zero for a while after the end, then None: nothing, so that others may drive."""
        with self._lock:
            self._expire(at)
            if self._driver is not None:
                return self._velocity
            return (0.0, 0.0) if at - self._ended < STANDS else None

    @property
    def driver(self) -> int | None:
        return self._driver

    def _expire(self, at: float) -> None:
        if self._driver is not None and at - self._heard > COMMAND_HOLD_S:
            self._driver, self._ended = None, at
