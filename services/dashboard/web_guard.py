# SPDX-License-Identifier: Apache-2.0
"""What is checked before any request is handled: host, origin, login and token; and the headers of every answer.

A browser also shows pages of others, which must not reach the robot. They could try it by a name of their own that
leads here (Host), from their own address (Origin), or by a form (the token).
"""

import asyncio
import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from services.dashboard.address import LOCAL_NAMES, PageAddress, is_this_computer
from services.dashboard.logins import Login
from shared.roles import Role

Message = MutableMapping[str, Any]
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE = "__Host-zenav"
TOKEN_HEADER = b"x-csrf"
PROXY_HEADERS = frozenset((b"forwarded", b"via", b"x-forwarded-for", b"x-forwarded-host", b"x-real-ip"))
SAFE_METHODS = ("GET", "HEAD")
MAX_UNUSED_BODY = 64 * 1024  # bytes of a refused request that are read
BODY_LIMIT_S = 0.5  # in which they must come
LOGIN_PATH = "/login"
PUBLIC_PATHS = ("/", "/session")
"""With /static/, what a browser needs to show the login."""
USER = "zenav.user"
"""The key of a scope for the PageUser, or None before the login."""
POLICY = "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'"
HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=()"),
)


@dataclass(frozen=True, slots=True)
class PageUser:
    """The user of a connection. name: of the login; empty without one.  digest: of the session; empty without one."""

    name: str
    role: Role
    address: str
    digest: str = ""


class Refusal(NamedTuple):
    """Status and text of an answer that refuses."""

    status: int
    text: str


@dataclass(frozen=True, slots=True)
class Access:
    """Which requests may pass.

    address: the present one, whose names change with the certificate.  login: "remote" or "always".
    session: the session of a cookie's token.  csrf: the token of a session's pages, by its digest.
    """

    address: Callable[[], PageAddress]
    login: str
    session: Callable[[str], Login | None]
    csrf: Callable[[str], str]

    def user(self, scope: Scope, headers: dict[bytes, bytes]) -> PageUser | None:
        """The user of a request. A request that came through a proxy is not of this computer."""
        peer = scope["client"][0] if scope.get("client") else ""
        is_local = is_this_computer(peer) and is_named(host_of(headers), LOCAL_NAMES)
        if self.login != "always" and is_local and not PROXY_HEADERS & headers.keys():
            return PageUser("", Role.ADMIN, peer)
        login = self.session(cookie_of(headers))
        return None if login is None else PageUser(login.name, login.role, peer, login.digest)

    def refusal(self, scope: Scope, headers: dict[bytes, bytes], user: PageUser | None) -> Refusal | None:
        """Why a request is refused; None where it is not."""
        host = host_of(headers)
        if not is_named(host, (*LOCAL_NAMES, *self.address().hosts)):
            return Refusal(403, "this page does not answer by this name: see dashboard.hosts")
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("latin-1") != f"{self._scheme(host)}://{host}":
            return Refusal(403, "another page may not use this one")
        if scope["type"] == "http" and scope["path"] == LOGIN_PATH:
            is_json = headers.get(b"content-type", b"").split(b";")[0].strip() == b"application/json"
            return None if origin is not None and is_json else Refusal(403, "a login comes from the page itself")
        if user is None:
            return None if _is_public(scope) else Refusal(401, "log in by the link of an invitation")
        if scope["type"] == "http" and scope["method"] not in SAFE_METHODS:
            given = headers.get(TOKEN_HEADER, b"")
            if not hmac.compare_digest(given, self.csrf(user.digest).encode()):
                return Refusal(403, "the token of the page is missing or wrong: reload the page")
        return None

    def _scheme(self, host: str) -> str:
        # a reverse proxy has the certificate for names that are not this computer's own
        return self.address().scheme if is_named(host, LOCAL_NAMES) else "https"


class WebGuard:
    """Refuses what `access` refuses, and gives every answer its headers. on_refusal: takes address and text."""

    def __init__(self, app: App, access: Access, on_refusal: Callable[[str, str], None]) -> None:
        self._app, self._access, self._on_refusal = app, access, on_refusal

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        headers = dict(scope["headers"])
        user = scope[USER] = self._access.user(scope, headers)
        refusal = self._access.refusal(scope, headers, user)
        if refusal is None:
            await self._app(scope, receive, send_with_headers)
            return
        self._on_refusal(scope["client"][0] if scope.get("client") else "", refusal.text)
        kind = "websocket.http.response" if scope["type"] == "websocket" else "http.response"
        if scope["type"] == "websocket":
            await receive()
        else:
            await _read_body(receive)
        plain = (b"content-type", b"text/plain; charset=utf-8")
        start = {"status": refusal.status, "headers": [plain, (b"connection", b"close")]}
        await send_with_headers({"type": f"{kind}.start", **start})
        await send({"type": f"{kind}.body", "body": f"{refusal.text}\n".encode()})


async def _read_body(receive: Receive) -> None:
    """Reads a small body, for a short time: what closes a connection with unread bytes resets it, with its answer."""
    size, more = 0, True
    with suppress(TimeoutError):
        async with asyncio.timeout(BODY_LIMIT_S):
            while more and size < MAX_UNUSED_BODY:
                message = await receive()
                size, more = size + len(message.get("body", b"")), bool(message.get("more_body"))


def host_of(headers: dict[bytes, bytes]) -> str:
    """The header Host, with its port."""
    return headers.get(b"host", b"").decode("latin-1")


def cookie_of(headers: dict[bytes, bytes]) -> str:
    """The token of the page's cookie; empty where there is none.

    Another program on the host may have set cookies that the standard library's parser ends at.
    """
    for part in headers.get(b"cookie", b"").decode("latin-1").split(";"):
        name, _, value = part.strip().partition("=")
        if name == COOKIE:
            return value
    return ""


def is_named(host: str, names: tuple[str, ...]) -> bool:
    """Whether a Host header has one of these names. `*.site.org` stands for one more label, as in certificates."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return False
    given = parts.hostname or ""
    if not given or parts.path or parts.query or parts.fragment or parts.username is not None:
        return False
    label, _, rest = given.partition(".")
    return any(_same(given, name) or (bool(label and rest) and name == f"*.{rest}") for name in names)


def _same(given: str, name: str) -> bool:
    try:
        return ip_address(given) == ip_address(name)
    except ValueError:
        return given == name


def _is_public(scope: Scope) -> bool:
    if scope["type"] != "http" or scope["method"] not in SAFE_METHODS:
        return False
    return scope["path"] in PUBLIC_PATHS or scope["path"].startswith("/static/")
