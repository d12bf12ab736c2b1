# SPDX-License-Identifier: Apache-2.0
"""systemd's notification protocol, sd_notify(3): lines to a datagram socket that the environment names."""

import os
import socket
import time


class Notifier:
    """Reports to systemd that the stack is ready, alive or ending.

    Silent where the process was not started by it.

    The variables are taken out of the environment: a child that spoke for this process would hide its death.
    """

    def __init__(self) -> None:
        environment = os.environ  # noqa: TID251  # the protocol's own variables
        address = environment.pop("NOTIFY_SOCKET", "")
        period, pid = environment.pop("WATCHDOG_USEC", ""), environment.pop("WATCHDOG_PID", "")
        self.address = f"\0{address[1:]}" if address.startswith("@") else address  # @: an abstract socket
        is_watched = bool(self.address) and period.isdigit() and pid in ("", str(os.getpid()))
        self.period = int(period) / 1e6 if is_watched else 0.0  # s without a sign of life; 0: none is wanted
        self._last_alive = 0.0

    def ready(self) -> None:
        """Every service runs."""
        self._send("READY=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._send(f"STATUS={text}")

    def alive(self) -> None:
        """A sign of life, four times in a period at most. Call it often."""
        now = time.monotonic()
        if self.period and now - self._last_alive >= self.period / 4:
            self._last_alive = now
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The stack ends because it was asked to."""
        self._send("STOPPING=1")

    def _send(self, line: str) -> None:
        if not self.address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            try:
                out.connect(self.address)
                out.send(line.encode())
            except OSError:
                return  # systemd's watchdog counts what it did not hear
