# SPDX-License-Identifier: Apache-2.0
"""Transfer of maps in parts: the download of the present map, and the upload of another one.

There is one transfer of each kind at a time, in memory only while its client sends requests.
"""

import numpy as np

from services.mapper.maps.map_file import SavedMap, pack_map, unpack_map
from services.mapper.slam import Slam
from shared.config import UserError
from shared.grid import OCCUPIED_FROM
from shared.messages import MapMode, MapUpdate, Stamp
from shared.reasons import BUSY, MAP_REFUSED, NO_GRAPH, NO_MAP, TRANSFER_BROKEN, Reason
from shared.requests import MAP_PART, FetchMap, GiveMap, MapPart, Reply
from shared.service import Answer, Job
from shared.types import NS_PER_S

TAKEOVER_NS = 5 * NS_PER_S  # without a request, after which another client may begin a transfer
TIMEOUT_NS = 60 * NS_PER_S  # without a request, after which a transfer ends
MAX_TILES = 20_000  # of a saved map, 80 MB of cells: a square of 450 m at 0.05 m per cell


def tiles_problem(tiles: MapUpdate) -> str | None:
    """Returns why no robot can be found on tiles without a graph, or None."""
    rows, columns = tiles.rows, tiles.columns
    if len(rows) and (int(np.ptp(rows)) + 1) * (int(np.ptp(columns)) + 1) > MAX_TILES:
        return "the map's tiles lie too far apart to be one building"
    return None if (tiles.cells >= OCCUPIED_FROM).any() else "the map holds no occupied cell to find the robot by"


def present_map_refusal(slam: Slam, mode: MapMode, now: Stamp) -> Reply | None:
    """Returns why a mode cannot begin on the present map, or None: it is being redrawn, or there is none to stay."""
    if slam.is_drawing:
        return Reply(now, False, BUSY.code, "the map is being redrawn")
    if mode is MapMode.LOCALISE and not slam.grid.tile_index:
        return Reply(now, False, NO_MAP.code, "")
    return None


class MapDownload:
    """A copy of the map that a client fetches in parts."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Drops the copy."""
        self.copy = 0  # its number
        self.content: bytes | None = None
        self.requested_at: Stamp = 0
        self.is_complete = True  # the last part was fetched

    def answer(self, request: FetchMap, slam: Slam, now: Stamp) -> Answer[MapPart]:
        """Orders a copy of the map, or returns a part of it."""
        if request.copy == 0:
            return (yield from self._begin(slam, now))
        if request.copy != self.copy:
            return _refusal(now, TRANSFER_BROKEN, "the copy is gone, or another one was made")
        self.requested_at = now
        if self.content is None:
            return MapPart(now, True, "", "", self.copy)
        n = -(-len(self.content) // MAP_PART)
        if request.part >= n:
            return _refusal(now, TRANSFER_BROKEN, f"there is no part {request.part} of {n}")
        self.is_complete = request.part == n - 1
        part = self.content[request.part * MAP_PART : (request.part + 1) * MAP_PART]
        return MapPart(stamp=now, accepted=True, reason="", detail="", copy=self.copy, parts=n, data=part)

    def _begin(self, slam: Slam, now: Stamp) -> Answer[MapPart]:
        if not self.is_complete and 0 <= now - self.requested_at < TAKEOVER_NS:
            return _refusal(now, BUSY, "another copy is being fetched")
        if not slam.has_graph:
            return _refusal(now, NO_GRAPH if slam.grid.tile_index else NO_MAP, "")
        if slam.is_drawing:
            return _refusal(now, BUSY, "the map is being redrawn")
        self.copy, self.content = max(now, self.copy + 1, 1), None
        self.requested_at, self.is_complete = now, False
        yield Job(_pack, (self.copy, slam.snapshot()), "on_map_packed", 0.3)
        return MapPart(now, True, "", "", self.copy)

    def on_map_packed(self, result: tuple[int, bytes]) -> None:
        """Stores the content of the copy."""
        copy, content = result
        if copy == self.copy:
            self.content = content

    def tick(self, now: Stamp) -> None:
        """Drops a copy after TIMEOUT_NS without a request."""
        if self.copy and not 0 <= now - self.requested_at <= TIMEOUT_NS:
            self.reset()


class MapUpload:
    """A map that a client gives in parts, and then the validated map or its error."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Drops the parts."""
        self.transfer = 0  # its number
        self.n_parts = 0
        self.resumes = False  # the graph of the present map, from before a restart
        self.parts: list[bytes] = []
        self.requested_at: Stamp = 0
        self.result: SavedMap | str | None = None  # of the validation

    def add(self, request: GiveMap, now: Stamp) -> Answer[Reply]:
        """Adds the next part. The same part again is accepted, as its reply may have been lost."""
        if request.transfer != self.transfer:
            if self.transfer and self.result is None and 0 <= now - self.requested_at < TAKEOVER_NS:
                return Reply(now, False, BUSY.code, "another map is being given")
            if request.transfer == 0 or request.part:
                return self._failure(now, f"part {request.part + 1} came without those before it")
            self.reset()
            self.transfer, self.n_parts, self.resumes = request.transfer, request.parts, request.resumes
        at, n = request.part, self.n_parts
        if request.parts != n or at > len(self.parts) or (at < len(self.parts) and self.parts[at] != request.data):
            detail = f"part {at + 1} of {request.parts} came, where part {len(self.parts) + 1} of {n} was expected"
            self.reset()
            return self._failure(now, detail)
        self.requested_at = now
        if at == len(self.parts):
            self.parts.append(request.data)
            if len(self.parts) == n:
                yield Job(_validate, (self.transfer, tuple(self.parts)), "on_map_validated", 0.3)
        return Reply(now, True, "", f"{len(self.parts)} of {n} parts")

    def on_map_validated(self, result: tuple[int, SavedMap | str]) -> None:
        """Stores the validated map, or its error."""
        transfer, validated = result
        if transfer == self.transfer:
            self.result = validated

    def take_map(self, transfer: int, now: Stamp) -> SavedMap | Reply:
        """Returns the map of a transfer once, and drops it; before that, or after an error, the refusal."""
        if transfer != self.transfer:
            return self._failure(now, "this map was not given, or another one came after it")
        self.requested_at = now
        if len(self.parts) < self.n_parts:
            return self._failure(now, f"only {len(self.parts)} of {self.n_parts} parts came")
        if self.result is None:
            return Reply(now, False, BUSY.code, "the map is being checked")
        result = self.result
        self.reset()
        return Reply(now, False, MAP_REFUSED.code, result) if isinstance(result, str) else result

    def tick(self, now: Stamp) -> None:
        """Drops a map after TIMEOUT_NS without a request."""
        if self.transfer and not 0 <= now - self.requested_at <= TIMEOUT_NS:
            self.reset()

    @staticmethod
    def _failure(now: Stamp, detail: str) -> Reply:
        return Reply(now, False, TRANSFER_BROKEN.code, detail)


def _refusal(now: Stamp, reason: Reason, detail: str) -> MapPart:
    return MapPart(now, False, reason.code, detail)


def _pack(copy: int, saved: SavedMap) -> tuple[int, bytes]:
    return copy, pack_map(saved)


def _validate(transfer: int, parts: tuple[bytes, ...]) -> tuple[int, SavedMap | str]:
    """Returns the map, or its error as text: a job that raises would end the process."""
    try:
        saved = unpack_map(b"".join(parts), "the given map")
    except UserError as error:
        return transfer, f"{error.what}; {error.hint}"
    if not saved.keyframes:
        return transfer, "the given map: holds no scan to find the robot by; map again"
    return transfer, saved
