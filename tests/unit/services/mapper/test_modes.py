# SPDX-License-Identifier: Apache-2.0
"""The mapper's modes while the robot drives: what stays, what goes on, and what a robot that is lost does."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from services.mapper.back_end.map_parts import MIN_KEYFRAMES, OdometryGap
from services.mapper.back_end.solver.optimize import optimize
from services.mapper.localization.global_localization import PoseHypothesis
from services.mapper.maps.map_file import pack_map, unpack_map
from shared import reasons, requests
from shared.geometry import Pose2, wrapped
from shared.messages import Localization, MapMode, OtherRobots
from shared.requests import StartMap
from tests.unit.services.mapper.buildings import ALIKE, Building, drives
from tests.unit.services.mapper.rooms import LAP, RING, START, MapRequester, RoomDrive, box, laps
from zenav.client.map_transfer import fetch_map, give_map, start_mode

LOST, GOOD = Localization.LOST, Localization.GOOD


class Lap:
    """A robot that drives round the ring, and can be put anywhere on its way."""

    def __init__(self):
        self.driven = RoomDrive(RING, noise=0.01)
        self.driven.true = START
        self.asker = MapRequester(self.driven)
        self.at = 0

    def go(self, n):
        for motion in [m for m, _ in zip(laps(), range(self.at + n))][self.at :]:
            self.driven.step(motion)
            self.driven.publish_map()
        self.at += n

    def carry(self, n):
        """To where n motions more would lead; its wheels do not turn."""
        there = self.driven.true
        for motion in [m for m, _ in zip(laps(), range(self.at + n))][self.at :]:
            there = there @ motion
        self.driven.odom_from_start = self.driven.odom_from_start @ self.driven.true @ there.inverse()
        self.driven.true = there
        self.at += n

    def start(self, mode, content=b"", at=None):
        transfer = give_map(self.asker, self.asker.wait, content) if content else 0
        return start_mode(self.asker, self.asker.wait, mode, transfer, at)

    def fetched(self):
        return fetch_map(self.asker, self.asker.wait)

    @property
    def state(self):
        return self.driven.poses[-1].state

    def off(self, first=None):
        """m and rad between the pose and the truth, on a map that begins at `first`, or where it began to map."""
        true = (first or self.driven.first).inverse() @ self.driven.true
        told = self.driven.poses[-1].map_from_base
        return true.distance(told), abs(wrapped(true.yaw - told.yaw))


@pytest.fixture(scope="module")
def mapped():
    """The ring, mapped once round."""
    lap = Lap()
    lap.go(LAP + 20)
    return lap.fetched(), lap.driven.first


def drawn(lap):
    return lap.driven.mapper.slam.grid.all_tiles(0)


def test_near_a_given_pose_the_robot_is_found_without_driving(mapped):
    content, first = mapped
    lap = Lap()
    lap.carry(30)
    lap.start(MapMode.LOCALISE, content, first.inverse() @ lap.driven.true @ Pose2(0.5, -0.4, 0.3))
    for _ in range(3):
        lap.driven.step(Pose2())
    assert lap.state is GOOD
    assert lap.driven.poses[-1].mode is MapMode.LOCALISE
    assert lap.off(first)[0] < 0.06
    assert lap.off(first)[1] < 0.03


class Crowded(Lap):
    """A lap with robots around the robot, at its true places on the map that begins at `first`."""

    N, APART, HALF = 3, 1.0, 0.2  # robots; m to their centres, m of half a side

    def __init__(self, first):
        super().__init__()
        self.carry(30)
        self.at = first.inverse() @ self.driven.true
        angles = np.arange(self.N) * 2 * np.pi / self.N
        self.places = self.APART * np.column_stack((np.cos(angles), np.sin(angles)))
        inside = self.driven.true @ self.places
        boxes = [box(x - self.HALF, y - self.HALF, x + self.HALF, y + self.HALF) for x, y in inside]
        self.driven.segments = np.concatenate((RING, *boxes))

    def hear(self, n):
        """Makes one sweep without motion, and gives the mapper the places of n robots."""
        self.driven.step(Pose2())
        x, y = (self.at @ self.places[:n]).T[:, :, None].astype(np.float32)
        radii = np.full(n, np.hypot(self.HALF, self.HALF), np.float32)
        names = tuple(f"robot_{i}" for i in range(n))
        mapper = self.driven.mapper
        mapper.now = self.driven.now
        self.driven.take(mapper.other_robots(OtherRobots(self.driven.now, names, radii, 0.25, x, y)))


def test_a_robot_that_others_hide_the_walls_from_is_found_where_it_stands_once_it_hears_them(mapped):
    content, first = mapped
    lap = Crowded(first)
    lap.start(MapMode.LOCALISE, content, lap.at)
    for _ in range(15):
        lap.driven.step(Pose2())
    assert lap.state is LOST
    for _ in range(8):
        lap.hear(lap.N)
    assert lap.state is GOOD
    assert lap.off(first)[0] < 0.06
    assert sum("beside other robots" in line for line in lap.driven.logs) == 1


def test_a_search_beside_robots_that_stand_is_not_begun_again_and_again(mapped):
    content, first = mapped
    lap = Crowded(first)
    lap.start(MapMode.LOCALISE, content, lap.at)
    for _ in range(30):
        lap.hear(1)
    assert lap.state is LOST
    assert sum("beside other robots" in line for line in lap.driven.logs) == 1
    for _ in range(10):
        lap.hear(lap.N)
    assert lap.state is GOOD


def test_a_wrong_pose_is_not_believed_and_the_robot_is_found_elsewhere_by_driving(mapped):
    content, first = mapped
    lap = Lap()
    lap.carry(30)
    lap.start(MapMode.LOCALISE, content, Pose2(13.0, 8.0, 1.5))
    for _ in range(5):
        lap.driven.step(Pose2())
    assert lap.state is LOST
    assert "looking for the robot" in lap.driven.mapper.state()
    lap.go(30)
    assert any("not near the given pose" in line for line in lap.driven.logs)
    assert lap.state is GOOD
    assert lap.off(first)[0] < 0.1


@pytest.mark.parametrize("at", [Pose2(9e5, -9e5, 3.0), Pose2(0.0, 400.0, 0.0)])
def test_a_pose_far_off_the_map_is_a_wrong_one(mapped, at):
    content, first = mapped
    lap = Lap()
    lap.carry(30)
    lap.start(MapMode.CONTINUE, content, at)
    lap.go(40)
    assert lap.state is GOOD
    assert lap.off(first)[0] < 0.1


@pytest.mark.parametrize("at", [(), (Pose2(),)])
def test_without_a_map_there_is_none_to_localise_on_and_mapping_goes_on(at):
    lap = Lap()
    reply = lap.asker.ask(requests.START_MAP, StartMap(0, MapMode.LOCALISE, 0, at))
    assert (reply.accepted, reply.reason) == (False, reasons.NO_MAP.code)
    lap.go(5)
    assert lap.driven.poses[-1].mode is MapMode.MAP
    assert len(drawn(lap).rows) > 0


def test_what_was_just_mapped_can_be_left_as_it_is_and_the_pose_goes_on(mapped):
    lap = Lap()
    lap.go(LAP + 20)
    lap.start(MapMode.LOCALISE)
    content, cells, map_id = lap.fetched(), drawn(lap).cells, lap.driven.maps[-1].map_id
    n, n_maps = len(lap.driven.poses), len(lap.driven.maps)
    lap.go(60)
    assert LOST not in {pose.state for pose in lap.driven.poses[n:]}
    jumps = [a.map_from_odom.distance(b.map_from_odom) for a, b in pairwise(lap.driven.poses[n - 1 :])]
    assert max(jumps) < 0.1
    assert lap.driven.mapper.back_end.n_loops > 5, "the map holds the pose"
    assert lap.off()[0] < 0.08
    assert lap.fetched() == content, "to the byte"
    np.testing.assert_array_equal(drawn(lap).cells, cells)
    assert len(lap.driven.maps) == n_maps

    lap.start(MapMode.CONTINUE)
    lap.go(60)
    again = unpack_map(lap.fetched(), "again")
    assert len(again.keyframes) > len(unpack_map(content, "before").keyframes)
    assert lap.off()[0] < 0.08
    assert lap.state is GOOD
    assert lap.driven.maps[-1].map_id == map_id, "it is one map"
    assert lap.driven.mapper.back_end.n_loops > 5


def begin_wrong_part(lap, off):
    """The robot goes on in a new part of the map, as after scans that did not fit, at a pose that is `off`."""
    back_end, front_end = lap.driven.mapper.back_end, lap.driven.mapper.front_end
    motion = back_end.keyframes[-1].local_from_base.inverse() @ front_end.local_from_base @ off
    front_end.start(back_end.keyframes[-1].local_from_base @ motion)
    back_end.begin_part(OdometryGap(motion, 2.0, 1.0))


def test_a_map_that_is_left_as_it_is_while_the_robot_is_in_a_part_is_that_without_the_part():
    lap = Lap()
    lap.go(LAP + 20)
    n = len(lap.driven.mapper.back_end.keyframes)
    begin_wrong_part(lap, Pose2(1.5, 0.8, 0.6))
    lap.go(4)
    assert lap.driven.mapper.slam.is_in_part
    assert len(lap.driven.mapper.back_end.keyframes) > n
    lap.start(MapMode.LOCALISE)
    assert len(unpack_map(lap.fetched(), "map").keyframes) == n
    for _ in range(40):
        lap.go(1)
        assert lap.state is not GOOD or lap.off()[0] < 0.15
    assert lap.state is GOOD


def test_the_search_of_a_part_that_closures_have_joined_meanwhile_counts_no_more():
    lap = Lap()
    lap.go(30)
    slam, back_end = lap.driven.mapper.slam, lap.driven.mapper.back_end
    begin_wrong_part(lap, Pose2())
    lap.driven.busy = True  # no closures
    lap.go(10)
    slam.localizer.load(slam._map_without_part())
    slam.searches_part = True
    lap.go(6)
    order = next(job for job in lap.driven.jobs if job.done == "on_localized")
    lap.driven.jobs.clear()
    back_end._join_part(back_end.graph.pose(int(back_end.graph.nodes[-1])))
    slam.localizer.window_about = Pose2()  # one search is enough
    found = [PoseHypothesis(back_end.map_from_local, 0.99, True)]
    stamps = [keyframe.stamp for keyframe in back_end.keyframes]
    lap.driven.take(lap.driven.mapper.on_localized((order.arguments[0], found, 0.1)))
    assert [keyframe.stamp for keyframe in back_end.keyframes] == stamps
    assert slam.is_localized
    assert not slam.localizer.is_searching


def test_only_an_optimum_of_this_map_with_closures_makes_the_pose_certain():
    lap = Lap()
    lap.go(30)
    mapper = lap.driven.mapper
    slam, back_end, uncertainty = mapper.slam, mapper.back_end, mapper.front_end.uncertainty

    def sigma_after(epoch, n_closures):
        uncertainty.covariance = np.diag((1.0, 1.0, 0.1))
        back_end.n_pending_closures, back_end.n_pending_pairwise = n_closures, 1
        lap.driven.take(mapper.on_graph_optimized((epoch, optimize(*back_end.optimization_arguments()))))
        return uncertainty.covariance[0, 0]

    assert sigma_after(slam.jobs.epoch, 0) == 1.0
    assert sigma_after(slam.jobs.epoch - 1, 1) == 1.0
    assert sigma_after(slam.jobs.epoch, 1) == 0.0


def test_a_part_that_begins_before_the_first_keyframe_on_a_map_is_joined_by_odometry_alone(mapped):
    content, first = mapped
    lap = Lap()
    lap.carry(30)
    lap.start(MapMode.LOCALISE, content, first.inverse() @ lap.driven.true)
    lap.go(20)
    lap.start(MapMode.CONTINUE)
    slam = lap.driven.mapper.slam
    lap.driven.step(Pose2())
    lap.driven.take(slam._begin_part())
    assert slam.back_end.n_in_part == 0
    lap.go(3)
    assert lap.state is LOST
    assert lap.off(first)[0] < 0.1
    assert len(slam.back_end.gap_edges) == 1
    ((i, j),) = slam.back_end.gap_edges
    graph = slam.back_end.graph.snapshot()
    edge = (graph.i == i) & (graph.j == j)
    step = slam.back_end.graph.pose(i).inverse() @ slam.back_end.graph.pose(j)
    assert step.distance(Pose2(*graph.relative[edge][0].tolist())) < 0.35
    lap.go(LAP)
    assert lap.state is GOOD
    assert lap.off(first)[0] < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_who_is_carried_away_while_mapping_is_found_on_the_own_map(seed):
    rooms = Building(ALIKE, (6.5, 6.0))
    rng = np.random.default_rng(seed)
    driven = RoomDrive(ALIKE, noise=0.01)
    driven.true = Pose2(6.5, 6.0, 0.0)
    for _ in drives(driven, rooms, 60, rng):
        driven.publish_map()
    there = rooms.anywhere(rng)
    driven.odom_from_start = driven.odom_from_start @ driven.true @ there.inverse()  # its wheels do not turn
    driven.true = there
    n, cells = len(driven.poses), None
    for _ in drives(driven, rooms, 10, rng):
        driven.publish_map()
        back_end = driven.mapper.back_end
        if not back_end.is_joined and back_end.n_in_part < MIN_KEYFRAMES:
            now = driven.mapper.slam.grid.all_tiles(0).cells
            assert cells is None or np.array_equal(now, cells), "nothing is drawn from a wrong place"
            cells = now
    states = [pose.state for pose in driven.poses[n:]]
    assert LOST in states[:10]
    assert cells is not None
    assert states[-1] is GOOD
    assert (driven.first.inverse() @ driven.true).distance(driven.poses[-1].map_from_base) < 0.1
    asker = MapRequester(driven)
    saved = unpack_map(fetch_map(asker, asker.wait), "own")
    assert len(saved.keyframes) == len(saved.graph.nodes)


def test_a_laser_that_was_covered_sees_again_at_its_place():
    lap = Lap()
    lap.go(40)
    ring = lap.driven.segments
    x, y = lap.driven.true.x, lap.driven.true.y
    lap.driven.segments = np.array(box(x - 0.35, y - 0.3, x + 0.5, y + 0.4))
    for _ in range(12):
        lap.driven.step(Pose2())
    assert lap.state is LOST
    lap.driven.segments = ring
    for _ in range(3):
        lap.driven.step(Pose2())
    assert lap.state is GOOD
    assert lap.off()[0] < 0.06


def test_a_new_map_begins_where_the_robot_is():
    lap = Lap()
    lap.go(30)
    before = lap.driven.maps[-1].map_id
    lap.start(MapMode.MAP)
    first = lap.driven.true
    lap.go(20)
    assert lap.driven.maps[-1].map_id > before
    assert lap.off(first)[0] < 0.1
    assert lap.driven.poses[-1].mode is MapMode.MAP
    assert len(unpack_map(lap.fetched(), "new").keyframes) < 25


def test_a_restarted_mapper_still_leaves_the_map_as_it_is(mapped):
    content, first = mapped
    lap = Lap()
    lap.start(MapMode.LOCALISE, content, Pose2())
    lap.go(10)
    assert lap.state is GOOD
    cells, pose = drawn(lap), lap.driven.poses[-1]
    again = Lap()
    again.driven.now, again.driven.true, again.at = lap.driven.now, lap.driven.true, lap.at
    again.driven.odom_from_start = lap.driven.odom_from_start
    again.driven.take(again.driven.mapper.remember_map(cells))
    again.driven.take(again.driven.mapper.remember_pose(pose))
    again.go(20)
    assert again.state is GOOD
    assert again.off(first)[0] < 0.1
    assert again.driven.poses[-1].mode is MapMode.LOCALISE
    np.testing.assert_array_equal(drawn(again).cells, cells.cells)


def restarted(lap, checkpoint=None):
    """Another process of the lap's mapper, with its latched map and pose, and a checkpoint."""
    again = Lap()
    again.driven.now, again.driven.true, again.at = lap.driven.now, lap.driven.true, lap.at
    again.driven.odom_from_start = lap.driven.odom_from_start
    mapper = again.driven.mapper
    mapper.now = again.driven.now
    again.driven.take(mapper.remember_map(drawn(lap)))
    again.driven.take(mapper.remember_pose(lap.driven.poses[-1]))
    for row, request in checkpoint.function(*checkpoint.arguments) if checkpoint else ():
        assert row is requests.GIVE_MAP
        again.driven.take(mapper.give_map(request))
    return again


