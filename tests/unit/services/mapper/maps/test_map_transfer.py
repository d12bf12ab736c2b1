# SPDX-License-Identifier: Apache-2.0
"""A map that goes out in parts comes back to the same bytes; any other transfer is refused, and harms nothing."""

from dataclasses import replace
from itertools import pairwise

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mapper.maps.map_file import MAGIC, SavedMap, pack_map, unpack_map
from services.mapper.maps.map_transfer import MapUpload
from shared import reasons, requests
from shared.geometry import Pose2
from shared.messages import MapMode
from shared.requests import MAP_PART, FetchMap, GiveMap, LoadMap, Reply, StartMap
from shared.service import Job
from shared.types import NS_PER_S
from tests.unit.services.mapper.maps.test_map_file import made
from tests.unit.services.mapper.rooms import LAP, RING, START, MapRequester, RoomDrive, laps
from zenav.client.map_transfer import MAX_WAIT_S, RETRY_PERIOD_S, fetch_map, start_mode
from zenav.client.map_transfer import give_map as given_to
from zenav.client.navigation_client import RequestRefusedError


def ring(motions):
    driven = RoomDrive(RING, noise=0.01)
    driven.true = START
    for _, motion in zip(range(motions), laps()):
        driven.step(motion)
        driven.publish_map()
    return driven, MapRequester(driven)


@pytest.fixture(scope="module")
def lap():
    """A map of the ring, fetched."""
    driven, asker = ring(LAP + 20)
    return fetch_map(asker, asker.wait), driven.first


def test_a_fetched_map_is_given_and_fetched_again_to_the_same_bytes(lap):
    content, _ = lap
    driven, asker = ring(1)
    start_mode(asker, asker.wait, MapMode.LOCALISE, given_to(asker, asker.wait, content))
    assert fetch_map(asker, asker.wait) == content
    assert driven.mapper.state().startswith("localise: ") or driven.mapper.state() == "waiting for a scan"


def feed(upload, message, now=0):
    """The reply, and the result of the job that came with it."""
    answering = upload.add(message, now)
    while True:
        try:
            job = next(answering)
            assert isinstance(job, Job)
            upload.on_map_validated(job.function(*job.arguments))
        except StopIteration as end:
            return end.value


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 9),
    cuts=st.lists(st.integers(1, 20_000), max_size=6),
    again=st.data(),
)
def test_a_map_in_parts_of_any_size_even_if_some_come_twice_is_the_map(seed, n, cuts, again):
    content = pack_map(made(seed, n))
    places = sorted({cut % len(content) for cut in cuts} | {0, len(content)})
    parts = [content[a:b] for a, b in pairwise(places)]
    upload = MapUpload()
    for k, data in enumerate(parts):
        for _ in range(again.draw(st.integers(1, 2))):
            assert feed(upload, GiveMap(0, 7, k, len(parts), data)).accepted
    saved = upload.take_map(7, 0)
    assert isinstance(saved, SavedMap)
    assert pack_map(saved) == content
    assert not upload.parts, "nothing of it is kept"
    assert upload.take_map(7, 0).reason == reasons.TRANSFER_BROKEN.code, "it is given once"


PARTS = 4
MESSAGES = st.tuples(st.integers(1, 2), st.integers(0, PARTS - 1), st.booleans(), st.integers(0, 10))


