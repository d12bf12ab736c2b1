# SPDX-License-Identifier: Apache-2.0
"""Teleoperation from the app: the common teleop arbitration, for calls from several threads."""

import threading

from shared.teleop_arbiter import TeleopArbiter, TeleopRefusedError
from zenav.foxglove.inbound import InvalidMessageError

COMMAND_HOLD_S = 0.5
"""s that a command counts without the next one: the Teleop panel must send more than twice a second."""


class Commander:
    """TeleopArbiter under a lock: the server's threads call it, and the loop that publishes. Times are s, monotonic."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._arbiter = TeleopArbiter(COMMAND_HOLD_S)

    def request(self, client: int, v: float, w: float, at: float) -> None:
        """A client commands v (m/s) and w (rad/s). Raises InvalidMessageError while another one drives."""
        with self._lock:
            try:
                self._arbiter.request(client, f"client {client}", v, w, at)
            except TeleopRefusedError as error:
                raise InvalidMessageError(str(error)) from None

    def remove_client(self, client: int, at: float) -> None:
        """A client has left, or ended its channel: the robot stands."""
        with self._lock:
            self._arbiter.remove_client(client, at)

    def on_other_command(self, at: float) -> None:
        """A command of another tool went over the wire: it has the robot."""
        with self._lock:
            self._arbiter.on_other_command(at)

    def command(self, at: float) -> tuple[float, float] | None:
        """The velocity (m/s, rad/s) to publish at `at`; None: nothing."""
        with self._lock:
            return self._arbiter.command(at)

    @property
    def driver(self) -> int | None:
        """The client that drives."""
        driver = self._arbiter.driver
        return driver.client if driver is not None else None
