# SPDX-License-Identifier: Apache-2.0
"""Another computer for tests of the page: HTTPS from 127.0.0.2, which counts as remote, with a cookie of its own."""

import http.client
import json
import socket
import ssl
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

from services.dashboard.login_store import LoginStore
from services.dashboard.web_guard import COOKIE
from shared.ports import PortConfig
from shared.roles import Role
from shared.secure_folder import secure_folder
from tests.unit.services.dashboard.browser import SOON, Browser, Served, serving
from tests.unit.services.dashboard.credentials import REMOTE, make_credentials


class RemoteComputer:
    """A browser on another computer. `cookie` is what it keeps of the last answer; `cookie_line` is as it was sent."""

    def __init__(self, port: int, address: str = REMOTE, host: str = REMOTE) -> None:
        self.port, self.address = port, address
        self.host = f"{host}:{port}"
        self.cookie, self.cookie_line = "", ""
        self.tls, self.page_tls = _trusting_context(), _trusting_context()
        # Browser reads and writes on two threads. OpenSSL does not allow that while it takes a ticket of TLS 1.3:
        # then the write can wait for ever.
        self.page_tls.maximum_version = ssl.TLSVersion.TLSv1_2

    def request(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, str]:
        """Status and text of the answer. A header that is empty is not sent."""
        origin = {"origin": f"https://{self.host}"} if method == "POST" else {}
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        names = {"host": self.host, **self._cookie_header(), **origin, **given}
        connection = http.client.HTTPSConnection(
            REMOTE, self.port, timeout=SOON, source_address=(self.address, 0), context=self.tls
        )
        with closing(connection):
            connection.request(method, path, body, {name: value for name, value in names.items() if value})
            answer = connection.getresponse()
            self.headers = answer.headers
            self._keep(answer.headers.get("set-cookie", ""))
            return answer.status, answer.read().decode()

    def login(self, token: str, **headers: str) -> int:
        """The status of a login by an invitation's token."""
        body = json.dumps({"token": token}).encode()
        return self.request("POST", "/login", body, **{"content_type": "application/json", **headers})[0]

    def page(self, **options: Any) -> Browser:
        """A page of its browser."""
        sock = socket.create_connection((REMOTE, self.port), SOON, (self.address, 0))
        headers = {**self._cookie_header(), **options.pop("headers", {})}
        name = self.host.rpartition(":")[0]
        return Browser(
            self.port,
            name,
            sock=sock,
            ssl=self.page_tls,
            additional_headers=headers,
            **{"origin": self.origin, **options},
        )

    @property
    def origin(self) -> Any:
        return f"https://{self.host}"

    def _cookie_header(self) -> dict[str, str]:
        return {"cookie": f"{COOKIE}={self.cookie}"} if self.cookie else {}

    def _keep(self, line: str) -> None:
        if line:
            self.cookie_line = line
            self.cookie = SimpleCookie(line)[COOKIE].value


def _trusting_context() -> ssl.SSLContext:
    """TLS that takes any certificate."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


@contextmanager
def serving_remote(monkeypatch: Any, path: Path, days: float = 365.0, **settings: Any) -> Iterator[Served]:
    """A server with a certificate on 127.0.0.2; its secure folder is at `path`."""
    monkeypatch.setenv("ZENAV_SECURE", str(path))
    make_credentials(path, days)
    with serving(monkeypatch, **{"port": PortConfig(device=f"web://{REMOTE}:0"), **settings}) as served:
        yield served


def logged_in(served: Served, role: Role, name: str = "anna") -> RemoteComputer:
    """Another computer with a session."""
    computer = RemoteComputer(served.port)
    assert computer.login(LoginStore(secure_folder()).invite(name, role, 15)) == 200
    return computer


def invitation(role: Role = Role.OPERATOR, name: str = "anna") -> str:
    """The token of an invitation for 15 minutes."""
    return LoginStore(secure_folder()).invite(name, role, 15)
