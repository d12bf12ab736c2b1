# SPDX-License-Identifier: Apache-2.0
"""The gate before the Foxglove servers: TLS and a token, because the SDK has the first but not the second.

The SDK (0.30.3) serves TLS and accepts every client. So its servers listen on loopback, and this gate on the network.
It reads the head of the WebSocket handshake (RFC 6455), compares its token, and passes bytes on. The token is in the
address, the only thing that the app lets its user write. It is not passed on, so no log of the SDK has it.
"""

import asyncio
import socket
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from shared.config import UserError
from shared.secure_folder import Member, MemberRole, SecureFolder
from shared.tls_server import load_certificate
from zenav.secure.tokens import token_member

HEAD_LIMIT_S = 10.0  # from the connection to the whole head
MAX_HEAD = 16 * 1024  # bytes
MAX_CONNECTIONS = 64
LOST_MS = 20_000  # a connection whose bytes are not confirmed for so long is ended
CHECK_S = 1.0  # between two looks at members, tokens and certificate
CHUNK = 64 * 1024  # bytes that are passed on at a time
REFUSED = b"HTTP/1.1 401 Unauthorized\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"

Say = Callable[[str, bool], None]


@dataclass(frozen=True, slots=True)
class GateCredentials:
    """The folder with members and tokens, and the certificate that the gate shows."""

    folder: SecureFolder
    certificate: Path
    key: Path

    def context(self) -> ssl.SSLContext:
        """TLS 1.3 with the certificate. Raises UserError where it cannot be used."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.load(context)
        return context

    def load(self, context: ssl.SSLContext) -> None:
        """Takes the certificate for new connections. Raises UserError where it cannot be used; the former one holds."""
        try:
            load_certificate(context, self.certificate, self.key)
        except OSError as error:  # also SSLError
            why = error.strerror if error.filename or not isinstance(error, ssl.SSLError) else error.reason
            raise UserError(
                f"{self.certificate} with {self.key}: {why}", "give a certificate and its key as PEM: --cert, --key"
            ) from None

    def version(self) -> tuple[int, ...]:
        """Changes with the certificate and with its key."""
        with suppress(OSError):
            return tuple(file.stat().st_mtime_ns for file in (self.certificate, self.key))
        return ()


def token_in(target: str) -> str:
    """The token in the target of a request, `/?token=TOKEN`; empty without one."""
    with suppress(ValueError):
        return parse_qs(urlsplit(target).query).get("token", [""])[0]
    return ""


class Gate:
    """Listens on the network, in a thread of its own.

    backends: loopback ports of the server for viewers, and of the one for operators.
    say: shows a line. A line names the member, and never the token.
    """

    def __init__(self, credentials: GateCredentials, backends: tuple[int, int], say: Say) -> None:
        self._credentials, self._backends, self._say = credentials, backends, say
        self._context = credentials.context()
        self._version = credentials.version()
        self._visitors: dict[asyncio.Task[None], str] = {}  # token by connection
        self._n_connections = 0
        self._n_refused, self._refused_said = 0, float("-inf")
        self._server: asyncio.Server | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="gate", daemon=True)

    def open(self, host: str, port: int) -> int:
        """Begins to listen; returns the port. Raises OSError where it cannot be had."""
        self._thread.start()
        return asyncio.run_coroutine_threadsafe(self._open(host, port), self._loop).result()

    def close(self) -> None:
        """Ends every connection."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()

    async def _open(self, host: str, port: int) -> int:
        self._server = await asyncio.start_server(
            self._serve, host, port, ssl=self._context, ssl_handshake_timeout=HEAD_LIMIT_S, limit=MAX_HEAD
        )
        self._checks = self._loop.create_task(self._check())
        return int(self._server.sockets[0].getsockname()[1])

    async def _close(self) -> None:
        if self._server is not None:
            self._server.close()
        others = [task for task in asyncio.all_tasks(self._loop) if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, from its handshake of TLS on."""
        self._n_connections += 1
        try:
            if self._n_connections <= MAX_CONNECTIONS:
                with suppress(OSError, EOFError, ValueError, asyncio.LimitOverrunError, TimeoutError):
                    await self._admit(reader, writer)
        finally:
            self._n_connections -= 1
            writer.transport.abort()

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection: socket.socket = writer.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LOST_MS)
        host = writer.get_extra_info("peername")[0]
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_LIMIT_S)
        request, _, fields = head.decode("latin-1").partition("\r\n")
        method, target, version = request.split(" ")  # ValueError: no request
        token = token_in(target)
        member = self._member(token)
        if member is None or method != "GET":
            self._note_refusal(host)
            writer.write(REFUSED)
            await asyncio.wait_for(writer.drain(), HEAD_LIMIT_S)
            return
        task = asyncio.current_task()
        assert task is not None
        self._visitors[task] = token
        self._say(f"{member.name} ({member.role}) connected from {host}", False)
        try:
            await self._pass(f"{method} / {version}\r\n{fields}".encode("latin-1"), member, reader, writer)
        finally:
            del self._visitors[task]
            self._say(f"{member.name} ({member.role}) disconnected", False)

    async def _pass(
        self, head: bytes, member: Member, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Connects to the server of the member's role, and passes bytes in both directions until one ends."""
        backend = self._backends[member.role is not MemberRole.VIEWER]
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", backend, limit=CHUNK)
        try:
            inner_writer.write(head)
            both = [
                asyncio.ensure_future(_copy(reader, inner_writer)),
                asyncio.ensure_future(_copy(inner_reader, writer)),
            ]
            try:
                await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in both:
                    task.cancel()
                await asyncio.gather(*both, return_exceptions=True)
        finally:
            inner_writer.close()

    async def _check(self) -> None:
        """Cuts off members that have no access any more, and takes a renewed certificate."""
        while True:
            await asyncio.sleep(CHECK_S)
            for task, token in list(self._visitors.items()):
                if self._member(token) is None:
                    task.cancel()
            version = self._credentials.version()
            if version != self._version:
                self._version = version
                try:
                    self._credentials.load(self._context)
                except UserError as error:  # half of it is written: the next change is the whole
                    self._say(f"{error.what}: {error.hint}", True)

    def _member(self, token: str) -> Member | None:
        try:
            return token_member(self._credentials.folder, token) if token else None
        except UserError as error:
            self._say(f"{error.what}: {error.hint}", True)
            return None

    def _note_refusal(self, host: str) -> None:
        """Says that a client was refused, at most once a second."""
        self._n_refused += 1
        now = time.monotonic()
        if now - self._refused_said >= CHECK_S:
            times = "" if self._n_refused == 1 else f" ({self._n_refused} times)"
            self._say(f"refused a connection from {host}: no valid token{times}", True)
            self._n_refused, self._refused_said = 0, now


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Passes bytes on until the reader ends. A slow receiver holds the sender, so nothing piles up here."""
    with suppress(OSError):
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()
