# SPDX-License-Identifier: Apache-2.0
"""The map as a site sees it: cells four times as wide, in four levels, and only tiles that differ."""

from collections.abc import Iterable

import numpy as np

from shared.grid import UNKNOWN, coarse_levels
from shared.messages import TILE_CELLS, MapUpdate
from shared.types import Int8s

FACTOR = 4
MAX_RESOLUTION_M = 1.0  # of MapUpdate
MAX_TILES = 16
"""tiles of one message: 64 KiB before Zenoh compresses them."""
Tile = tuple[int, int]
"""Row and column."""


class CoarseMap:
    """Takes the map's updates and gives those tiles that the site does not have."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forgets the map."""
        self._last: MapUpdate | None = None
        self._sent = 0  # ns, of the newest update
        self._tiles: dict[Tile, Int8s] = {}  # (64, 64), coarse
        self._fine: set[Tile] = set()  # places of the tiles that came
        self._behind: dict[Tile, None] = {}  # what the site lacks, in the order of changes

    def take(self, update: MapUpdate, sent: int) -> None:
        """Takes an update that was sent at `sent` (ns). A late one, as a last value is, fills gaps only."""
        last, is_late = self._last, sent < self._sent
        if last is None or (update.map_id, update.resolution) != (last.map_id, last.resolution):
            if is_late:
                return
            self.clear()
        self._sent = max(sent, self._sent)
        if not is_late or self._last is None:
            self._last = update.only(np.zeros(len(update.rows), bool))
        factor = factor_of(update.resolution)
        n = TILE_CELLS // factor
        for row, column, cells in zip(update.rows.tolist(), update.columns.tolist(), update.cells):
            if is_late and (row, column) in self._fine:
                continue
            self._fine.add((row, column))
            place = row // factor, column // factor
            tile = self._tiles.setdefault(place, np.full((TILE_CELLS, TILE_CELLS), UNKNOWN, np.int8))
            r, c = row % factor * n, column % factor * n
            coarse = coarse_levels(cells.reshape(TILE_CELLS, TILE_CELLS), factor)
            if not np.array_equal(tile[r : r + n, c : c + n], coarse):
                tile[r : r + n, c : c + n] = coarse
                self._behind[place] = None

    @property
    def is_behind(self) -> bool:
        """Whether the site lacks tiles."""
        return bool(self._behind)

    def send_again(self) -> None:
        """A reader at the site has nothing: it gets every tile."""
        self._behind |= dict.fromkeys(self._tiles)

    def part(self) -> MapUpdate | None:
        """An update with tiles that the site lacks, MAX_TILES at most; None where it has all."""
        places = list(self._behind)[:MAX_TILES]
        for place in places:
            del self._behind[place]
        return self._update(places) if places else None

    def _update(self, places: Iterable[Tile]) -> MapUpdate | None:
        last, chosen = self._last, list(places)
        if last is None:
            return None
        cells = [self._tiles[place].reshape(-1) for place in chosen]
        return MapUpdate(
            stamp=last.stamp,
            map_id=last.map_id,
            version=last.version,
            resolution=last.resolution * factor_of(last.resolution),
            rows=np.array([row for row, _ in chosen], np.int32),
            columns=np.array([column for _, column in chosen], np.int32),
            cells=np.array(cells, np.int8).reshape(len(chosen), TILE_CELLS * TILE_CELLS),
        )


def factor_of(resolution: float) -> int:
    """How many cells of `resolution` m become one along each axis."""
    return FACTOR if resolution * FACTOR <= MAX_RESOLUTION_M else 1
