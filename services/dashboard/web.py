# SPDX-License-Identifier: Apache-2.0
"""The shell of the page's server: the device `web://` behind the service's port. One thread with a loop of its own.

It listens before it loads the web library: that is done for the first browser, so a stack without pages pays nothing.
"""

import asyncio
import hmac
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any, cast

import msgpack

from services.dashboard.address import page_address
from services.dashboard.config import DashboardConfig
from services.dashboard.fleet_feed import FleetFeed
from services.dashboard.login_store import LoginStore
from services.dashboard.outgoing import PORT
from services.dashboard.page_hub import PageHub
from services.dashboard.page_hubs import PageHubs
from services.dashboard.stack_link import StackLink
from services.dashboard.tool_process import ToolProcess
from services.dashboard.web_guard import Access
from shared import topics
from shared.config import UserError
from shared.messages import PortState, SerialData
from shared.runners.devices import DeviceContext
from shared.secure_folder import secure_folder
from shared.types import NS_PER_S

AGAIN_S = 5.0  # between two tries to get the port
END_LIMIT_S = 3.0
RENEW_EVERY_S = 3600.0


def web_device(context: DeviceContext) -> "WebDevice":
    """The device of a configuration, not yet open. Raises UserError where its address or certificate is wrong."""
    return WebDevice(context)


class WebDevice:
    """See the module. Its events are messages of topics.RX, and it takes those of topics.TX."""

    def __init__(self, context: DeviceContext) -> None:
        self._context = context
        self._section = cast(DashboardConfig, context.section)
        self.address = page_address(self._section, context.where)
        certificate = self.address.certificate
        self._tls = None if certificate is None else certificate.context()
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)
        self._ready = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending: asyncio.Event | None = None
        self._hubs: PageHubs | None = None
        self._state: tuple[bool, str] | None = None

    def start(self) -> None:
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Orders of the core."""
        self._call(lambda: self._take(msgpack.unpackb(data)))

    def plug(self, plugged: bool) -> None:
        """There is nothing to unplug."""

    def close(self) -> None:
        if self._thread.is_alive() and self._ready.wait(END_LIMIT_S):
            self._call(lambda: self._ending.set() if self._ending is not None else None)
            self._thread.join(END_LIMIT_S)

    def _call(self, work: Callable[[], object]) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(work)

    def _take(self, order: dict[str, Any]) -> None:
        if self._hubs is not None:
            self._hubs.take(order)

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop, self._ending = asyncio.get_running_loop(), asyncio.Event()
        self._ready.set()
        listening = await self._listening()
        if listening is None:
            return
        self._publish_state(True, "")
        renewing = asyncio.create_task(self._renew_certificate())
        if await _first(self._connection(listening), self._ending.wait()):
            await self._serve_pages(listening)
        renewing.cancel()
        listening.close()

    async def _serve_pages(self, listening: socket.socket) -> None:
        from services.dashboard.web_app import web_app
        from services.dashboard.web_server import WebServer

        tools = ToolProcess(self._section.tools, self._context.arguments)
        store, key = LoginStore(secure_folder()), secrets.token_bytes(32)

        def csrf(digest: str) -> str:
            return hmac.new(key, digest.encode(), "sha256").hexdigest()

        access = Access(lambda: self.address, self._section.login, store.session, csrf)
        context, is_site = self._context, self._section.fleet

        def make_hub(robot: str, numbers: Iterator[int]) -> PageHub:
            return PageHub(
                to_core=self._publish_event,
                make_link=partial(StackLink, robot or context.robot, context.where),
                tools=tools,
                sessions=store,
                csrf=csrf,
                version=_version(),
                robot=robot,
                numbers=numbers,
            )

        router = context.where.router
        make_feed = partial(FleetFeed, router) if router else None
        hubs = self._hubs = PageHubs(context.robot if is_site else "", make_hub, make_feed)
        server = WebServer(web_app(hubs, access, store), listening, self._tls)
        await server.start()
        if self._ending is not None:
            await self._ending.wait()
        await hubs.close()
        await server.stop()

    async def _listening(self) -> socket.socket | None:
        """The open port; None where the device was closed before it could be had."""
        while self._ending is not None and not self._ending.is_set():
            try:
                listening = socket.create_server(self.address[:2], family=_family(self.address.host), backlog=64)
                self.address = self.address._replace(port=listening.getsockname()[1])  # 0 is any free one
                return listening
            except OSError as error:
                self._publish_state(False, f"{self.address.url}: {error.strerror}: end what has the port")
            with suppress(TimeoutError):
                await asyncio.wait_for(self._ending.wait(), AGAIN_S)
        return None

    async def _connection(self, listening: socket.socket) -> None:
        """Returns when a browser connects; the connection itself waits in the socket's queue."""
        loop, ready = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(listening.fileno(), ready.set)
        try:
            await ready.wait()
        finally:
            loop.remove_reader(listening.fileno())

    def _publish_event(self, event: dict[str, Any]) -> None:
        self._publish(topics.RX(SerialData(self._context.clock.now(), PORT, bytes(msgpack.packb(event)))))

    async def _renew_certificate(self) -> None:
        """Shows a certificate that was renewed on disk to new connections, and reports when the present one ends.

        Its names count from then on.
        """
        certificate = self.address.certificate
        while self._tls is not None and certificate is not None:
            until = round(certificate.until) * NS_PER_S
            self._publish_event({"client": None, "event": "certificate", "until": until})
            await asyncio.sleep(RENEW_EVERY_S)
            with suppress(UserError):  # the present one goes on; the health shows its end
                renewed = page_address(self._section, self._context.where)
                if renewed.certificate is not None:
                    renewed.certificate.load_into(self._tls)
                    certificate = renewed.certificate
                    self.address = self.address._replace(certificate=certificate, hosts=renewed.hosts)

    def _publish_state(self, is_open: bool, detail: str) -> None:
        if self._state != (is_open, detail):
            self._state = is_open, detail
            self._publish(topics.PORT(PortState(self._context.clock.now(), PORT, is_open, detail)))

    def _publish(self, publication: topics.Publication) -> None:
        self._context.publish(publication)


async def _first(wanted: Any, other: Any) -> bool:
    """Whether `wanted` is done before `other`. Both are cancelled afterwards."""
    tasks = [asyncio.ensure_future(wanted), asyncio.ensure_future(other)]
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    return tasks[0] in done


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _version() -> str:
    try:
        return version("zenav")
    except PackageNotFoundError:
        return ""
