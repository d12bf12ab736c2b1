# SPDX-License-Identifier: Apache-2.0
"""What is checked before any request is handled: host, origin and token; and the headers of every answer.

A browser on this computer also shows pages of others, which must not reach the robot. They could try it by a name of
their own that leads here (Host), from their own address (Origin), or by a form (the token).
"""

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from services.dashboard.address import LOCAL_NAMES

Message = MutableMapping[str, Any]
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

TOKEN_HEADER = b"x-csrf"
SAFE_METHODS = ("GET", "HEAD")
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


def fault_of(scope: Scope, token: str) -> str:
    """Why a request is refused; empty where it is not."""
    headers = dict(scope["headers"])
    host = headers.get(b"host", b"").decode("latin-1")
    if not is_local(host):
        return "this page answers by the name 127.0.0.1 or localhost only"
    origin = headers.get(b"origin")
    if origin is not None and origin.decode("latin-1") != f"http://{host}":
        return "another page may not use this one"
    if scope["type"] == "http" and scope["method"] not in SAFE_METHODS:
        given = headers.get(TOKEN_HEADER, b"")
        if not hmac.compare_digest(given, token.encode()):
            return "the token of the page is missing or wrong: reload the page"
    return ""


def is_local(host: str) -> bool:
    """Whether a Host header names this computer."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return False
    return parts.hostname in LOCAL_NAMES and not (parts.path or parts.query or parts.fragment or parts.username)


class WebGuard:
    """Refuses with 403 what `fault_of` names, and gives every answer its headers."""

    def __init__(self, app: App, token: str) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        fault = fault_of(scope, self._token)
        if not fault:
            await self._app(scope, receive, send_with_headers)
            return
        kind = "websocket.http.response" if scope["type"] == "websocket" else "http.response"
        if scope["type"] == "websocket":
            await receive()
        plain = (b"content-type", b"text/plain; charset=utf-8")
        await send_with_headers({"type": f"{kind}.start", "status": 403, "headers": [plain, (b"connection", b"close")]})
        await send({"type": f"{kind}.body", "body": f"{fault}\n".encode()})
