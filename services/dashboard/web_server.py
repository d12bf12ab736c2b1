# SPDX-License-Identifier: Apache-2.0
"""uvicorn with the limits of the page: connections, time to the first request, sizes. Loaded with the first browser."""

import asyncio
import logging
import socket
import ssl
from asyncio import TimerHandle, Transport
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from services.dashboard.address import is_this_computer
from services.dashboard.frames import MAX_FRAME
from services.dashboard.web_guard import App

MAX_CONNECTIONS = 200
MAX_OF_ADDRESS = 50  # of the connections, for another computer: one alone cannot take all
BACKLOG = 64  # connections that wait to be accepted
REQUEST_LIMIT_S = 5.0  # from connecting to the whole head of the first request
HANDSHAKE_LIMIT_S = 5.0  # of TLS
KEEP_ALIVE_S = 5  # to the next request
MAX_HEAD = 16 * 1024  # bytes of a request's head
PING_S = 20.0


class LimitedProtocol(H11Protocol):
    """A connection that must send the head of a request in time. uvicorn has a limit for the second request only."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._deadline: TimerHandle | None = None

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]  # as uvicorn's
        super().connection_made(transport)
        if len(self.connections) > MAX_CONNECTIONS or self._is_greedy():
            transport.abort()
            return
        self._deadline = self.loop.call_later(REQUEST_LIMIT_S, self._check_request)

    def _is_greedy(self) -> bool:
        """Whether this connection's computer has more than its part; on this one many users share a proxy."""
        address = _peer(self)
        own = sum(_peer(connection) == address for connection in self.connections)
        return own > MAX_OF_ADDRESS and not is_this_computer(address)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _check_request(self) -> None:
        if not self.headers and not self.transport.is_closing():
            self.transport.abort()


class PageProtocol(WebSocketsSansIOProtocol):
    """A page's connection. uvicorn's own raises at the server's end where a page said goodbye and has not read all."""

    def shutdown(self) -> None:
        if self.transport.is_closing():
            self.transport.abort()
        else:
            super().shutdown()


def _peer(protocol: Any) -> str:
    """The address at the other end of a protocol of uvicorn; empty once that is gone."""
    peer = protocol.transport.get_extra_info("peername")
    return str(peer[0]) if peer else ""


class WebServer:
    """An application on an open socket. context: TLS; None is plain HTTP."""

    def __init__(self, app: App, listening: socket.socket, context: ssl.SSLContext | None) -> None:
        for name in ("uvicorn.error", "uvicorn.access"):  # each bad request of a stranger would be a line of the log
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._socket, self._context = listening, context
        self._config = uvicorn.Config(
            app,
            http=LimitedProtocol,
            ws=PageProtocol,
            ws_max_size=MAX_FRAME,
            ws_per_message_deflate=False,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,  # a client could name another address as its own
            date_header=False,
            timeout_keep_alive=KEEP_ALIVE_S,
            timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=MAX_HEAD,
        )
        self._server = uvicorn.Server(self._config)

    async def start(self) -> None:
        """Serves from now on. Unlike `uvicorn.Server.serve`, nothing wakes up while nothing happens."""
        self._config.load()
        self._server.lifespan = self._config.lifespan_class(self._config)
        await self._server.startup(sockets=[])  # with sockets it would let a TLS handshake take a minute

        def protocol() -> LimitedProtocol:
            return LimitedProtocol(self._config, self._server.server_state, self._server.lifespan.state)

        limit = HANDSHAKE_LIMIT_S if self._context is not None else None
        self._server.servers.append(
            await asyncio.get_running_loop().create_server(
                protocol, sock=self._socket, ssl=self._context, ssl_handshake_timeout=limit, backlog=BACKLOG
            )
        )

    async def stop(self) -> None:
        """Closes the connections and the socket."""
        await self._server.shutdown(sockets=[self._socket])
        for connection in list(self._server.server_state.connections):
            connection.transport.abort()  # it does not read