@pytest.mark.parametrize("mode", [MapMode.MAP, MapMode.CONTINUE, MapMode.LOCALISE])
def test_a_restarted_mapper_goes_on_with_its_pose_graph(mapped, mode):
    content, first = mapped
    lap = Lap()
    if mode is not MapMode.MAP:
        lap.start(mode, content, Pose2())
    lap.go(40)
    first = lap.driven.first if mode is MapMode.MAP else first
    before = unpack_map(lap.fetched(), "before")
    again = restarted(lap, lap.driven.mapper.checkpoint())
    after = unpack_map(again.fetched(), "after")
    assert after.graph.nodes.tolist() == before.graph.nodes.tolist()
    np.testing.assert_array_equal(after.graph.poses, before.graph.poses)
    np.testing.assert_array_equal(after.tiles.cells, before.tiles.cells)
    assert again.driven.mapper.slam.grid.map_id == lap.driven.mapper.slam.grid.map_id
    again.go(60)
    assert again.state is GOOD
    assert again.off(first)[0] < 0.1
    if mode is not MapMode.LOCALISE:
        graph = unpack_map(again.fetched(), "later").graph
        joins = (graph.i <= before.graph.nodes[-1]) & (graph.j > before.graph.nodes[-1])
        assert (joins & graph.loop).any()  # closures between what was mapped before and after


