# SPDX-License-Identifier: Apache-2.0
"""Hostile clients of the page's server, a process: `python -m zenav.bench.hostile_clients PORT`.

It reads lines `ATTACK SECONDS` from stdin, attacks for so long, and writes the counts as JSON. It has the lowest
priority: only what the server does for it counts, not its own work. It sends no valid frame that commands the robot.
"""

import asyncio
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field

import msgpack
import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

N_PAGES = 40  # that send frames at once
FRAMES_A_SECOND = 50  # of one page; the server closes a page with more than 60
N_CONNECTIONS = 200
OVERSIZED = 10 * 2**20  # bytes of a frame
NO_COMMAND = ("want", "let_go", "name", "ping", "teleop", "ask", "do", "none")
"""Types of the frames with arbitrary fields; STOP has no fields, so it would be valid."""


@dataclass(slots=True)
class HostileClients:
    """Attacks on the page's server at a port of loopback. counts: what happened in the present attack."""

    port: int
    counts: Counter[str] = field(default_factory=Counter)

    async def frames(self, until: float) -> None:
        """Arbitrary frames of `N_PAGES` pages; a page that is closed comes back."""
        await asyncio.gather(*(self._page(np.random.default_rng(i), until) for i in range(N_PAGES)))

    async def oversized(self, until: float) -> None:
        """Pages that send one frame of 10 MiB each, one after the other."""
        while time.monotonic() < until:
            with suppress(OSError, WebSocketException, TimeoutError):
                async with self._opened(until) as page:
                    self.counts["oversized frames"] += 1
                    with suppress(WebSocketException):
                        await page.send(bytes(OVERSIZED))
                    await page.wait_closed()
                    self.counts["refused"] += page.close_code == 1009

    async def connections(self, until: float) -> None:
        """`N_CONNECTIONS` pages that stay open and read."""
        await asyncio.gather(*(self._reader(until) for _ in range(N_CONNECTIONS)))

    async def slowloris(self, until: float) -> None:
        """`N_CONNECTIONS` connections that send the head of a request, one byte a second."""
        await asyncio.gather(*(self._trickle(until) for _ in range(N_CONNECTIONS)))

    def _opened(self, until: float) -> connect:
        left = max(until - time.monotonic(), 0.1)
        return connect(f"ws://127.0.0.1:{self.port}/ws", proxy=None, open_timeout=left, max_size=None)

    async def _page(self, rng: np.random.Generator, until: float) -> None:
        while time.monotonic() < until:
            with suppress(OSError, WebSocketException, TimeoutError):
                async with self._opened(until) as page:
                    reading = asyncio.ensure_future(self._read(page))
                    while time.monotonic() < until and page.close_code is None:
                        await page.send(arbitrary_frame(rng))
                        self.counts["frames"] += 1
                        await asyncio.sleep(1 / FRAMES_A_SECOND)
                    reading.cancel()

    async def _reader(self, until: float) -> None:
        try:
            async with self._opened(until) as page:
                self.counts["served"] += 1
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._read(page), until - time.monotonic())
        except (OSError, WebSocketException, TimeoutError):
            self.counts["refused"] += 1

    async def _read(self, page: ClientConnection) -> None:
        async for _ in page:
            self.counts["received"] += 1

    async def _trickle(self, until: float) -> None:
        head = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * 1000
        while time.monotonic() < until:
            with suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
                self.counts["half requests"] += 1
                for byte in head:
                    writer.write(bytes((byte,)))
                    await writer.drain()
                    if reader.at_eof() or time.monotonic() > until:
                        break
                    await asyncio.sleep(1)
                self.counts["cut off"] += reader.at_eof()
                writer.close()
            await asyncio.sleep(0.1)


def arbitrary_frame(rng: np.random.Generator) -> bytes:
    """Bytes at random, a tree at random, or the frame of a type with fields at random."""
    kind = rng.integers(3)
    if kind == 0:
        return rng.bytes(int(rng.integers(60)))
    tree = _tree(rng, 3)
    if kind == 1:
        return bytes(msgpack.packb(tree))
    names = ("keys", "v", "w", "n", "id", "request", "args", "op", "name", "debug")
    fields = {str(name): _tree(rng, 2) for name in rng.choice(names, int(rng.integers(4)))}
    return bytes(msgpack.packb({**fields, "t": str(rng.choice(NO_COMMAND))}))


def _tree(rng: np.random.Generator, depth: int) -> object:
    leaves: tuple[Callable[[], object], ...] = (
        lambda: None,
        lambda: bool(rng.integers(2)),
        lambda: int(rng.integers(-(2**62), 2**62)),
        lambda: float(rng.choice((np.nan, np.inf, -np.inf, 1e300))),
        lambda: rng.bytes(8).hex(),
        lambda: rng.bytes(5),
    )
    if depth and rng.random() < 0.4:
        children = [_tree(rng, depth - 1) for _ in range(int(rng.integers(4)))]
        return children if rng.random() < 0.5 else {str(i): child for i, child in enumerate(children)}
    return leaves[int(rng.integers(len(leaves)))]()


def main(port: int) -> None:
    """Attacks until stdin ends."""
    os.nice(19)
    clients = HostileClients(port)
    attacks: dict[str, Callable[[float], Awaitable[None]]] = {
        "frames": clients.frames,
        "oversized": clients.oversized,
        "connections": clients.connections,
        "slowloris": clients.slowloris,
    }

    async def run(attack: str, seconds: float) -> None:
        await attacks[attack](time.monotonic() + seconds)

    for line in sys.stdin:
        attack, seconds = line.split()
        clients.counts.clear()
        asyncio.run(run(attack, float(seconds)))
        sys.stdout.write(json.dumps(clients.counts) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
