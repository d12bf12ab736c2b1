# SPDX-License-Identifier: Apache-2.0
"""A robot anywhere in a saved building is found by driving; where it could be elsewhere too, nothing is claimed."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from services.mapper.localization.global_localization import MAX_PART_INTERVAL_M, PoseHypothesis
from services.mapper.maps.map_file import pack_map
from shared.geometry import Pose2
from shared.messages import Localization
from shared.types import NS_PER_S
from tests.unit.services.mapper.buildings import ALIKE, SHUT, START, Building, drives, off, put, saved_by
from tests.unit.services.mapper.rooms import ROOM, RoomDrive

METRES = 10


@pytest.fixture(scope="module")
def building():
    """Two rooms that look alike at a corridor that does not, its map, and where that lies in it."""
    alike = Building(ALIKE, (START.x, START.y))
    driven = RoomDrive(ALIKE, noise=0.01)
    driven.true = START
    for _ in drives(driven, alike, 60, np.random.default_rng(0)):
        pass
    return alike, saved_by(driven), driven.first


def test_from_anywhere_it_is_found_by_driving_and_never_at_a_wrong_place(building):
    alike, saved, first = building
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        driven = put(ALIKE, saved, alike.anywhere(rng))
        n_known = 0
        for _ in drives(driven, alike, METRES, rng):
            known = driven.poses[-1].state is Localization.GOOD
            assert known or n_known == 0, "once found, it is not lost again"
            n_known += known
            if known:
                away, turn = off(driven, first)
                assert away < 0.15
                assert turn < 0.06
            if n_known > 5:
                break
        found.append(n_known > 0)
    assert sum(found) >= 7


def test_nothing_is_claimed_on_the_first_scans(building):
    alike, saved, _ = building
    rng = np.random.default_rng(3)
    driven = put(ALIKE, saved, alike.anywhere(rng))
    for metres in drives(driven, alike, 1.0, rng):
        assert metres < 1.2
    assert {estimate.state for estimate in driven.poses} == {Localization.LOST}
    assert driven.poses[-1].covariance[0] >= 1e4


@pytest.mark.parametrize("seed", [0, 1])
def test_shut_in_a_room_that_has_a_double_it_is_never_sure(building, seed):
    _, saved, _ = building
    shut = Building(SHUT, (3.0, 2.5))
    rng = np.random.default_rng(seed)
    driven = put(ALIKE, saved, shut.anywhere(rng))
    for _ in drives(driven, shut, 6, rng):
        assert driven.poses[-1].state is Localization.LOST


def test_in_another_building_it_is_never_found(building):
    _, saved, _ = building
    other = Building(ROOM, (0.0, 0.0))
    rng = np.random.default_rng(5)
    driven = put(ROOM, saved, other.anywhere(rng))
    for _ in drives(driven, other, 5, rng):
        assert driven.poses[-1].state is Localization.LOST
    assert not any("found" in line for line in driven.logs)


def test_the_map_stays_to_the_byte_while_the_robot_drives_on_it(building):
    alike, saved, first = building
    before = pack_map(saved)
    rng = np.random.default_rng(1)
    driven = put(ALIKE, saved, START)
    n_first = len(driven.maps)
    for _ in drives(driven, alike, 40, rng):
        pass
    driven.now += 60_000_000_000
    driven.publish_map()
    assert driven.poses[-1].state is Localization.GOOD
    assert driven.mapper.back_end.n_loops > 20
    assert pack_map(saved) == before
    assert len(driven.maps) == n_first == 1
    np.testing.assert_array_equal(driven.mapper.slam.grid.all_tiles(0).cells, saved.tiles.cells)
    back_end = driven.mapper.back_end
    n = len(saved.keyframes)
    np.testing.assert_array_equal(back_end.graph.poses[:n], saved.graph.poses)
    assert len(back_end.keyframes) <= n + back_end.config.max_localization_keyframes
    assert back_end.graph.n_edges < n + 10 * back_end.config.max_localization_keyframes, "it does not grow with time"
    assert off(driven, first)[0] < 0.06


def test_where_the_robot_goes_on_nothing_jumps_but_once_when_it_is_found(building):
    alike, saved, _ = building
    rng = np.random.default_rng(2)
    driven = put(ALIKE, saved, START)
    for _ in drives(driven, alike, 25, rng):
        pass
    jumps = [
        a.map_from_odom.distance(b.map_from_odom)
        for a, b in pairwise(driven.poses)
        if Localization.LOST not in (a.state, b.state)
    ]
    assert max(jumps) < 0.3, "odometry's own drift, and small corrections"


def test_where_nothing_of_the_map_holds_the_pose_it_is_poor(building):
    alike, saved, _ = building
    driven = put(ALIKE, saved, START, max_path_without_closure=2.0, loop_closure={"search_interval": 20})
    for _ in drives(driven, alike, 16, np.random.default_rng(2)):
        pass
    states = [estimate.state for estimate in driven.poses]
    assert Localization.GOOD in states
    assert states[-1] is Localization.POOR


def test_who_is_carried_away_is_found_again(building):
    alike, saved, first = building
    rng = np.random.default_rng(4)
    driven = put(ALIKE, saved, START)
    for _ in drives(driven, alike, 8, rng):
        pass
    assert driven.poses[-1].state is Localization.GOOD
    there = Pose2(13.0, 6.0, 2.0)
    driven.odom_from_start = driven.odom_from_start @ driven.true @ there.inverse()  # its wheels did not turn
    driven.true = there
    n = len(driven.poses)
    for _ in drives(driven, alike, 12, rng):
        pass
    assert any(estimate.state is Localization.LOST for estimate in driven.poses[n : n + 15])
    assert driven.poses[-1].state is Localization.GOOD
    assert off(driven, first)[0] < 0.15


def test_who_is_carried_while_it_stands_into_the_like_of_its_room_is_lost_although_everything_fits(building):
    alike, saved, _ = building
    rng = np.random.default_rng(4)
    driven = put(ALIKE, saved, START)
    for metres in drives(driven, alike, 60, rng):
        if metres > 8 and 2 < driven.true.x < 5 and 1.5 < driven.true.y < 4:
            break
    for _ in range(3):
        driven.step(Pose2())
    assert driven.poses[-1].state is Localization.GOOD
    there = Pose2(driven.true.x + 7.45, driven.true.y, driven.true.yaw + 0.2)
    driven.odom_from_start = driven.odom_from_start @ driven.true @ there.inverse()
    driven.true = there
    n = len(driven.poses)
    for _ in range(10):
        driven.step(Pose2())
    assert Localization.LOST in {estimate.state for estimate in driven.poses[n:]}


@pytest.mark.parametrize(("best", "rival", "believed"), [(0.87, 0.7, False), (0.99, 0.97, False), (0.99, 0.88, True)])
def test_a_place_is_believed_where_little_speaks_against_it_beside_what_speaks_against_the_next(
    building, best, rival, believed
):
    """In a row of like rooms a box that was moved speaks against the right one, too."""
    _, saved, _ = building
    driven = put(ALIKE, saved, START)
    localizer = driven.mapper.slam.localizer
    driven.step(Pose2())
    for metres in range(4):
        localizer.searched_at = float(metres)
        found = localizer.accepted_pose(
            (localizer.epoch, [PoseHypothesis(Pose2(1, 1), best, True), PoseHypothesis(Pose2(1, 6), rival, True)], 0.0)
        )
    assert (found is not None) is believed


@pytest.mark.parametrize("part_about", [None, Pose2()])
def test_only_for_a_part_searches_become_rarer_while_they_find_nothing(building, part_about):
    _, saved, _ = building
    driven = put(ALIKE, saved, START)
    driven.step(Pose2())
    localizer = driven.mapper.slam.localizer
    keyframe, *others = localizer.pending[-1]
    localizer.load(saved, part_about)
    searched_at = []
    for step in range(2500):
        moved = replace(keyframe, local_from_base=Pose2(0.1 * step, 0, 0), stamp=keyframe.stamp + step * NS_PER_S)
        for _ in localizer.add_keyframe(moved, *others):
            searched_at.append(0.1 * step)
            found = [PoseHypothesis(Pose2(), 0.9, step > 2300), PoseHypothesis(Pose2(9), 0.9, False)]
            assert localizer.accepted_pose((localizer.epoch, found, 0.01)) is None
    at = np.array(searched_at)
    intervals, found_before = np.diff(at), at[:-1] > 230
    normal = localizer.config.search_interval
    assert intervals[found_before] == pytest.approx(normal, abs=0.11)
    if part_about is None:
        assert intervals == pytest.approx(normal, abs=0.11)
    else:
        fruitless = intervals[~found_before]
        assert (np.diff(fruitless) > -0.11).all()
        assert fruitless[-1] == pytest.approx(MAX_PART_INTERVAL_M, abs=0.11)


@pytest.mark.parametrize(("rival", "waits"), [(0.97, True), (0.8, False)])
def test_after_a_long_search_the_next_one_waits_unless_it_confirms_a_place(building, rival, waits):
    """A keyframe each half metre and half second; a search takes 20 s. From the fourth on, the rival fits as given."""
    _, saved, _ = building
    driven = put(ALIKE, saved, START)
    driven.step(Pose2())
    localizer = driven.mapper.slam.localizer
    keyframe, *others = localizer.pending[-1]
    localizer.load(saved)
    searched_at = []
    for step in range(200):
        moved = replace(keyframe, local_from_base=Pose2(0.5 * step, 0, 0), stamp=keyframe.stamp + step * NS_PER_S // 2)
        for _ in localizer.add_keyframe(moved, *others):
            searched_at.append(step)
            margin = 0.97 if len(searched_at) < 4 else rival
            found = [PoseHypothesis(Pose2(), 0.99, True), PoseHypothesis(Pose2(9), margin, True)]
            pose = localizer.accepted_pose((localizer.epoch, found, 20.0))
            assert (pose is not None) is (not waits and len(searched_at) == 5)
        if not localizer.is_searching:
            break
    intervals = np.diff(searched_at)
    assert (intervals[:3] == 40).all()
    assert (intervals[3:] == (40 if waits else 1)).all()
    assert localizer.is_searching is waits


def test_a_map_that_goes_on_grows_by_what_is_new_and_closes_with_what_is_old(building):
    alike, saved, first = building
    rng = np.random.default_rng(6)
    driven = put(ALIKE, saved, START, fixed=False)
    for _ in drives(driven, alike, 25, rng):
        pass
    again = saved_by(driven)
    assert len(again.keyframes) > len(saved.keyframes) + 20
    assert driven.mapper.back_end.n_loops > 10
    assert off(driven, first)[0] < 0.06
    new = again.graph.nodes[~np.isin(again.graph.nodes, saved.graph.nodes)]
    across = np.isin(again.graph.j, new) & ~np.isin(again.graph.i, new) & again.graph.loop
    assert (across & again.graph.on).sum() > 5
    occupied = (saved.tiles.cells >= 65).sum()
    assert 0.9 * occupied < (again.tiles.cells >= 65).sum() < 1.2 * occupied, "walls are not doubled"
