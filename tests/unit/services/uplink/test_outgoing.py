# SPDX-License-Identifier: Apache-2.0
"""What goes to a site: never more often than the registry says, never more bytes than the bucket, always the newest."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.uplink.coarse_map import FACTOR, MAX_TILES, CoarseMap
from services.uplink.crossing_forms import MAX_BEAMS, MAX_PLAN_POSES, thinned_plan, thinned_scan
from services.uplink.outgoing import BURST_S, OVERHEAD_BYTES, RATE_LIMITS, Level, Outgoing
from shared import topics
from shared.codec import Envelope, decode, encode
from shared.crossing import OUTWARD_KEYS
from shared.geometry import Pose2
from shared.grid import coarse_levels
from shared.messages import (
    TILE_CELLS,
    GuardState,
    GuardStatus,
    Localization,
    MapState,
    MapUpdate,
    NavState,
    NavStatus,
    Path,
    PoseEstimate,
)
from shared.robot_view import RobotView
from shared.topics import topic_of


def guard(n: int, state: GuardState = GuardState.IDLE) -> bytes:
    return encode(GuardStatus(n, state, "", "", "", 1.0), Envelope("guard", "g", n, n))


def nav(n: int) -> bytes:
    status = NavStatus(
        stamp=n, task_id=1, state=NavState.IDLE, recovery="", reason="", detail="", goal=Pose2(),
        distance_left=0.0, time_left=0.0, waypoint=0, n_waypoints=0, n_recoveries=0,
    )  # fmt: skip
    return encode(status, Envelope("navigator", "n", n, n))


def pose(n: int) -> bytes:
    message = PoseEstimate(n, Pose2(n, 0, 0), Pose2(), np.zeros((3, 3)).reshape(-1), 1.0, Localization.GOOD)
    return encode(message, Envelope("mapper", "m", n, n))


def map_update(rng: np.random.Generator, places: list[tuple[int, int]], map_id: int = 1) -> MapUpdate:
    cells = rng.choice(np.array([-1, 0, 30, 100], np.int8), (len(places), TILE_CELLS**2))
    rows, columns = np.array(places, np.int32).reshape(-1, 2).T
    return MapUpdate(0, map_id, 1, 0.05, rows.copy(), columns.copy(), cells)


def test_a_last_value_that_is_newer_than_what_is_known_goes_to_the_site():
    """The stack is started again, with a clock that was set back, and its first message came by no subscription."""
    outgoing, key = Outgoing("s"), topics.MAP_STATE.key

    def state(name, session, sequence, sent):
        return encode(MapState(sent, 1, name, ()), Envelope("mapper", session, sequence, sent))

    def sent(at):
        return [decode(MapState, payload)[0].name for sent_key, payload in outgoing.due(at) if sent_key == key]

    outgoing.take(key, state("office", "a", 3, 1000))
    assert sent(0.0) == ["office"]
    outgoing.take(key, state("office", "a", 3, 1000), kept_at=1001)
    outgoing.take(key, state("hall", "a", 2, 999), kept_at=1001)
    outgoing.take(key, state("hall", "z", 9, 999), kept_at=1001)
    assert sent(100.0) == []
    outgoing.take(key, state("plant", "b", 0, 2000), kept_at=2001)
    assert sent(200.0) == ["plant"]
    assert decode(MapState, outgoing.last_value(key, 201.0))[0].name == "plant"


@pytest.mark.parametrize("level", Level)
def test_each_topic_keeps_its_rate_and_the_newest_message_goes(level):
    outgoing, sent = Outgoing("s"), {topics.GUARD.key: [], topics.POSE.key: []}
    outgoing.set_level(level)
    for tick in range(200):  # 10 s at 20 Hz
        outgoing.take(topics.GUARD.key, guard(tick))
        outgoing.take(topics.POSE.key, pose(tick))
        for key, payload in outgoing.due(tick * 0.05):
            message, envelope = decode(topic_of(key).type, payload)
            assert message.stamp == tick
            assert envelope.sequence == len(sent[key])
            assert envelope.session == "s"
            sent[key].append(tick * 0.05)
    for key, times in sent.items():
        hz = getattr(topic_of(key).crosses, level)
        assert len(times) <= 10 * hz + 2
        assert not hz or len(times) >= 10 * hz * 0.8


def test_a_change_of_state_goes_at_once_and_flapping_is_held_to_five_a_second():
    outgoing = Outgoing("s")
    outgoing.take(topics.GUARD.key, guard(0))
    assert len(list(outgoing.due(0.0))) == 1
    outgoing.take(topics.GUARD.key, guard(1))
    assert not list(outgoing.due(0.3))
    outgoing.take(topics.GUARD.key, guard(2, GuardState.STOPPED))
    ((_, payload),) = outgoing.due(0.35)
    assert decode(GuardStatus, payload)[0].state is GuardState.STOPPED
    n = 0
    for tick in range(100):
        outgoing.take(topics.GUARD.key, guard(tick, list(GuardState)[tick % 2]))
        n += len(list(outgoing.due(1 + tick * 0.05)))
    assert n <= 5 * 5 + 1


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(Level), st.lists(st.tuples(st.sampled_from(sorted(OUTWARD_KEYS)), st.integers(0, 3))))
def test_over_any_time_no_more_bytes_go_than_the_bucket_and_one_message_allow(level, arrivals):
    outgoing, n, largest = Outgoing("s"), 0, 0
    outgoing.set_level(level)
    for tick, (_, burst) in enumerate(arrivals * 20):
        for i in range(burst):
            outgoing.take(topics.GUARD.key, guard(tick, list(GuardState)[i % 3]))
            outgoing.take(topics.POSE.key, pose(tick))
        for _, payload in outgoing.due(tick * 0.05):
            n += len(payload) + OVERHEAD_BYTES
            largest = max(largest, len(payload) + OVERHEAD_BYTES)
        assert n <= RATE_LIMITS[level] * (BURST_S + tick * 0.05) + largest


def test_a_level_without_a_topic_sends_none_of_it_and_a_late_reader_gets_the_last_value():
    outgoing = Outgoing("s")
    outgoing.take(topics.LOG.key + "/guard", b"not a message")
    outgoing.take(topics.POSE.key, pose(1))
    outgoing.take(topics.POSE.key, pose(2))
    outgoing.take(topics.POSE.key, pose(0), kept_at=2)
    assert decode(PoseEstimate, outgoing.last_value(topics.POSE.key, 0.0))[0].stamp == 2
    assert outgoing.last_value(topics.MAP_STATE.key, 0.0) == b""
    assert topics.SCAN.key not in outgoing.keys
    outgoing.set_level(Level.WATCHED)
    assert {topics.SCAN.key, topics.MAP.key, "health/guard"} <= outgoing.keys


def test_a_late_reader_counts_nothing_as_lost_that_was_sent_before_it_began():
    outgoing, view = Outgoing("s"), RobotView("red", "7")
    for tick in range(200):
        outgoing.take(topics.NAV_STATUS.key, nav(tick))
        first = [outgoing.last_value(topics.NAV_STATUS.key, 5.0)] if tick == 100 else []
        for payload in (*first, *(payload for _, payload in outgoing.due(tick * 0.05))):
            message, envelope = decode(NavStatus, payload)
            if tick < 100:
                continue
            view.add(topics.NAV_STATUS, message, envelope, tick * 0.05, tick)
    assert view.row(10.0).received == 1.0


def test_bytes_that_are_no_message_are_left_out():
    outgoing = Outgoing("s")
    outgoing.take(topics.GUARD.key, b"\xc1")
    outgoing.take("cmd/vel", guard(1))
    assert not list(outgoing.due(1.0))


@given(st.integers(0, 2**32 - 1), st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=1, max_size=12))
@settings(max_examples=15, deadline=None)
def test_the_site_ends_with_the_coarse_cells_of_the_whole_map_in_any_order_of_changes(seed, places):
    rng = np.random.default_rng(seed)
    coarse, fine, site = CoarseMap(), {}, {}
    for i in range(0, len(places), 3):
        update = map_update(rng, list(dict.fromkeys(places[i : i + 3])))
        fine |= {(int(r), int(c)): cells for r, c, cells in zip(update.rows, update.columns, update.cells)}
        coarse.take(update, i)
        while (part := coarse.part()) is not None:
            assert len(part.rows) <= MAX_TILES
            assert part.resolution == pytest.approx(0.05 * FACTOR)
            site |= {(int(r), int(c)): cells for r, c, cells in zip(part.rows, part.columns, part.cells)}
    n = TILE_CELLS // FACTOR
    for (row, column), cells in fine.items():
        tile = site.get((row // FACTOR, column // FACTOR), np.full(TILE_CELLS**2, -1, np.int8)).reshape(TILE_CELLS, -1)
        r, c = row % FACTOR * n, column % FACTOR * n
        expected = coarse_levels(cells.reshape(TILE_CELLS, TILE_CELLS), FACTOR)
        np.testing.assert_array_equal(tile[r : r + n, c : c + n], expected)


def test_unchanged_tiles_do_not_go_again_unless_a_reader_begins_and_another_map_replaces_it():
    rng, coarse = np.random.default_rng(1), CoarseMap()
    update = map_update(rng, [(0, 0), (5, 5)])
    coarse.take(update, 5)
    assert len(coarse.part().rows) == 2
    coarse.take(update, 6)
    assert coarse.part() is None
    coarse.send_again()
    assert len(coarse.part().rows) == 2
    coarse.take(map_update(rng, [(9, 9)], map_id=1), 4)  # the whole map, late: fills gaps
    coarse.take(map_update(rng, [(0, 0)], map_id=1), 4)  # older than what is there
    assert len(coarse.part().rows) == 1
    coarse.take(map_update(rng, [(1, 1)], map_id=2), 7)
    assert coarse.part().map_id == 2


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_coarse_cell_is_occupied_exactly_if_one_of_its_cells_is(seed):
    cells = np.random.default_rng(seed).integers(-1, 101, (8, 8)).astype(np.int8)
    for (row, column), level in np.ndenumerate(coarse_levels(cells, 4)):
        square = cells[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        assert (level == 100) == (square >= 65).any()
        assert (level == -1) == (square < 0).all()
        assert (level == 0) == ((square <= 25).all() and (square >= 0).any())


@given(st.integers(0, 500))
def test_a_thinned_plan_keeps_its_ends_and_its_order(n):
    xs = np.arange(n, dtype=float)
    thinned = thinned_plan(Path(0, 1, 1, "", xs, xs, np.zeros(n), 1.0, 1.0))
    assert len(thinned.xs) == min(n, MAX_PLAN_POSES)
    assert (np.diff(thinned.xs) > 0).all()
    assert not n or (thinned.xs[0], thinned.xs[-1]) == (0, n - 1)


@given(st.integers(2, 3000))
def test_the_beams_of_a_thinned_scan_have_their_own_angles(n):
    from shared.messages import LaserScan

    ranges = np.arange(n, dtype=np.float32) / 100
    scan = LaserScan(0, -1.0, 2.0 / n, 0.1, 0.1, 30.0, ranges, ranges)
    thin = thinned_scan(scan)
    assert 2 <= len(thin.ranges) <= MAX_BEAMS
    assert thin.problem() is None
    for i, distance in enumerate(thin.ranges):
        angle = thin.angle_min + i * thin.angle_increment
        assert ranges[round((angle + 1.0) / (2.0 / n))] == distance
