# SPDX-License-Identifier: Apache-2.0
"""The shell of the gateway: the device `tls://HOST:PORT` behind the service's port. It keeps the gateway's process.

The process is started again when the folder of credentials changes, so a revoked member is cut off within a second or
two. A fault in it, or its load, stays out of the robot's own traffic.
"""

import threading
from collections import Counter
from datetime import UTC, date, datetime

import msgpack

from services.gateway.log_lines import LinkEvent, LinkLine
from services.gateway.router_process import END_LIMIT_S, RouterProcess
from services.gateway.service import PORT, STARTING, GatewayConfig
from shared import topics
from shared.config import UserError
from shared.credentials import tls_endpoint
from shared.messages import PortState, SerialData
from shared.runners.devices import DeviceContext
from shared.secure_folder import SecureFolder, secure_folder

LOOK_S = 1.0  # between two looks at process and folder
AGAIN_S = 5.0  # between two starts of a process that ends by itself
MAX_KINDS = 200  # of refused messages that one report distinguishes


def gateway_device(context: DeviceContext) -> "GatewayDevice":
    """The device of a configuration, not yet open. Raises UserError where its address is none."""
    return GatewayDevice(context)


class GatewayDevice:
    """See the module. Its events are messages of topics.RX."""

    def __init__(self, context: DeviceContext) -> None:
        self._context = context
        section = context.section
        assert isinstance(section, GatewayConfig)
        self.endpoint = gateway_endpoint(context.config.device)
        self._folder = secure_folder(section.folder)
        self._counts: Counter[tuple[LinkEvent, str, str]] = Counter()
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._state: tuple[bool, str] | None = None
        self._thread = threading.Thread(target=self._run, name="gateway", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def write(self, data: bytes) -> None:
        """There is nothing to write."""

    def plug(self, plugged: bool) -> None:
        """There is nothing to unplug."""

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(END_LIMIT_S + LOOK_S)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._folder.require()
                members = self._members_event(today())
            except UserError as error:
                self._publish_state(False, f"{error.what}: {error.hint}")
                self._closing.wait(AGAIN_S)
                continue
            self._publish([members])
            self._serve()

    def _serve(self) -> None:
        """Runs the process until it ends, the folder or the date changes, or the device closes."""
        version, day, where = folder_version(self._folder), today(), self._context.where
        order = {
            "stack": where.router or str(where.domain),
            "listen": self.endpoint,
            "folder": str(self._folder.path),
            "robot": self._context.robot,
        }
        self._publish_state(False, STARTING)
        process = RouterProcess(order, self._count)
        while not self._closing.wait(LOOK_S):
            if process.listening.is_set():
                self._publish_state(True, "")
            self._report()
            if failure := process.failure():
                self._publish_state(False, failure)
                self._closing.wait(AGAIN_S)
                break
            if folder_version(self._folder) != version or today() != day:
                break
        process.end()
        self._report()

    def _count(self, event: LinkLine) -> None:
        with self._lock:
            many = len(self._counts) >= MAX_KINDS
            self._counts[event.event, event.name, "other messages" if many else event.text] += 1

    def _report(self) -> None:
        with self._lock:
            counts, self._counts = self._counts, Counter()
        self._publish(
            [{"event": str(event), "name": name, "text": text, "n": n} for (event, name, text), n in counts.items()]
        )

    def _members_event(self, day: date) -> dict[str, object]:
        members = [
            {
                "name": member.name,
                "role": str(member.role),
                "common_name": member.common_name,
                "revoked": member.revoked,
                "days_left": member.days_left(day),
            }
            for member in self._folder.members()
        ]
        return {"event": "members", "members": members, "days_left": self._folder.robot_days_left(day)}

    def _publish(self, events: list[dict[str, object]]) -> None:
        if events:
            now = self._context.clock.now()
            self._context.publish(topics.RX(SerialData(now, PORT, bytes(msgpack.packb(events)))))

    def _publish_state(self, open_: bool, detail: str) -> None:
        if self._state != (open_, detail):
            self._state = open_, detail
            self._context.publish(topics.PORT(PortState(self._context.clock.now(), PORT, open_, detail)))


def gateway_endpoint(device: str) -> str:
    """Zenoh's endpoint of tls://HOST:PORT. Raises UserError where it is none."""
    return tls_endpoint(device, "gateway.port.device", "tls://0.0.0.0:7448")


def folder_version(folder: SecureFolder) -> tuple[tuple[int, int], ...]:
    """Changes with each change of the members or of the robot's certificate."""
    files = (folder.members_file, folder.robot_certificate, folder.robot_key)
    return tuple((file.stat().st_ino, file.stat().st_mtime_ns) for file in files if file.exists())


def today() -> date:
    """The date of certificates: the wall clock's, in UTC."""
    return datetime.now(UTC).date()  # noqa: TID251  # certificates end by the wall clock
