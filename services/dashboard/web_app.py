# SPDX-License-Identifier: Apache-2.0
"""The routes of the page: its files, the WebSocket, and up- and downloads. Loaded when the first browser connects."""

import asyncio
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.dashboard.field_checks import FrameError, item_name, recording_name
from services.dashboard.login_store import LoginStore
from services.dashboard.page_connection import PageConnection
from services.dashboard.page_hub import SERVER_ENDED, SESSION_ENDED, PageHub
from services.dashboard.page_hubs import PageHubs
from services.dashboard.web_guard import USER, Access, App, PageUser, WebGuard
from services.dashboard.web_login import login_routes
from shared.roles import ROUTE_ROLES, may

STATIC = Path(__file__).resolve().parent / "static"
MAX_FRAMES = 60
"""frames of a page in a second; then it is closed."""
MAX_UPLOAD = 64 * 2**20  # bytes
UPLOAD_LIMIT_S = 60.0
TOO_MANY, TOO_SLOW, GOING_AWAY = 1008, 1013, 1001  # RFC 6455, section 7.4
RESTARTS = 1012  # as uvicorn's own, so a page gets one code, whichever of the two comes first
NO_SESSION = 4401  # of the range for applications: the page shows its login
CODES = {SESSION_ENDED: NO_SESSION, SERVER_ENDED: RESTARTS}


def web_app(hubs: PageHubs, access: Access, store: LoginStore) -> App:
    """The application of the hubs' pages. store: of their logins."""
    hub = hubs.first

    async def index(request: Request) -> Response:
        return FileResponse(STATIC / "index.html", headers={"cache-control": "no-cache"})

    async def socket(websocket: WebSocket) -> None:
        await websocket.accept()
        own, page = await hubs.opened(websocket.scope[USER], websocket.query_params.get("robot", ""))
        sending = asyncio.create_task(_send(websocket, page))
        try:
            await _receive(websocket, page, own)
        finally:
            hubs.closed(own, page)
            page.end("the page is gone")
            await sending

    async def map_file(request: Request) -> Response:
        refused = _role_refusal(request, hub, "map_download")
        if refused is not None:
            return refused
        return _file(await _run(hub, "map_download", request.path_params["name"], item_name), "application/zip")

    async def upload(request: Request) -> Response:
        refused = _role_refusal(request, hub, "map_upload")
        if refused is not None:
            return refused
        try:
            name = item_name(request.query_params.get("name", ""))
            content = await _body(request)
        except FrameError as error:
            return PlainTextResponse(f"{error}\n", 400)
        hub.report("upload", request.scope[USER], name)
        return _report(await hub.tools.run("map_upload", {"name": name, "content": content}))

    async def recording(request: Request) -> Response:
        refused = _role_refusal(request, hub, "recording_download")
        if refused is not None:
            return refused
        reply = await _run(hub, "recording_path", request.path_params["name"], recording_name)
        if not reply["accepted"]:
            return _report(reply)
        path = Path(reply["data"])
        hub.report("download", request.scope[USER], path.name)
        return GrowingFileResponse(path, filename=path.name, media_type="application/octet-stream")

    routes = [
        Route("/", index),
        Route("/maps/{name}.zip", map_file),
        Route("/maps", upload, methods=["POST"]),
        Route("/recordings/{name}", recording),
        WebSocketRoute("/ws", socket),
        Mount("/static", StaticFiles(directory=STATIC)),
        *login_routes(hub, hubs.end_session, store),
    ]
    return WebGuard(Starlette(routes=routes), access, hub.report_refusal)


class GrowingFileResponse(FileResponse):
    """What is in a file now: one that is being written grows while it is sent."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        left: int | None = None

        async def send_first(message: Message) -> None:
            nonlocal left
            if message["type"] == "http.response.start":
                left = int(Headers(raw=message["headers"])["content-length"])
            elif left is not None and message["type"] == "http.response.body":
                body = message.get("body", b"")[:left]
                if not body and message.get("more_body"):
                    return  # what was written since
                left -= len(body)
                message = {**message, "body": body, "more_body": bool(message.get("more_body"))}
            await send(message)

        await super().__call__(scope, receive, send_first)


def _role_refusal(request: Request, hub: PageHub, route: str) -> Response | None:
    """The answer to a user whose role does not suffice, else None."""
    user: PageUser = request.scope[USER]
    needed = ROUTE_ROLES[route]
    if may(user.role, needed):
        return None
    hub.report_refusal(user.address, f"{route} for {user.name} ({user.role})")
    return PlainTextResponse(f"{route} needs the role {needed}\n", 403)


async def _receive(websocket: WebSocket, page: PageConnection, hub: PageHub) -> None:
    loop = asyncio.get_running_loop()
    second, n_frames = loop.time(), 0
    while not page.end_reason:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        data = message.get("bytes")
        if data is None:
            page.end("a frame that is text: frames are binary")
            return
        now = loop.time()
        if now - second >= 1.0:
            second, n_frames = now, 0
        n_frames += 1
        if n_frames > MAX_FRAMES:
            page.end(f"more than {MAX_FRAMES} frames in a second")
            return
        hub.frame(page, data)


async def _send(websocket: WebSocket, page: PageConnection) -> None:
    try:
        reason = await page.send_all(websocket.send_bytes)
        code = CODES.get(reason, TOO_MANY if "frame" in reason else GOING_AWAY)
    except TimeoutError:
        reason, code = "the page does not read", TOO_SLOW
    except (WebSocketDisconnect, RuntimeError):
        page.end("the page is gone")
        return
    page.end(reason)
    try:
        await websocket.close(code, reason)
    except (WebSocketDisconnect, RuntimeError):
        return  # it is gone already


async def _body(request: Request) -> bytes:
    """The body of a request. Raises FrameError where it is too large, or comes too slowly."""
    content = bytearray()
    try:
        async with asyncio.timeout(UPLOAD_LIMIT_S):
            async for part in request.stream():
                content += part
                if len(content) > MAX_UPLOAD:
                    raise FrameError(f"more than {MAX_UPLOAD} bytes")
    except TimeoutError:
        raise FrameError(f"not uploaded within {UPLOAD_LIMIT_S:g} s") from None
    except ClientDisconnect:
        raise FrameError("the upload was interrupted") from None
    return bytes(content)


async def _run(hub: PageHub, op: str, name: str, check: Any) -> dict[str, Any]:
    try:
        return await hub.tools.run(op, {"name": check(name)})
    except FrameError as error:
        return {
            "accepted": False,
            "reason": "bad_request",
            "detail": f"{name[:64]!r} {error}",
            "hint": "",
            "data": None,
        }


def _file(reply: dict[str, Any], kind: str) -> Response:
    return Response(reply["data"], media_type=kind) if reply["accepted"] else _report(reply)


def _report(reply: dict[str, Any]) -> Response:
    """A tool's reply as JSON, with the status 404 of a refusal."""
    return JSONResponse(reply, 200 if reply["accepted"] else 404)