@pytest.mark.parametrize("has_checkpoint", [False, True])
def test_a_mapper_that_crashes_while_it_looks_for_the_robot_goes_on_looking(mapped, has_checkpoint):
    content, first = mapped
    lap = Lap()
    lap.start(MapMode.LOCALISE, content, Pose2())
    lap.driven.step(Pose2())
    checkpoint = lap.driven.mapper.checkpoint()
    lap.carry(30)
    lap.start(MapMode.LOCALISE, content)
    for _ in range(3):
        lap.driven.step(Pose2())
    assert lap.state is LOST
    if has_checkpoint:
        checkpoint = replace(checkpoint, arguments=(checkpoint.arguments[0], lap.driven.mapper.slam.grid.map_id))
    again = restarted(lap, checkpoint if has_checkpoint else None)
    for _ in range(60):
        again.go(1)
        assert again.state is not GOOD or again.off(first)[0] < 0.15
    assert again.state is GOOD


@pytest.mark.parametrize("turn", [1.3, -2.6])
def test_a_robot_that_turns_while_the_mapper_is_away_is_followed_by_odometry(turn):
    lap = Lap()
    lap.go(40)
    lap.driven.now += 1_600_000_000
    lap.driven.true = lap.driven.true @ Pose2(0.1, 0.0, turn)
    again = restarted(lap)
    again.driven.step(Pose2())
    assert again.state is GOOD
    assert again.off(lap.driven.first)[0] < 0.1
    assert again.off(lap.driven.first)[1] < 0.05


