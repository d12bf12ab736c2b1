# SPDX-License-Identifier: Apache-2.0
"""The map's tiles, in the order of their changes, and for each page the tiles that it does not have yet."""

from collections.abc import Iterator
from typing import Any

from shared.messages import MapUpdate
from shared.types import Int8s

MAX_TILES = 64
"""tiles of one frame: 256 kB."""
Tile = tuple[int, int]
"""Row and column."""


class MapTiles:
    """The newest state of each tile. `change` counts updates, `n_maps` the maps that began."""

    def __init__(self) -> None:
        self.map_id, self.resolution, self.change, self.n_maps = 0, 0.05, 0, 0
        self._sent = 0
        self._tiles: dict[Tile, tuple[int, Int8s]] = {}  # change and cells, in the order of changes

    def add(self, update: MapUpdate, sent: int) -> None:
        """Takes an update, sent at `sent` (ns): the newest tile of each place counts. Another map starts again."""
        self.change += 1
        is_late = sent < self._sent  # a latched whole map that changes overtook
        if update.map_id != self.map_id or update.resolution != self.resolution:
            if is_late:
                return
            self.map_id, self.resolution = update.map_id, update.resolution
            self._tiles.clear()
            self.n_maps += 1
        self._sent = max(self._sent, sent)
        for row, column, cells in zip(update.rows.tolist(), update.columns.tolist(), update.cells):
            if is_late and (row, column) in self._tiles:
                continue
            self._tiles.pop((row, column), None)
            self._tiles[row, column] = self.change, cells

    def clear(self) -> None:
        """Forgets the map, when nothing more is heard of it."""
        self._tiles.clear()
        self.map_id = self._sent = 0
        self.change += 1
        self.n_maps += 1

    def since(self, change: int) -> list[Tile]:
        """The tiles that changed after a change, oldest first."""
        newest = []
        for place, (at, _) in reversed(self._tiles.items()):
            if at <= change:
                break
            newest.append(place)
        return newest[::-1]

    def cells_of(self, places: list[Tile]) -> bytes:
        """The cells of some tiles, 4096 bytes each."""
        return b"".join(self._tiles[place][1].tobytes() for place in places)


class TileFeed:
    """What one page has of the map."""

    def __init__(self, tiles: MapTiles) -> None:
        self._tiles = tiles
        self._n_maps: int | None = None
        self._change = 0

    def restart(self) -> None:
        """The page has forgotten the map."""
        self._n_maps = None

    @property
    def is_behind(self) -> bool:
        """Whether the page lacks tiles, or has those of another map."""
        changed = self._change < self._tiles.change or self._n_maps != self._tiles.n_maps
        return self._tiles.change > 0 and changed

    def frames(self) -> Iterator[dict[str, Any]]:
        """The frames `tiles` that bring the page up to date, at most MAX_TILES tiles in each.

        Each is made when it is asked for, so a slow page gets the newest cells.
        """
        reset = self._n_maps != self._tiles.n_maps
        if reset:
            self._n_maps, self._change = self._tiles.n_maps, 0
        places = self._tiles.since(self._change)
        self._change = self._tiles.change
        for begin in range(0, len(places), MAX_TILES) if places or not reset else (0,):
            if self._n_maps != self._tiles.n_maps:
                return  # another map began meanwhile
            yield self._frame(places[begin : begin + MAX_TILES], reset and begin == 0)

    def _frame(self, places: list[Tile], reset: bool) -> dict[str, Any]:
        return {
            "t": "tiles",
            "map_id": self._tiles.map_id,
            "resolution": self._tiles.resolution,
            "reset": reset,
            "rows": [row for row, _ in places],
            "columns": [column for _, column in places],
            "cells": self._tiles.cells_of(places),
        }
