# SPDX-License-Identifier: Apache-2.0
"""A map that goes out in parts comes back to the same bytes; any other transfer is refused, and harms nothing."""

from dataclasses import replace
from itertools import pairwise

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mapper.saved_map import MAGIC, SavedMap, packed, unpacked
from services.mapper.transfer import Incoming
from shared import reasons, requests
from shared.geometry import Pose2
from shared.messages import MapMode
from shared.requests import MAP_PART, FetchMap, GiveMap, LoadMap, Reply, StartMap
from shared.service import Job
from tests.unit.services.mapper.rooms import LAP, RING, START, Asker, Driven, laps
from tests.unit.services.mapper.test_saved_map import made
from zenav.drive import RefusedError
from zenav.map_transfer import AGAIN, PATIENCE, fetched, started
from zenav.map_transfer import given as given_to

SECOND = 1_000_000_000


def ring(motions):
    driven = Driven(RING, noise=0.01)
    driven.true = START
    for _, motion in zip(range(motions), laps()):
        driven.step(motion)
        driven.publish_map()
    return driven, Asker(driven)


@pytest.fixture(scope="module")
def lap():
    """A map of the ring, fetched."""
    driven, asker = ring(LAP + 20)
    return fetched(asker, asker.wait), driven.first


def test_a_fetched_map_is_given_and_fetched_again_to_the_same_bytes(lap):
    content, _ = lap
    driven, asker = ring(1)
    started(asker, asker.wait, MapMode.LOCALISE, given_to(asker, asker.wait, content))
    assert fetched(asker, asker.wait) == content
    assert driven.mapper.state().startswith("localise: ") or driven.mapper.state() == "waiting for a scan"


def feed(incoming, message, now=0):
    """The reply, and the result of the job that came with it."""
    answering = incoming.add(message, now)
    while True:
        try:
            job = next(answering)
            assert isinstance(job, Job)
            incoming.take(job.function(*job.arguments))
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
    content = packed(made(seed, n))
    places = sorted({cut % len(content) for cut in cuts} | {0, len(content)})
    parts = [content[a:b] for a, b in pairwise(places)]
    incoming = Incoming()
    for k, data in enumerate(parts):
        for _ in range(again.draw(st.integers(1, 2))):
            assert feed(incoming, GiveMap(0, 7, k, len(parts), data)).accepted
    saved = incoming.given(7, 0)
    assert isinstance(saved, SavedMap)
    assert packed(saved) == content
    assert not incoming.parts, "nothing of it is kept"
    assert incoming.given(7, 0).reason == reasons.TRANSFER_BROKEN.code, "it is given once"


PARTS = 4
MESSAGES = st.tuples(st.integers(1, 2), st.integers(0, PARTS - 1), st.booleans(), st.integers(0, 10))