@pytest.mark.parametrize("turn", [1.5, -2.5])
def test_a_scan_that_comes_before_the_odometry_of_a_pause_of_the_process_waits_for_it(turn):
    lap = Lap()
    lap.go(40)
    driven, begin, start = lap.driven, lap.driven.now, lap.driven.true
    driven.true = start @ Pose2(0.0, 0.0, turn)
    scan = driven.scan([driven.true] * 11, begin + 2_500_000_000)
    driven.now = begin + 2_600_000_000  # the process goes on, and takes what has come meanwhile
    waiting = [(begin + i * 20_000_000, start @ Pose2(0.0, 0.0, turn * min(i / 50, 1.0))) for i in range(1, 131)]
    for stamp, pose in waiting[:40]:
        driven.odometry(stamp, pose, w=turn)
    driven.take(driven.mapper.scan(scan))
    for stamp, pose in waiting[40:]:
        driven.odometry(stamp, pose)
    assert driven.poses[-1].stamp >= begin + 2_500_000_000
    assert lap.state is GOOD
    assert lap.off()[0] < 0.1
    assert lap.off()[1] < 0.05


def test_the_graph_of_another_map_is_not_taken_up():
    lap, other = Lap(), Lap()
    lap.go(20)
    checkpoint = lap.driven.mapper.checkpoint()
    other.driven.now += 10**9
    other.go(20)
    again = restarted(other, checkpoint)
    assert not again.driven.mapper.slam.has_graph
    again.go(10)
    assert again.state is GOOD


