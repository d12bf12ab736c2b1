# SPDX-License-Identifier: Apache-2.0
"""Where the page is: host and port of this computer, from the setting and the stack's number."""

from ipaddress import ip_address
from typing import NamedTuple
from urllib.parse import urlsplit

from shared.config import UserError
from shared.runners.transport import StackAddress

KIND = "web"
BASE_PORT = 8600
"""plus the stack's number."""
LOCAL_NAMES = ("127.0.0.1", "localhost", "::1")
"""Names by which a browser may reach the page. Another name in a request is an attack by DNS."""


class PageAddress(NamedTuple):
    """Host (an IP address) and port."""

    host: str
    port: int

    @property
    def url(self) -> str:
        """For a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"


def page_address(device: str, where: StackAddress) -> PageAddress:
    """The address of `web://HOST[:PORT]`. Raises UserError where it is none, or not this computer's own."""
    parts = urlsplit(device)
    try:
        host, port = parts.hostname or "", parts.port
    except ValueError:
        host, port = "", None
    if parts.scheme != KIND or not host or parts.path not in ("", "/"):
        raise UserError(
            f"dashboard.port.device: {device!r} is no address", "write web://127.0.0.1 or web://127.0.0.1:8600"
        )
    if not _is_loopback(host):
        hint = "write web://127.0.0.1; from another computer: ssh -L 8600:127.0.0.1:8600 ROBOT"
        raise UserError(
            f"dashboard.port.device: {device!r}: the page is served on this computer's own address only", hint
        )
    return PageAddress("127.0.0.1" if host == "localhost" else host, BASE_PORT + where.domain if port is None else port)


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