@settings(max_examples=150, deadline=None)
@given(steps=st.lists(MESSAGES, max_size=14))
def test_whatever_comes_in_whatever_order_only_a_whole_map_is_taken(steps):
    content = pack_map(made(1, 3))
    size = -(-len(content) // PARTS)
    parts = [content[k * size : (k + 1) * size] for k in range(PARTS)]
    upload, now = MapUpload(), 0
    for transfer, k, whole, later in steps:
        now += later * NS_PER_S
        data = parts[k] if whole else parts[k][:-1] + bytes([parts[k][-1] ^ 1])
        feed(upload, GiveMap(now, transfer, k, PARTS, data), now)
        assert sum(map(len, upload.parts)) <= len(content)
        got = upload.take_map(transfer, now)
        if isinstance(got, SavedMap):
            assert pack_map(got) == content
        else:
            assert not got.accepted
            assert reasons.REASONS[got.reason].hint


def coarse(saved):
    return replace(saved, tiles=replace(saved.tiles, resolution=0.1))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (lambda c: c[:-1], "damaged"),
        (lambda c: c[: len(c) // 2] + bytes((c[len(c) // 2] ^ 1,)) + c[len(c) // 2 + 1 :], "checksum"),
        (lambda c: msgpack.packb((MAGIC, 3, b"?", b"")), "format 3"),
        (lambda c: b"P5 a picture", "not a saved map"),
        (lambda c: pack_map(made(0, 0)), "no scan"),
        (lambda c: pack_map(coarse(unpack_map(c, "it"))), "0.1 m a cell"),
    ],
)
def test_a_damaged_map_is_refused_in_one_line_and_the_running_one_is_untouched(lap, content, told):
    driven, asker = ring(5)
    before = fetch_map(asker, asker.wait)
    transfer = given_to(asker, asker.wait, content(lap[0]))
    with pytest.raises(RequestRefusedError, match=told) as error:
        start_mode(asker, asker.wait, MapMode.LOCALISE, transfer)
    assert "\n" not in error.value.what
    assert error.value.hint
    assert fetch_map(asker, asker.wait) == before
    assert driven.mapper.slam.mode is MapMode.MAP


def test_an_interrupted_transfer_is_forgotten_and_another_one_may_come():
    upload = MapUpload()
    assert feed(upload, GiveMap(0, 1, 0, 2, b"a"), 0).accepted
    assert feed(upload, GiveMap(0, 2, 0, 1, b"b"), NS_PER_S).reason == reasons.BUSY.code
    assert feed(upload, GiveMap(0, 1, 0, 2, b"other"), NS_PER_S).reason == reasons.TRANSFER_BROKEN.code
    assert feed(upload, GiveMap(0, 3, 0, 2, b"c"), NS_PER_S).accepted
    upload.tick(70 * NS_PER_S)
    assert not upload.parts
    assert upload.take_map(3, 70 * NS_PER_S).reason == reasons.TRANSFER_BROKEN.code


def test_a_copy_is_one_at_a_time_and_let_go_of():
    driven, asker = ring(5)
    mapper = driven.mapper

    def ask(copy, part):
        return asker.ask(type("Row", (), {"key": "request/fetch_map"}), FetchMap(driven.now, copy, part))

    first = ask(0, 0)
    assert first.accepted
    assert ask(0, 0).reason == reasons.BUSY.code
    driven.now += 6 * NS_PER_S
    second = ask(0, 0)
    assert second.accepted
    assert ask(first.copy, 0).reason == reasons.TRANSFER_BROKEN.code
    part = ask(second.copy, 0)
    assert (part.accepted, part.parts) == (True, 1)
    assert 0 < len(part.data) <= MAP_PART
    assert ask(second.copy, 1).reason == reasons.TRANSFER_BROKEN.code
    driven.now += 61 * NS_PER_S
    driven.publish_map()
    assert mapper.download.content is None
    assert ask(second.copy, 0).reason == reasons.TRANSFER_BROKEN.code


def test_a_mapper_without_a_graph_says_what_mends_that():
    driven = RoomDrive(RING)
    driven.true = START
    asker = MapRequester(driven)
    with pytest.raises(RequestRefusedError) as error:
        fetch_map(asker, asker.wait)
    assert error.value.code == reasons.NO_MAP.code
    for _, motion in zip(range(3), laps()):
        driven.step(motion)
        driven.publish_map()
    grid = driven.mapper.slam.grid
    driven.busy = True  # the keyframes are cast beside the scans
    assert asker.ask(requests.LOAD_MAP, LoadMap(driven.now, grid.all_tiles(driven.now), Pose2())).accepted
    with pytest.raises(RequestRefusedError) as error:
        fetch_map(asker, asker.wait)
    assert error.value.code == reasons.NO_GRAPH.code
    driven.busy = False
    driven.work()
    assert unpack_map(fetch_map(asker, asker.wait), "its map").graph.fixed.all()


def test_a_mapper_that_stays_busy_is_not_waited_for_for_ever():
    waited = []

    class Busy:
        def now(self):
            return 1

        def ask(self, request, message):
            return Reply(1, False, reasons.BUSY.code, "")

    with pytest.raises(RequestRefusedError):
        start_mode(Busy(), waited.append, MapMode.LOCALISE)
    assert MAX_WAIT_S <= sum(waited) < MAX_WAIT_S + 2 * RETRY_PERIOD_S


def test_a_start_that_makes_no_sense_is_no_message():
    assert StartMap(0, MapMode.MAP, 3).problem()
    assert StartMap(0, MapMode.LOCALISE, 3, (START, START)).problem()
    assert GiveMap(0, 1, 2, 2, b"").problem()
    assert GiveMap(0, 1, 0, 2, bytes(MAP_PART + 1)).problem()
    assert GiveMap(0, 1, 1, 2, bytes(MAP_PART)).problem() is None
