# SPDX-License-Identifier: Apache-2.0
"""Maps that come and go in parts, beside the one that is in use: a copy that is fetched, and one that is given.

One of each at a time, in memory only as long as somebody asks for it or adds to it.
"""

from services.mapper.mapping import Mapping
from services.mapper.saved_map import SavedMap, packed, unpacked
from shared.config import UserError
from shared.messages import Stamp
from shared.reasons import BUSY, MAP_REFUSED, NO_GRAPH, NO_MAP, TRANSFER_BROKEN, Reason
from shared.requests import MAP_PART, FetchMap, GiveMap, MapPart, Reply
from shared.service import Answer, Job

SECOND = 1_000_000_000
ANOTHER = 5 * SECOND  # without a word from its owner, a transfer gives way to another one
FORGOTTEN = 60 * SECOND  # without a word, it is dropped


class Outgoing:
    """The copy that is being fetched."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Lets it go."""
        self.copy = 0
        self.content: bytes | None = None
        self.asked: Stamp = 0
        self.ended = True  # its last part was fetched

    def answer(self, request: FetchMap, mapping: Mapping, now: Stamp) -> Answer[MapPart]:
        """Makes a copy, or gives a part of it."""
        if request.copy == 0:
            return (yield from self._order(mapping, now))
        if request.copy != self.copy:
            return _refused(now, TRANSFER_BROKEN, "the copy is gone, or another one was made")
        self.asked = now
        if self.content is None:
            return MapPart(now, True, "", "", self.copy)
        n = -(-len(self.content) // MAP_PART)
        if request.part >= n:
            return _refused(now, TRANSFER_BROKEN, f"there is no part {request.part} of {n}")
        self.ended = request.part == n - 1
        data = self.content[request.part * MAP_PART : (request.part + 1) * MAP_PART]
        return MapPart(now, True, "", "", self.copy, n, data)

    def _order(self, mapping: Mapping, now: Stamp) -> Answer[MapPart]:
        if not self.ended and 0 <= now - self.asked < ANOTHER:
            return _refused(now, BUSY, "another copy is being fetched")
        if not mapping.has_graph:
            return _refused(now, NO_GRAPH if mapping.grid.places else NO_MAP, "")
        if mapping.drawing:
            return _refused(now, BUSY, "the map is being drawn anew")
        self.copy, self.content, self.asked, self.ended = max(now, self.copy + 1, 1), None, now, False
        yield Job(_copied, (self.copy, mapping.snapshot()), "copied", 0.3)
        return MapPart(now, True, "", "", self.copy)

    def take(self, result: tuple[int, bytes]) -> None:
        """The copy is made."""
        copy, content = result
        if copy == self.copy:
            self.content = content

    def tick(self, now: Stamp) -> None:
        """Forgets what nobody asks for."""
        if self.copy and not 0 <= now - self.asked <= FORGOTTEN:
            self.forget()


class Incoming:
    """The map that is being given: its parts, then, once it was checked, the map itself or what is wrong with it."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Lets it go."""
        self.transfer = 0
        self.n_parts = 0
        self.parts: list[bytes] = []
        self.added: Stamp = 0
        self.checked: SavedMap | str | None = None

    def add(self, request: GiveMap, now: Stamp) -> Answer[Reply]:
        """Takes the next part; the same one again is no harm, as its reply may have been lost."""
        if request.transfer != self.transfer:
            if self.transfer and self.checked is None and 0 <= now - self.added < ANOTHER:
                return Reply(now, False, BUSY.code, "another map is being given")
            if request.transfer == 0 or request.part:
                return self._broken(now, f"part {request.part + 1} came without those before it")
            self.forget()
            self.transfer, self.n_parts = request.transfer, request.parts
        at, whole = request.part, self.n_parts
        if request.parts != whole or at > len(self.parts) or (at < len(self.parts) and self.parts[at] != request.data):
            told = f"part {at + 1} of {request.parts} came, where part {len(self.parts) + 1} of {whole} was expected"
            self.forget()
            return self._broken(now, told)
        self.added = now
        if at == len(self.parts):
            self.parts.append(request.data)
            if len(self.parts) == whole:
                yield Job(_checked, (self.transfer, tuple(self.parts)), "checked", 0.3)
        return Reply(now, True, "", f"{len(self.parts)} of {whole} parts")

    def take(self, result: tuple[int, SavedMap | str]) -> None:
        """The map was checked."""
        transfer, checked = result
        if transfer == self.transfer:
            self.checked = checked

    def given(self, transfer: int, now: Stamp) -> SavedMap | Reply:
        """The map of this transfer, once; or why there is none."""
        if transfer != self.transfer:
            return self._broken(now, "this map was not given, or another one came after it")
        self.added = now
        if len(self.parts) < self.n_parts:
            return self._broken(now, f"only {len(self.parts)} of {self.n_parts} parts came")
        if self.checked is None:
            return Reply(now, False, BUSY.code, "the map is being checked")
        checked = self.checked
        self.forget()
        return Reply(now, False, MAP_REFUSED.code, checked) if isinstance(checked, str) else checked

    def tick(self, now: Stamp) -> None:
        """Forgets what nobody adds to."""
        if self.transfer and not 0 <= now - self.added <= FORGOTTEN:
            self.forget()

    @staticmethod
    def _broken(now: Stamp, told: str) -> Reply:
        return Reply(now, False, TRANSFER_BROKEN.code, told)


def _refused(now: Stamp, reason: Reason, detail: str) -> MapPart:
    return MapPart(now, False, reason.code, detail)


def _copied(copy: int, saved: SavedMap) -> tuple[int, bytes]:
    return copy, packed(saved)


def _checked(transfer: int, parts: tuple[bytes, ...]) -> tuple[int, SavedMap | str]:
    """A job that raises would end the process: what is wrong is a value."""
    try:
        saved = unpacked(b"".join(parts), "the given map")
    except UserError as error:
        return transfer, f"{error.what}; {error.mend}"
    if not saved.keyframes:
        return transfer, "the given map: holds no scan to find the robot by; map anew"
    return transfer, saved
