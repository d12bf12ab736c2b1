# SPDX-License-Identifier: Apache-2.0
"""A member of the gateway beside a live run: it subscribes to `cmd/vel`, over TLS."""

import json
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from shared.config import load_robot
from shared.runners.client import Client
from shared.secure_folder import SecureFolder
from zenav.bench.gateway import (
    free_endpoint,
    gateway_settings,
    member_subscriber,
    subscriber_report,
    viewer_credentials,
)
from zenav.bench.gateway_subscriber import REALTIME
from zenav.bench.member_namespace import member_namespace
from zenav.metrics.latency import Source
from zenav.scenario.live_run import RunView
from zenav.scenario.mission import Mission


class MemberView(RunView):
    """Starts the member once the stack runs. settings: of the gateway.  command: of the member's process."""

    def __init__(self, settings: list[str], command: list[str]) -> None:
        self.settings, self._command = settings, command
        self.commands: dict[Source, int] = {}  # when the member took each `cmd/vel`, ns of the clock of the day
        self._process: subprocess.Popen[str] | None = None

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        if self._process is None:
            self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def end(self) -> None:
        if self._process is None:
            return
        with suppress(BrokenPipeError, json.JSONDecodeError):  # it reached no gateway, and wrote why
            assert self._process.stdout is not None
            self._process.stdout.readline()  # that it is ready
            report = subscriber_report(self._process)
            self.commands = {(session, sequence): taken for session, sequence, taken in report["commands"]}
        self._process.kill()
        self._process.wait()


@contextmanager
def remote_member(robot: str) -> Iterator[MemberView]:
    """As root the member is in a network namespace of its own.

    It has real-time scheduling: on a computer of its own it would not wait for the services' processors.
    """
    with tempfile.TemporaryDirectory() as folder, member_namespace() as members:
        place = SecureFolder(Path(folder) / "secure")
        viewer, address = viewer_credentials(place, robot), free_endpoint(members)
        name = load_robot(robot).robot.name
        command = member_subscriber(members, f"tls/{address}", viewer, f"{name}/cmd/vel")
        yield MemberView(gateway_settings(place, address), [*command, REALTIME])
