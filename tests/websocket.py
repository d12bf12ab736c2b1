# SPDX-License-Identifier: Apache-2.0
"""A blocking WebSocket client for tests.

Why not `websockets.sync.client`: it receives in one thread and sends in another, on one TLS connection. OpenSSL does
not allow that, and Python locks it from 3.13 on only. On a busy machine 3 of 1000 handshakes came to no end.
"""

import asyncio
import threading
from collections.abc import Coroutine, Iterator
from contextlib import suppress
from typing import Any, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosedOK

Result = TypeVar("Result")


class WebSocketClient:
    """A connection. It lives in a thread of its own, and is called from any."""

    def __init__(self, address: str, **options: Any) -> None:
        """options: of websockets' `connect`. Raises what that raises."""
        self._loop = asyncio.new_event_loop()
        self._lock, self._is_ended = threading.Lock(), False
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._connection: ClientConnection = self._run(_opened(address, options))
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> "WebSocketClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        self._end()

    def __iter__(self) -> Iterator[str | bytes]:
        """Messages until the connection is closed. Raises ConnectionClosedError where it was cut."""
        with suppress(ConnectionClosedOK):
            while True:
                yield self.recv()

    def recv(self, timeout: float | None = None) -> str | bytes:
        """The next message. Raises TimeoutError after `timeout` seconds without one, and ConnectionClosed."""
        return self._run(self._received(timeout))

    def send(self, message: str | bytes) -> None:
        """Raises ConnectionClosed."""
        self._run(self._connection.send(message))

    def close(self) -> None:
        """Says goodbye."""
        self._run(self._connection.close())

    def cut(self) -> None:
        """Ends the connection without a goodbye."""
        self._loop.call_soon_threadsafe(self._connection.transport.abort)

    @property
    def closed(self) -> tuple[int, str] | None:
        """Code and reason with which the connection was closed."""
        code = self._connection.close_code
        return None if code is None else (code, self._connection.close_reason or "")

    async def _received(self, timeout: float | None) -> str | bytes:
        return await asyncio.wait_for(self._connection.recv(), timeout)

    def _run(self, work: Coroutine[Any, Any, Result]) -> Result:
        with self._lock:
            if self._is_ended:  # a thread that reads calls once more
                work.close()
                raise ConnectionClosedOK(None, None)
            result = asyncio.run_coroutine_threadsafe(work, self._loop)
        return result.result()

    def _end(self) -> None:
        with self._lock:
            self._is_ended = True
        asyncio.run_coroutine_threadsafe(_wait_for_others(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()


async def _opened(address: str, options: dict[str, Any]) -> ClientConnection:
    return await connect(address, proxy=None, **options)


async def _wait_for_others() -> None:
    """Until every task of the loop has heard that the connection is closed."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    if others:
        await asyncio.wait(others, timeout=10)
