# SPDX-License-Identifier: Apache-2.0
"""The process that works on maps, places, recordings and settings for pages: started on demand, ended when idle.

Such work reads large files and holds Python's lock, so it is no work for the process that a page drives through.
In both directions: four bytes of length (little-endian), then a msgpack map: {"op", "args"}, and the fields of a reply.
"""

import asyncio
import sys
from contextlib import suppress
from typing import Any

import msgpack

from shared.reasons import BUSY, NOT_RUNNING
from shared.runners.client import refusal

IDLE_S = 60.0  # after the last operation
LIMIT_S = 120.0  # of one operation: a large map is packed and checked
MAX_REPLY = 256 * 2**20  # bytes
MAX_WAITING = 8  # operations that may wait for the one that runs


class ToolProcess:
    """One operation at a time. module: run as `python -m MODULE ARGUMENTS`; empty: there is no tool."""

    def __init__(self, module: str, arguments: tuple[str, ...]) -> None:
        self._module, self._arguments = module, arguments
        self._process: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()
        self._n_waiting = 0
        self._idle: asyncio.TimerHandle | None = None
        self._ending: asyncio.Task[None] | None = None

    async def run(self, op: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """The fields of the reply but for its `id`."""
        if not self._module:
            return refusal(NOT_RUNNING.code, "this stack has no tools for pages", "set dashboard.tools")
        if self._n_waiting >= MAX_WAITING:
            return refusal(BUSY.code, BUSY.text, BUSY.hint)
        self._n_waiting += 1
        try:
            async with self._turn:
                return await self._run(op, arguments)
        finally:
            self._n_waiting -= 1

    async def close(self) -> None:
        """Ends the process."""
        if self._idle is not None:
            self._idle.cancel()
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    def _end_idle(self) -> None:
        self._ending = asyncio.get_running_loop().create_task(self.close())

    async def _run(self, op: str, arguments: dict[str, Any]) -> dict[str, Any]:
        if self._idle is not None:
            self._idle.cancel()
        try:
            async with asyncio.timeout(LIMIT_S):
                return await self._exchange({"op": op, "args": arguments})
        except (OSError, ValueError, asyncio.IncompleteReadError, TimeoutError, msgpack.UnpackException):
            await self.close()
            return refusal(NOT_RUNNING.code, f"{op}: the tool of the page ended", "see the dashboard's log")
        finally:
            loop = asyncio.get_running_loop()
            self._idle = loop.call_later(IDLE_S, self._end_idle)

    async def _exchange(self, order: dict[str, Any]) -> dict[str, Any]:
        if self._process is None or self._process.returncode is not None:
            command = (sys.executable, "-P", "-m", self._module, *self._arguments)
            pipe = asyncio.subprocess.PIPE
            self._process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe)
        writer, reader = self._process.stdin, self._process.stdout
        if writer is None or reader is None:
            raise OSError("no pipes")
        data = bytes(msgpack.packb(order))
        writer.write(len(data).to_bytes(4, "little") + data)
        await writer.drain()
        length = int.from_bytes(await reader.readexactly(4), "little")
        if length > MAX_REPLY:
            raise ValueError("a reply that is too long")
        reply = msgpack.unpackb(await reader.readexactly(length))
        if type(reply) is not dict:
            raise ValueError("a reply that is no map")
        return reply
