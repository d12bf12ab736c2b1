# SPDX-License-Identifier: Apache-2.0
"""Where the page is: host, port and certificate, from the settings and the stack's number."""

from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from services.dashboard.certificate import PageCertificate, read_certificate
from services.dashboard.config import DashboardConfig
from shared.config import UserError
from shared.runners.transport import StackAddress
from shared.secure_folder import secure_folder

KIND = "web"
BASE_PORT = 8600
"""plus the stack's number."""
LOCAL_NAMES = ("127.0.0.1", "localhost", "::1")
"""Names by which a browser of this computer reaches the page."""
ANY_HOSTS = ("0.0.0.0", "::")


class PageAddress(NamedTuple):
    """Host (name or IP address) and port. certificate: None where the page is plain HTTP.

    hosts: names by which browsers may reach it, besides LOCAL_NAMES. Another name in a request is an attack by DNS.
    """

    host: str
    port: int
    certificate: PageCertificate | None = None
    hosts: tuple[str, ...] = ()

    @property
    def scheme(self) -> str:
        return "http" if self.certificate is None else "https"

    @property
    def url(self) -> str:
        """For a browser."""
        return self.url_at(self.shown_host)

    @property
    def shown_host(self) -> str:
        """The host; where that is any address of this computer, a name of it that other computers know.

        A whole name (robot.local) is known to more of them than a short one, and lasts longer than an address.
        """
        if self.host not in ANY_HOSTS:
            return self.host
        names = [name for name in self.hosts if not is_own_name(name) and "*" not in name]
        return min(names, key=lambda name: (is_ip_address(name), "." not in name), default="localhost")

    def url_at(self, host: str) -> str:
        """The address with this host."""
        return f"{self.scheme}://{f'[{host}]' if ':' in host else host}:{self.port}"


def page_address(config: DashboardConfig, where: StackAddress) -> PageAddress:
    """The address of `web://HOST[:PORT]`. Raises UserError where it is none, or lacks the certificate that it needs."""
    device = config.port.device
    parts = urlsplit(device)
    try:
        host, port = parts.hostname or "", parts.port
    except ValueError:
        host, port = "", None
    if parts.scheme != KIND or not host or parts.path not in ("", "/"):
        raise UserError(
            f"dashboard.port.device: {device!r} is no address", "write web://127.0.0.1 or web://127.0.0.1:8600"
        )
    if port is None:
        port = BASE_PORT + where.domain
    certificate = _certificate(config, device, host)
    names = () if certificate is None else certificate.names
    hosts = tuple(name.strip("[]").lower() for name in (*config.hosts, *names))
    return PageAddress("127.0.0.1" if host == "localhost" else host, port, certificate, hosts)


def is_this_computer(address: str) -> bool:
    """Whether an address is the loopback address of this computer; another one of 127.0.0.0/8 counts as elsewhere."""
    return address.removeprefix("::ffff:") in ("127.0.0.1", "::1")


def is_own_name(name: str) -> bool:
    """Whether a name leads each computer to itself."""
    if is_ip_address(name):
        return ip_address(name).is_loopback
    return name == "localhost" or name.endswith(".localhost")


def is_ip_address(name: str) -> bool:
    """Whether a name is an IP address."""
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _certificate(config: DashboardConfig, device: str, host: str) -> PageCertificate | None:
    if config.certificate:
        return read_certificate(Path(config.certificate), Path(config.key))
    if host in LOCAL_NAMES:
        return None
    folder = secure_folder()
    if not folder.exists:
        raise UserError(
            f"dashboard.port.device: {device!r} needs a certificate; without one: this computer's own address only",
            "make one: zenav secure init; or from another computer: ssh -L 8600:127.0.0.1:8600 ROBOT",
        )
    folder.require()
    return read_certificate(folder.robot_certificate, folder.robot_key)
