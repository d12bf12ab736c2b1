# SPDX-License-Identifier: Apache-2.0
"""A map from and to a running mapper, in parts that fit the wire: see FetchMap, GiveMap and StartMap."""

from collections.abc import Callable
from typing import Any, Protocol

from shared import requests
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import MapMode, Message
from shared.reasons import BUSY
from shared.requests import MAP_PART, MAX_MAP_PARTS, FetchMap, GiveMap, MapPart, Reply, Request, StartMap
from zenav.client.navigation_client import refusal_error

MAX_WAIT_S = 60.0  # s that a mapper may be busy: it redraws its map, or checks the map that it received
RETRY_PERIOD_S = 0.2  # s

Wait = Callable[[float], object]
"""Lets so many s go by."""


class Asker(Protocol):
    """shared.runners.client.Client, as far as it is needed here."""

    def now(self) -> int: ...

    def ask(self, request: Request[Any, Any], message: Any) -> Any: ...


def fetch_map(asker: Asker, wait: Wait) -> bytes:
    """The present map as the content of graph.msgpack. Raises UserError where the mapper refuses."""
    copy = ask_until_free(asker, wait, requests.FETCH_MAP, FetchMap(asker.now(), 0, 0)).copy
    content: list[bytes] = []
    parts = 1
    while len(content) < parts:
        part = _made(asker, wait, copy, len(content))
        content.append(part.data)
        parts = part.parts
    return b"".join(content)


def give_map(asker: Asker, wait: Wait, content: bytes) -> int:
    """Gives the mapper the content of a graph.msgpack; returns the transfer's number. Raises UserError."""
    parts = -(-len(content) // MAP_PART)
    if not 0 < parts <= MAX_MAP_PARTS:
        raise UserError(f"the map's file has {len(content)} bytes", f"it must have 1 to {MAX_MAP_PARTS * MAP_PART}")
    transfer = max(asker.now(), 1)
    for k in range(parts):
        data = content[k * MAP_PART : (k + 1) * MAP_PART]
        ask_until_free(asker, wait, requests.GIVE_MAP, GiveMap(asker.now(), transfer, k, parts, data))
    return transfer


def start_mode(
    asker: Asker, wait: Wait, mode: MapMode, transfer: int = 0, at: Pose2 | None = None, name: str = ""
) -> Reply:
    """Lets the mapper go on in a mode, on a given map or on the present one. Raises UserError where it refuses.

    name: of a given map, below maps/.
    """
    poses = () if at is None else (at,)
    reply: Reply = ask_until_free(asker, wait, requests.START_MAP, StartMap(asker.now(), mode, transfer, poses, name))
    return reply


def _made(asker: Asker, wait: Wait, copy: int, k: int) -> MapPart:
    """A part of a copy, which may still have to be made."""
    waited = 0.0
    while True:
        part: MapPart = ask_until_free(asker, wait, requests.FETCH_MAP, FetchMap(asker.now(), copy, k))
        if part.parts:
            return part
        if waited >= MAX_WAIT_S:
            raise UserError(BUSY.text, BUSY.hint)
        wait(RETRY_PERIOD_S)
        waited += RETRY_PERIOD_S


def ask_until_free(asker: Asker, wait: Wait, request: Request[Any, Any], message: Message) -> Any:
    """An accepting reply; where the mapper is busy, it is asked again."""
    waited = 0.0
    while True:
        reply = asker.ask(request, message)
        if reply.accepted:
            return reply
        if reply.reason != BUSY.code or waited >= MAX_WAIT_S:
            raise refusal_error(reply)
        wait(RETRY_PERIOD_S)
        waited += RETRY_PERIOD_S
