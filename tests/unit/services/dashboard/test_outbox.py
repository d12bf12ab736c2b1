# SPDX-License-Identifier: Apache-2.0
"""What waits for a page: the newest of each topic, events in order up to a bound, replies never lost."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dashboard.map_tiles import MAX_TILES, MapTiles, TileFeed
from services.dashboard.outbox import MAX_EVENTS, MAX_REPLIES, Outbox, OutboxFullError
from shared.messages import MapUpdate


def waiting(outbox: Outbox) -> list[bytes]:
    return list(iter(outbox.next, None))


def test_replies_come_first_then_events_then_the_newest_messages():
    outbox = Outbox()
    for i in range(3):
        outbox.set_latest("pose", b"pose %d" % i)
        outbox.add_event(b"event %d" % i)
    outbox.set_latest("scan", b"scan")
    outbox.add_reply(b"reply")
    assert waiting(outbox) == [b"reply", b"event 0", b"event 1", b"event 2", b"pose 2", b"scan"]
    assert waiting(outbox) == []


def test_what_a_page_wants_no_more_is_forgotten():
    outbox = Outbox()
    outbox.set_latest("pose", b"pose")
    outbox.set_latest("scan", b"scan")
    outbox.drop({"pose", "odom"})
    assert waiting(outbox) == [b"scan"]


def test_the_oldest_events_are_dropped_and_too_many_replies_are_an_error():
    outbox = Outbox()
    for i in range(MAX_EVENTS + 5):
        outbox.add_event(b"%d" % i)
    assert waiting(outbox)[0] == b"5"
    for _ in range(MAX_REPLIES):
        outbox.add_reply(b"")
    with pytest.raises(OutboxFullError):
        outbox.add_reply(b"")


def update(map_id: int, tiles: dict[tuple[int, int], int]) -> MapUpdate:
    rows, columns = (np.array([place[axis] for place in tiles], np.int32) for axis in (0, 1))
    cells = np.repeat(np.array(list(tiles.values()), np.int8)[:, None], 4096, axis=1).reshape(len(tiles), 4096)
    return MapUpdate(1, map_id, 1, 0.05, rows, columns, cells)


class Shown:
    """A page's map: what the frames make of it."""

    def __init__(self, tiles: MapTiles) -> None:
        self.feed, self.cells = TileFeed(tiles), dict[tuple[int, int], int]()

    def take(self) -> None:
        for frame in self.feed.frames() if self.feed.is_behind else ():
            assert len(frame["rows"]) <= MAX_TILES
            if frame["reset"]:
                self.cells.clear()
            for i, place in enumerate(zip(frame["rows"], frame["columns"], strict=True)):
                self.cells[place] = frame["cells"][4096 * i]


places = st.tuples(st.integers(-3, 3), st.integers(-3, 3))
steps = st.lists(
    st.tuples(st.integers(1, 2), st.dictionaries(places, st.integers(0, 100), max_size=20), st.booleans()), max_size=12
)


@given(steps)
def test_each_page_has_the_newest_cells_of_the_newest_map_whenever_it_looked(steps):
    tiles, truth, map_id = MapTiles(), dict[tuple[int, int], int](), 0
    always, seldom = Shown(tiles), Shown(tiles)
    for sent, (id_, changed, looks) in enumerate(steps, 1):
        truth = {**(truth if id_ == map_id else {}), **changed}
        map_id = id_
        tiles.add(update(id_, changed), sent)
        always.take()
        assert always.cells == truth
        if looks:
            seldom.take()
            assert seldom.cells == truth


def test_a_late_whole_map_fills_gaps_and_replaces_no_newer_tile():
    tiles = MapTiles()
    page = Shown(tiles)
    tiles.add(update(1, {(0, 0): 50}), sent=10)
    tiles.add(update(1, {(0, 0): 10, (0, 1): 20}), sent=5)
    page.take()
    assert page.cells == {(0, 0): 50, (0, 1): 20}