def test_a_checkpoint_has_another_version_when_the_graph_has_grown():
    lap = Lap()
    assert lap.driven.mapper.checkpoint() is None
    lap.go(10)
    first = lap.driven.mapper.checkpoint()
    assert lap.driven.mapper.checkpoint().version == first.version
    lap.go(10)
    assert lap.driven.mapper.checkpoint().version != first.version


def test_tiles_alone_are_left_as_they_are_and_gone_on_with():
    lap = Lap()
    lap.go(20)
    tiles = drawn(lap)
    other = Lap()
    list(other.driven.mapper._load(tiles, Pose2(), MapMode.CONTINUE))
    other.driven.mapper.now = other.driven.now
    assert other.start(MapMode.LOCALISE).accepted
    other.go(10)
    assert other.state is GOOD
    np.testing.assert_array_equal(drawn(other).cells, tiles.cells)
    assert other.start(MapMode.CONTINUE).accepted
    other.go(30)
    assert (drawn(other).cells != -1).sum() > (tiles.cells != -1).sum()


def test_what_is_saved_of_a_map_that_stays_is_what_was_loaded(mapped):
    content, _ = mapped
    lap = Lap()
    lap.start(MapMode.LOCALISE, content)
    lap.go(40)
    assert lap.fetched() == content
    assert pack_map(lap.driven.mapper.slam.snapshot()) == content