@settings(max_examples=150, deadline=None)
@given(steps=st.lists(MESSAGES, max_size=14))
def test_whatever_comes_in_whatever_order_only_a_whole_map_is_taken(steps):
    content = packed(made(1, 3))
    size = -(-len(content) // PARTS)
    parts = [content[k * size : (k + 1) * size] for k in range(PARTS)]
    incoming, now = Incoming(), 0
    for transfer, k, whole, later in steps:
        now += later * SECOND
        data = parts[k] if whole else parts[k][:-1] + bytes([parts[k][-1] ^ 1])
        feed(incoming, GiveMap(now, transfer, k, PARTS, data), now)
        assert sum(map(len, incoming.parts)) <= len(content)
        got = incoming.given(transfer, now)
        if isinstance(got, SavedMap):
            assert packed(got) == content
        else:
            assert not got.accepted
            assert reasons.REASONS[got.reason].mend


def coarse(saved):
    return replace(saved, tiles=replace(saved.tiles, resolution=0.1))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (lambda c: c[:-1], "damaged"),
        (lambda c: c[: len(c) // 2] + bytes((c[len(c) // 2] ^ 1,)) + c[len(c) // 2 + 1 :], "checksum"),
        (lambda c: msgpack.packb((MAGIC, 2, b"?", b"")), "format 2"),
        (lambda c: b"P5 a picture", "not a saved map"),
        (lambda c: packed(made(0, 0)), "no scan"),
        (lambda c: packed(coarse(unpacked(c, "it"))), "0.1 m a cell"),
    ],
)
def test_a_damaged_map_is_refused_in_one_line_and_the_running_one_is_untouched(lap, content, told):
    driven, asker = ring(5)
    before = fetched(asker, asker.wait)
    transfer = given_to(asker, asker.wait, content(lap[0]))
    with pytest.raises(RefusedError, match=told) as error:
        started(asker, asker.wait, MapMode.LOCALISE, transfer)
    assert "\n" not in error.value.what
    assert error.value.mend
    assert fetched(asker, asker.wait) == before
    assert driven.mapper.mapping.mode is MapMode.MAP


def test_an_interrupted_transfer_is_forgotten_and_another_one_may_come():
    incoming = Incoming()
    assert feed(incoming, GiveMap(0, 1, 0, 2, b"a"), 0).accepted
    assert feed(incoming, GiveMap(0, 2, 0, 1, b"b"), SECOND).reason == reasons.BUSY.code
    assert feed(incoming, GiveMap(0, 1, 0, 2, b"other"), SECOND).reason == reasons.TRANSFER_BROKEN.code
    assert feed(incoming, GiveMap(0, 3, 0, 2, b"c"), SECOND).accepted
    incoming.tick(70 * SECOND)
    assert not incoming.parts
    assert incoming.given(3, 70 * SECOND).reason == reasons.TRANSFER_BROKEN.code


def test_a_copy_is_one_at_a_time_and_let_go_of():
    driven, asker = ring(5)
    mapper = driven.mapper

    def ask(copy, part):
        return asker.ask(type("Row", (), {"key": "request/fetch_map"}), FetchMap(driven.now, copy, part))

    first = ask(0, 0)
    assert first.accepted
    assert ask(0, 0).reason == reasons.BUSY.code
    driven.now += 6 * SECOND
    second = ask(0, 0)
    assert second.accepted
    assert ask(first.copy, 0).reason == reasons.TRANSFER_BROKEN.code
    part = ask(second.copy, 0)
    assert (part.accepted, part.parts) == (True, 1)
    assert 0 < len(part.data) <= MAP_PART
    assert ask(second.copy, 1).reason == reasons.TRANSFER_BROKEN.code
    driven.now += 61 * SECOND
    driven.publish_map()
    assert mapper.outgoing.content is None
    assert ask(second.copy, 0).reason == reasons.TRANSFER_BROKEN.code


def test_a_mapper_without_a_graph_says_what_mends_that():
    driven = Driven(RING)
    driven.true = START
    asker = Asker(driven)
    with pytest.raises(RefusedError) as error:
        fetched(asker, asker.wait)
    assert error.value.code == reasons.NO_MAP.code
    for _, motion in zip(range(3), laps()):
        driven.step(motion)
        driven.publish_map()
    grid = driven.mapper.grid
    driven.busy = True  # the keyframes are cast beside the scans
    assert asker.ask(requests.LOAD_MAP, LoadMap(driven.now, grid.whole(driven.now), Pose2())).accepted
    with pytest.raises(RefusedError) as error:
        fetched(asker, asker.wait)
    assert error.value.code == reasons.NO_GRAPH.code
    driven.busy = False
    driven.work()
    assert unpacked(fetched(asker, asker.wait), "its map").graph.fixed.all()


def test_a_mapper_that_stays_busy_is_not_waited_for_for_ever():
    waited = []

    class Busy:
        def now(self):
            return 1

        def ask(self, request, message):
            return Reply(1, False, reasons.BUSY.code, "")

    with pytest.raises(RefusedError):
        started(Busy(), waited.append, MapMode.LOCALISE)
    assert PATIENCE <= sum(waited) < PATIENCE + 2 * AGAIN


def test_a_start_that_makes_no_sense_is_no_message():
    assert StartMap(0, MapMode.MAP, 3).problem()
    assert StartMap(0, MapMode.LOCALISE, 3, (START, START)).problem()
    assert GiveMap(0, 1, 2, 2, b"").problem()
    assert GiveMap(0, 1, 0, 2, bytes(MAP_PART + 1)).problem()
    assert GiveMap(0, 1, 1, 2, bytes(MAP_PART)).problem() is None
