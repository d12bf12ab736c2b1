# SPDX-License-Identifier: Apache-2.0
"""The map's tiles at each time of a recording: every version of each tile, packed."""

import zlib
from bisect import bisect_right
from dataclasses import dataclass, field
from tempfile import SpooledTemporaryFile
from typing import Any

from shared import topics
from shared.codec import CodecError, decode
from shared.messages import MapUpdate
from shared.recording import Entry
from zenav.page.target import Values

MAX_MEMORY = 64 * 2**20  # bytes of packed tiles; more are in a file
MAX_TILES = 256
"""tiles of one reply: 1 MiB."""


@dataclass(slots=True)
class _Versions:
    """The versions of a tile: times (ns, rising), and where their packed cells are."""

    times: list[int] = field(default_factory=list)
    places: list[tuple[int, int]] = field(default_factory=list)


@dataclass(slots=True)
class _Map:
    """One map: its first update (ns), and by row and column its tiles."""

    begin: int
    map_id: int
    resolution: float
    tiles: dict[tuple[int, int], _Versions] = field(default_factory=dict)


class TileHistory:
    """Takes the map's messages in the order of recording; where the clock jumped back, its time stands still."""

    def __init__(self) -> None:
        self._maps: list[_Map] = []
        self._time = 0
        self._packed: Any = SpooledTemporaryFile(MAX_MEMORY)  # noqa: SIM115  # open until `close`
        self._size = 0

    def add(self, entry: Entry) -> None:
        """Takes a message of the map; one that is not valid is left out."""
        try:
            update, _ = decode(topics.MAP.type, entry.payload)
        except CodecError:
            return
        self._time = max(self._time, entry.log_time)
        present = self._maps[-1] if self._maps else None
        if present is None or (present.map_id, present.resolution) != (update.map_id, update.resolution):
            self._maps.append(_Map(self._time, update.map_id, update.resolution))
        self._add_tiles(update)

    def close(self) -> None:
        """Drops the packed tiles."""
        self._packed.close()

    def at(self, time: int, since: int | None, first: int, zero: int) -> Values:
        """The map at `time` (ns) as fields of a reply, at most MAX_TILES tiles of it, from number `first` on.

        since: ns, the map that the page has; None: it has none. Where it has another map, or a later one, the reply
        says `reset`, and holds all tiles. left: tiles that come after these. began: s since `zero` (ns) of this map.
        """
        i_map = self._map_at(time)
        if i_map < 0:
            return {**_NO_MAP, "reset": True}
        reset = since is None or since > time or self._map_at(since) != i_map
        shown = self._maps[i_map]
        changed = []
        for place, versions in sorted(shown.tiles.items()):
            i = bisect_right(versions.times, time) - 1
            if i >= 0 and (reset or since is None or versions.times[i] > since):
                changed.append((place, versions.places[i]))
        part = changed[first : first + MAX_TILES]
        return {
            "map_id": shown.map_id,
            "resolution": shown.resolution,
            "began": (shown.begin - zero) / 1e9,
            "reset": reset and first == 0,
            "rows": [row for (row, _), _ in part],
            "columns": [column for (_, column), _ in part],
            "cells": b"".join(self._cells(*packed) for _, packed in part),
            "left": max(0, len(changed) - first - MAX_TILES),
        }

    def _map_at(self, time: int) -> int:
        return bisect_right(self._maps, time, key=lambda row: row.begin) - 1

    def _add_tiles(self, update: MapUpdate) -> None:
        tiles = self._maps[-1].tiles
        self._packed.seek(0, 2)
        for row, column, cells in zip(update.rows.tolist(), update.columns.tolist(), update.cells):
            packed = zlib.compress(cells.tobytes(), 1)
            versions = tiles.setdefault((row, column), _Versions())
            versions.times.append(self._time)
            versions.places.append((self._size, len(packed)))
            self._packed.write(packed)
            self._size += len(packed)

    def _cells(self, offset: int, length: int) -> bytes:
        self._packed.seek(offset)
        return zlib.decompress(self._packed.read(length))


_NO_MAP = {"map_id": 0, "resolution": 0.05, "began": 0.0, "rows": [], "columns": [], "cells": b"", "left": 0}
