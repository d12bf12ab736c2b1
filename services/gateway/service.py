# SPDX-License-Identifier: Apache-2.0
"""The gateway to other computers: members that are connected, messages that were refused.

Its process (router.py) carries the messages.

Events of the shell come in on a port as msgpack maps (topics.RX), so the journal has them:

- `members`: the list of the folder: name, role, common_name, revoked; `days_left` of the robot's certificate;
- `joined`, `left`, `refused`, `rejected`: the events of log_lines.py with `name`, `text` and their number `n`.

Each is a line of the log that begins with "audit:". A replay shows each member and what it did.
"""

from typing import Any

import msgpack
from pydantic import Field

from shared import topics
from shared.config import Robot, Section
from shared.messages import PortState, SerialData
from shared.ports import PortConfig
from shared.rejections import RejectionCause
from shared.secure_folder import RENEWAL_DAYS
from shared.service import Log, Out, Service, on

PORT = "members"
REVOKED = "revoked"  # the role of a former member
STARTING = "starting"  # the detail of a port whose process does not listen yet


class GatewayConfig(Section):
    """The gateway."""

    port: PortConfig = Field(
        PortConfig(),
        description="tls://0.0.0.0:7448 lets members of the robot in from other computers; without a device: no member",
    )
    folder: str = Field("", description="folder of credentials; empty: ZENAV_SECURE, or `secure` in ~/.config/zenav")


class GatewayService(Service):
    """Counts and reports what happens at the gateway."""

    config_type = GatewayConfig
    config: GatewayConfig

    def __init__(self, config: GatewayConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.is_open, self.detail = False, ""
        self.roles: dict[str, str] = {}  # by common name
        self.names: dict[str, str] = {}
        self.connected: dict[str, int] = {}  # links, by common name
        self.days_left: int | None = None  # of the robot's certificate

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    def state(self) -> str:
        if not self.is_open:
            return self.detail or "closed: set gateway.port.device"
        n = sum(self.connected.values())
        text = f"{_members(n)} connected"
        if self.days_left is not None and self.days_left <= RENEWAL_DAYS:
            text += f"; the robot's certificate ends in {self.days_left} days"
        return text

    @on(topics.PORT)
    def port_state(self, state: PortState) -> Out:
        """The gateway's process listens, or cannot."""
        if state.port != PORT:
            return
        self.is_open, self.detail = state.open, state.detail
        self.connected.clear()
        if state.open:
            n = sum(role != REVOKED for role in self.roles.values())
            yield Log("INFO", f"the gateway listens, and lets {_members(n)} in")
        elif state.detail and state.detail != STARTING:
            yield Log("WARNING", f"gateway: {state.detail}")

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        """Takes events of the shell."""
        if data.port != PORT:
            return
        for event in msgpack.unpackb(data.data):
            yield from self._event(event)

    def _event(self, event: dict[str, Any]) -> Out:
        name, text, n = event.get("name", ""), event.get("text", ""), event.get("n", 1)
        match event["event"]:
            case "members":
                yield from self._take_members(event)
            case "joined":
                self.connected[name] = self.connected.get(name, 0) + n
                yield Log("INFO", f"audit: {self._shown(name)} connected from {text}")
            case "left":
                self.connected[name] = self.connected.get(name, 0) - n
                if self.connected[name] <= 0:
                    del self.connected[name]
                yield Log("INFO", f"audit: {self._shown(name)} disconnected, {text}")
            case "refused":
                self._reject(text.partition(" ")[2], f"{self._shown(name)} may not {text}", n)
                yield Log("WARNING", f"audit: refused to {self._shown(name)}: {text} ({_times(n)})")
            case "rejected":
                self._reject("connection", text, n)
                yield Log("WARNING", f"audit: rejected a connection: {text} ({_times(n)})")

    def _take_members(self, event: dict[str, Any]) -> Out:
        self.roles = {row["common_name"]: REVOKED if row["revoked"] else row["role"] for row in event["members"]}
        self.names = {row["common_name"]: row["name"] for row in event["members"]}
        self.days_left = event["days_left"]
        if self.days_left <= RENEWAL_DAYS:
            yield Log("WARNING", f"the robot's certificate ends in {self.days_left} days: zenav secure renew")
        for row in event["members"]:
            if not row["revoked"] and row["days_left"] <= RENEWAL_DAYS:
                what = f"the certificate of {row['name']} ends in {row['days_left']} days"
                yield Log("WARNING", f"{what}: zenav secure renew {row['name']}")

    def _reject(self, key: str, detail: str, n: int) -> None:
        key = key.partition("/")[2] or key  # without the robot's name
        self.rejections.count(key, RejectionCause.ACCESS, detail, n)

    def _shown(self, common_name: str) -> str:
        name = self.names.get(common_name, common_name or "an unnamed connection")
        return f"{name} ({self.roles.get(common_name, 'no member')})"


def _members(n: int) -> str:
    return f"{n} member{'' if n == 1 else 's'}"


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"
