# SPDX-License-Identifier: Apache-2.0
"""The routes of login and logout. Loaded when the first browser connects.

The token of an invitation comes in the body of a POST, never in a path or a query, which programs write into logs.
"""

import asyncio
import json
from collections.abc import Callable
from math import ceil

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from services.dashboard.login_store import LoginStore
from services.dashboard.login_throttle import LoginThrottle
from services.dashboard.logins import MAX_TOKEN, SESSION_LIFE_S
from services.dashboard.page_hub import SESSION_ENDED, PageHub
from services.dashboard.web_guard import COOKIE, LOGIN_PATH, USER, PageUser
from shared.config import UserError
from shared.roles import Role

MAX_BODY = 1024
BODY_LIMIT_S = 5.0


def login_routes(hub: PageHub, end_session: Callable[[str, str], None], store: LoginStore) -> list[Route]:
    """GET /session, POST /login, POST /logout."""
    throttle = LoginThrottle()
    turn = asyncio.Lock()  # one login at a time: attempts side by side would not wait for each other's failure

    async def session(request: Request) -> Response:
        user: PageUser | None = request.scope[USER]
        if user is None:
            return PlainTextResponse("log in by the link of an invitation\n", 401)
        return JSONResponse({"name": user.name, "role": str(user.role)})

    async def login(request: Request) -> Response:
        token = _token(await _body(request))
        address = request.client.host if request.client is not None else ""
        async with turn:
            answer = await _login(token, address)
        if answer.status_code == 200:  # the new session takes the place of the one that this browser had
            await _end(request.scope[USER])
        return answer

    async def _login(token: str, address: str) -> Response:
        loop = asyncio.get_running_loop()
        wait = throttle.wait(address, loop.time())
        if wait > 0:
            hub.report_refusal(address, "a login too soon after failed ones")
            return _too_soon(wait)
        try:
            opened = await loop.run_in_executor(None, store.redeem, token) if token else None
        except (UserError, OSError) as error:
            return PlainTextResponse(f"{error}\n", 503)
        if opened is None:
            wait = throttle.fail(address, loop.time())
            hub.report("login_failed", PageUser("", Role.VIEWER, address), f"next attempt after {wait:.0f} s")
            return PlainTextResponse("this invitation is none, is used, or has ended\n", 401)
        throttle.succeed(address)
        token, row = opened
        hub.report("login", PageUser(row.name, row.role, address))
        answer = JSONResponse({"name": row.name, "role": str(row.role)})
        answer.set_cookie(
            COOKIE, token, max_age=round(SESSION_LIFE_S), path="/", secure=True, httponly=True, samesite="strict"
        )
        return answer

    async def logout(request: Request) -> Response:
        user: PageUser = request.scope[USER]
        await _end(user)
        answer = Response(status_code=204)
        answer.delete_cookie(COOKIE, path="/", secure=True, httponly=True, samesite="strict")
        return answer

    async def _end(user: PageUser | None) -> None:
        if user is not None and user.digest:
            await asyncio.get_running_loop().run_in_executor(None, store.end, user.digest)
            hub.report("logout", user)
            end_session(user.digest, SESSION_ENDED)

    return [
        Route("/session", session),
        Route(LOGIN_PATH, login, methods=["POST"]),
        Route("/logout", logout, methods=["POST"]),
    ]


async def _body(request: Request) -> bytes:
    """The body; empty where it is too large, or comes too slowly."""
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_LIMIT_S):
            async for part in request.stream():
                content += part
                if len(content) > MAX_BODY:
                    return b""
    except (TimeoutError, ClientDisconnect):
        return b""
    return bytes(content)


def _token(body: bytes) -> str:
    """The token of {"token": TOKEN}; empty where it is none."""
    try:
        token = json.loads(body)["token"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return ""
    return token if isinstance(token, str) and len(token) <= MAX_TOKEN else ""


def _too_soon(wait: float) -> Response:
    text = f"too many failed logins: try again in {ceil(wait)} s\n"
    return PlainTextResponse(text, 429, {"retry-after": str(ceil(wait))})
