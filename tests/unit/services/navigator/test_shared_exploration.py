# SPDX-License-Identifier: Apache-2.0
"""Robots that explore together: each frontier is left to one of them, and a robot that falls silent loses its own."""

from dataclasses import replace
from math import hypot

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.navigator.exploration import Exploration, ExplorationConfig
from services.navigator.frontiers import Frontier, FrontierConfig, Frontiers, find_frontiers
from services.navigator.shared_exploration import SharedExploration, SharingConfig, deal, subset
from shared import reasons
from shared.geometry import Pose2
from shared.grid import FREE_UP_TO, OccupancyGrid
from shared.messages import NavState
from tests.unit.services.maps import drawn, message
from tests.unit.services.navigator.bench import OK, NavigatorBench, S, stopped
from tests.unit.services.navigator.test_exploring import ENDS, OFFICE, Explorer

CONFIG = SharingConfig()
LEASE = round(CONFIG.lease * S)
places = st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), max_size=8)
poses = st.builds(Pose2, st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3))


def frontiers(*rows):
    """From x, y and m to drive."""
    cells = np.zeros((1, 2), np.int64)
    made = tuple(Frontier(x, y, 0.0, 1.0, distance, cells) for x, y, distance in rows)
    return Frontiers(made, (), False, np.ones((len(made), len(made))))


def share_of(name, x, y, rows, claimed=-1, sequence=1, **fields):
    """What a robot at x, y with these frontiers says."""
    sharing = SharedExploration(CONFIG, name, ("red",), Pose2())
    sharing.found = frontiers(*rows)
    share = sharing.message(Pose2(x, y), None, OccupancyGrid(), True, 1, S)
    return replace(share, claimed=claimed, sequence=sequence, **fields)


def own(sharing, found, target=None, now=S):
    return [(f.x, f.y) for f in sharing.own_frontiers(found, target, now).frontiers]


@given(places, st.dictionaries(st.sampled_from("abcd"), st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=1))
def test_each_place_is_dealt_to_one_robot_and_every_robot_deals_alike(points, robots):
    costs = {name: [hypot(x - px, y - py) for px, py in points] for name, (x, y) in robots.items()}
    tours = deal(points, costs, dict.fromkeys(robots), 1.5)
    assert sorted(k for tour in tours.values() for k in tour) == list(range(len(points)))
    other_way = dict(reversed(costs.items()))
    assert deal(points, other_way, dict.fromkeys(robots), 1.5) == tours


def test_a_place_goes_to_the_robot_whose_tour_reaches_it_first():
    points = [(1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (8.0, 0.0)]
    costs = {"red": [1.0, 2.0, 3.0, 8.0], "blue": [9.0, 8.0, 7.0, 2.0]}
    assert deal(points, costs, {"red": None, "blue": None}, 1.5) == {"red": [0, 1, 2], "blue": [3]}


@pytest.mark.parametrize(("blue_m", "keeper"), [(5.5, "red"), (4.0, "blue")])
def test_a_robot_keeps_the_place_that_it_drives_to_unless_another_is_a_metre_nearer(blue_m, keeper):
    costs = {"red": [6.0, 50.0], "blue": [blue_m, 50.0]}
    tours = deal([(0.0, 0.0), (40.0, 0.0)], costs, {"red": (0.0, 0.0), "blue": None}, 1.5)
    assert tours[keeper][0] == 0


def test_a_robot_keeps_no_place_that_it_cannot_have():
    costs = {"red": [np.inf, 9.0], "blue": [3.0, 1.0]}
    claims = {"red": (0.0, 0.0), "blue": (5.0, 0.0)}
    assert deal([(0.0, 0.0), (5.0, 0.0)], costs, claims, 1.5) == {"red": [], "blue": [1, 0]}


def test_a_nearer_robot_takes_its_frontiers_until_its_lease_ends():
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    found = frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 9.0))
    assert own(sharing, found) == [(1.0, 0.0), (9.0, 0.0)]
    sharing.take(share_of("blue", 10.0, 0.0, [(9.2, 0.0, 1.0)]), S)
    assert own(sharing, found) == [(1.0, 0.0)]
    assert own(sharing, found, now=S + LEASE) == [(1.0, 0.0)]
    assert own(sharing, found, now=S + LEASE + 1) == [(1.0, 0.0), (9.0, 0.0)]


def test_of_two_places_of_a_robot_that_are_one_here_the_nearer_one_counts():
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    sharing.take(share_of("blue", 6.0, 0.0, [(9.2, 0.0, 3.0), (8.8, 0.0, 12.0)]), S)
    assert own(sharing, frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 8.0))) == [(1.0, 0.0)]


@given(poses, poses)
def test_the_frames_of_the_maps_do_not_matter(common_from_red, common_from_blue):
    """Both robots in one room: red's frontiers are given in its map, and what blue says in the common frame."""
    sharing = SharedExploration(CONFIG, "red", ("blue",), common_from_red)
    place = common_from_red @ Pose2(9.0, 0.0)
    here = common_from_red @ Pose2(10.0, 0.0)
    share = share_of("blue", here.x, here.y, [(place.x, place.y, 1.0)], common_from_map=common_from_blue)
    sharing.take(share, S)
    assert own(sharing, frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 9.0))) == [(1.0, 0.0)]


def test_old_messages_and_those_of_other_robots_are_ignored():
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    found = frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 9.0))
    newest, older = (
        share_of("blue", 10.0, 0.0, [(9.0, 0.0, 1.0)], sequence=5),
        share_of("blue", 0.0, 0.0, [], sequence=4),
    )
    for share in (newest, older, share_of("green", 0.5, 0.0, [(1.0, 0.0, 0.1)])):
        sharing.take(share, S)
    assert own(sharing, found) == [(1.0, 0.0)]
    sharing.take(replace(older, session=newest.session + 1, sequence=1, active=False), S)  # it was restarted
    assert own(sharing, found) == [(1.0, 0.0), (9.0, 0.0)]


def test_a_robot_that_was_silent_for_its_lease_is_heard_again_also_where_its_clock_was_set_back():
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    found = frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 9.0))
    before = share_of("blue", 10.0, 0.0, [(9.0, 0.0, 1.0)], sequence=5)
    again = replace(before, session=before.session - 1, sequence=1)
    sharing.take(before, S)
    sharing.take(replace(again, active=False), S + LEASE)
    assert own(sharing, found, now=S + LEASE) == [(1.0, 0.0)], "an old message, while it is heard"
    sharing.take(again, S + LEASE + 1)
    assert own(sharing, found, now=S + LEASE + 1) == [(1.0, 0.0)]
    sharing.take(replace(again, sequence=2, active=False), S + LEASE + 2)
    assert own(sharing, found, now=S + LEASE + 2) == [(1.0, 0.0), (9.0, 0.0)]


def test_a_robot_without_frontiers_takes_what_two_robots_left_to_each_other():
    """Blue is nearer to the frontier and drives nowhere. After blue drives to one, red leaves them to it."""
    sharing, found = SharedExploration(CONFIG, "red", ("blue",), Pose2()), frontiers((9.0, 0.0, 9.0))
    sharing.take(share_of("blue", 10.0, 0.0, [(9.0, 0.0, 1.0)]), S)
    assert own(sharing, found) == [(9.0, 0.0)]
    sharing.take(share_of("blue", 10.0, 0.0, [(9.0, 0.0, 1.0)], claimed=0, sequence=2), S)
    assert own(sharing, found) == []


def test_a_frontier_that_another_robot_may_not_know_is_left_to_it_only_while_there_are_others():
    """Blue stands beside it, but does not list it: then each robot would leave it to the other."""
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    sharing.take(share_of("blue", 10.0, 0.0, []), S)
    assert own(sharing, frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 9.0))) == [(1.0, 0.0)]
    assert own(sharing, frontiers((9.0, 0.0, 9.0))) == [(9.0, 0.0)]


class Room:
    """A map as red has it, and what it searches while blue knows another one."""

    def __init__(self, cells):
        self.grid = OccupancyGrid()
        self.grid.apply(message(cells))
        self.exploration = Exploration(ExplorationConfig(), SharedExploration(CONFIG, "red", ("blue",), Pose2()))

    def hear(self, cells, exploration=None, now=S):
        """Blue has this map, and explores so."""
        grid = OccupancyGrid()
        grid.apply(message(cells))
        sharing = exploration.sharing if exploration else SharedExploration(CONFIG, "blue", ("red",), Pose2())
        self.exploration.sharing.take(replace(sharing.message(Pose2(), None, grid, True, 1, now), robot="blue"), S)
        self.exploration.sharing.map_update(0.05, S)

    def found(self):
        known = self.exploration.known_map(self.grid)
        snapshot = self.exploration.snapshot(known, known.cells, Pose2(1.0, 1.0), 0.2, S)
        return find_frontiers(snapshot, FrontierConfig())


@pytest.mark.parametrize("beside", [-1, FREE_UP_TO + 1])  # unknown, or seen once and uncertain
def test_there_is_no_frontier_towards_what_another_robot_knows_and_its_frontiers_are_the_own_ones(beside):
    cells = drawn(
        """
        ####################
        #.....??????......??
        #.....??????......??
        #.....??????......??
        ####################
        """,
        8,
    )
    mine, theirs = cells.copy(), np.full(cells.shape, -1, np.int8)
    mine[:, 6 * 8 :] = -1
    mine[8:-8, 6 * 8] = beside
    theirs[:, 5 * 8 :] = np.where(cells[:, 5 * 8 :] < 0, np.int8(0), cells[:, 5 * 8 :])
    theirs[8:-8, 18 * 8 :] = -1
    red = Room(mine)
    assert {f.x < 6 * 0.4 for f in red.found().frontiers} == {True}
    red.hear(theirs)
    assert {f.x > 16 * 0.4 for f in red.found().frontiers} == {True}
    assert max(f.distance for f in red.found().frontiers) > 5.5, "it drives through what only blue knows"


ROOM_AND_DOOR = drawn(
    """
    ############?????
    #..........#?????
    #..........??????
    #..........??????
    #..........#?????
    ############?????
    """,
    10,
)


def test_robots_that_know_no_more_than_each_other_do_not_hide_a_frontier_from_each_other():
    """Both see a door from the same side. What lies beyond it is known where one of them has been there."""
    red = Room(ROOM_AND_DOOR)
    alone = [f.cells.tolist() for f in red.found().frontiers]
    assert len(alone) == 1
    red.hear(ROOM_AND_DOOR)
    assert [f.cells.tolist() for f in red.found().frontiers] == alone
    beyond = np.where(np.arange(ROOM_AND_DOOR.shape[1]) >= 110, np.int8(0), ROOM_AND_DOOR)
    beyond[:, 111:] = np.where(np.arange(160)[:59] > 40, np.int8(100), beyond[:, 111:])
    beyond[[0, -1], 110:] = 100
    other = Room(ROOM_AND_DOOR)
    other.hear(beyond)
    assert not other.found().frontiers


def test_a_border_that_one_robot_looked_at_in_vain_is_no_frontier_of_the_others():
    blue, red = Room(ROOM_AND_DOOR), Room(ROOM_AND_DOOR)
    red.hear(ROOM_AND_DOOR, blue.exploration)
    assert len(red.found().frontiers) == 1
    found, pose = blue.found(), Pose2(5.0, 1.5)
    blue.exploration.choose_target(found, pose, 0.05)
    blue.exploration.arrived()
    blue.exploration.passed(10.0, pose)
    assert blue.exploration.choose_target(found, pose, 0.05) is None
    again = Room(ROOM_AND_DOOR)
    again.hear(ROOM_AND_DOOR, blue.exploration, now=2 * S)
    assert not again.found().frontiers
    assert len(Room(ROOM_AND_DOOR).found().frontiers) == 1


def test_a_small_frontier_that_vanished_while_the_robot_was_near_is_no_frontier_again():
    """Cells at the edge of a view change between known and uncertain."""
    small, none = frontiers((1.0, 0.0, 1.0)), frontiers()
    small = replace(small, frontiers=(replace(small.frontiers[0], size=0.6),))
    for seen_from, chosen in ((2.0, False), (9.0, True)):
        exploration = Exploration(ExplorationConfig())
        assert exploration.choose_target(small, Pose2(), 0.05) is not None
        assert exploration.choose_target(none, Pose2(seen_from, 0.0), 0.05) is None
        assert (exploration.choose_target(small, Pose2(), 0.05) is not None) is chosen
    large = replace(small, frontiers=(replace(small.frontiers[0], size=1.5),))
    exploration = Exploration(ExplorationConfig())
    exploration.choose_target(large, Pose2(), 0.05)
    exploration.choose_target(none, Pose2(), 0.05)
    assert exploration.choose_target(large, Pose2(), 0.05) is not None


def test_a_small_frontier_that_is_left_to_another_robot_nearby_was_not_seen():
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    exploration = Exploration(ExplorationConfig(), sharing)
    two = frontiers((1.0, 0.0, 1.0), (9.0, 0.0, 9.0))
    cells = (np.array([[0, 20]]), np.array([[0, 180]]))
    two = replace(
        two, frontiers=tuple(replace(f, size=0.6, cells=c) for f, c in zip(two.frontiers, cells, strict=True))
    )
    assert exploration.choose_target(exploration.own_part(two, S), Pose2(), 0.05).frontier.x == 1.0
    sharing.take(share_of("blue", 1.0, 0.0, [(1.0, 0.0, 0.0)], claimed=0), S)
    exploration.target = replace(exploration.target, frontier=replace(exploration.target.frontier, x=50.0))
    assert exploration.choose_target(exploration.own_part(two, S), Pose2(), 0.05).frontier.x == 9.0
    assert sharing.seen == []
    gone = replace(two, frontiers=two.frontiers[:1], between=two.between[:1, :1])
    exploration.choose_target(exploration.own_part(gone, S), Pose2(8.0, 0.0), 0.05)
    assert len(sharing.seen) == 1


def test_a_subset_keeps_the_distances_between_its_frontiers():
    found = replace(frontiers((0, 0, 1), (1, 0, 2), (2, 0, 3)), between=np.arange(9.0).reshape(3, 3))
    some = subset(found, [2, 0])
    assert [f.x for f in some.frontiers] == [0, 2]
    np.testing.assert_array_equal(some.between, [[0, 2], [6, 8]])


class Team:
    """Robots in one building, each with its own map, that hear each other a step later."""

    def __init__(self, *starts):
        names = ["red", "blue"][: len(starts)]
        self.robots = [Explorer(OFFICE, x, y, name=name) for name, (x, y) in zip(names, starts, strict=True)]
        self.silent: set[Explorer] = set()
        for robot in self.robots:
            robot.explore(*(name for name in names if name != robot.navigator.robot.name))

    def run(self, seconds, lost=()):
        """Runs until all have ended; returns s. lost: robots that stand still and say nothing."""
        begun = self.robots[0].now
        while self.robots[0].now - begun < seconds * S:
            going = [robot for robot in self.robots if robot not in lost]
            for robot in going:
                robot.step()
            for robot in going:
                for share in robot.shares:
                    for other in going:
                        if other is not robot:
                            other.call("other_explorer", share)
                robot.shares.clear()
            if all(robot.statuses and robot.status.state in ENDS for robot in going):
                break
        return (self.robots[0].now - begun) / S

    @property
    def covered(self):
        """The share of the floor that one of them has seen."""
        known = np.max([robot.known for robot in self.robots], axis=0)
        return float((known[self.robots[0].reachable(self.robots[0].pose)] == 0).mean())


@pytest.fixture(scope="module")
def alone():
    team = Team((7.0, 3.3))
    seconds = team.run(300)
    return seconds, team.robots[0].moved


def test_two_robots_explore_an_office_in_much_less_than_the_time_of_one(alone):
    team = Team((7.0, 3.3), (7.6, 3.3))
    seconds = team.run(300)
    assert {robot.status.reason for robot in team.robots} == {reasons.NO_FRONTIER.code}
    assert team.covered > 0.98
    assert seconds < 0.7 * alone[0]
    assert min(robot.moved for robot in team.robots) > 0.25 * alone[1]


def test_where_one_robot_falls_silent_the_other_explores_everything():
    team = Team((7.0, 3.3), (7.6, 3.3))
    team.run(8)
    red, blue = team.robots
    team.run(300, lost=(blue,))
    assert red.status.reason == reasons.NO_FRONTIER.code
    known = red.known[red.reachable(red.pose)] == 0
    assert known.mean() > 0.98, "it does not count on what the silent robot knew"


def test_a_robot_that_waits_for_the_others_stands_and_ends_after_them():
    robot = NavigatorBench(name="red")
    robot.call("map", message(drawn("#####\n#...#\n#...#\n#####", 20)))
    robot.pose = Pose2(2.0, 2.0)
    robot.explore("blue")
    for _ in range(8):
        robot.call("other_explorer", share_of("blue", 9.0, 9.0, [(9.5, 9.0, 1.0)], sequence=robot.n_steps + 1))
        robot.run(2.5)
    assert robot.status.state is NavState.EXPLORING
    assert stopped(robot)
    assert not robot.shares[-1].active, "no robot waits for a robot that waits"
    robot.call("other_explorer", share_of("blue", 9.0, 9.0, [], sequence=10_000, active=False))
    robot.run(15, until=ENDS)
    assert (robot.status.state, robot.status.reason) == (NavState.REACHED, reasons.NO_FRONTIER.code)


def test_a_robot_that_is_paused_or_has_ended_releases_its_frontiers():
    robot = Explorer(OFFICE, 7.0, 3.3, name="red")
    robot.explore("blue")
    robot.run(3)
    assert robot.shares[-1].active
    robot.pause()
    robot.run(0.5)
    assert not robot.shares[-1].active
    robot.pause(False)
    robot.run(0.5)
    assert robot.shares[-1].active
    robot.cancel()
    robot.run(0.5)
    assert not robot.shares[-1].active
    n = len(robot.shares)
    robot.run(3)
    assert len(robot.shares) == n


def test_a_restarted_navigator_goes_on_exploring_with_the_same_robots():
    origin = Pose2(3.0, 1.0, 0.5)
    before, after = Explorer(OFFICE, 7.0, 3.3, name="red"), Explorer(OFFICE, 7.0, 3.3, name="red")
    before.explore("blue", common_from_map=origin)
    before.run(2)
    after.now = before.now + S // 2
    after.guarded(OK, source="")
    after.call("task_before_the_restart", before.tasks[-1])
    after.call("share_before_the_restart", before.shares[-1])
    after.run(3)
    assert after.status.state is NavState.EXPLORING
    share = after.shares[-1]
    assert (share.others, share.common_from_map, share.task_id) == (("blue",), origin, before.shares[-1].task_id)
    assert share.session > before.shares[-1].session, "the others take its messages although it counts from 1"


def test_a_robot_waits_while_others_drive_to_all_frontiers_and_goes_on_when_one_is_left_to_it():
    sharing = SharedExploration(CONFIG, "red", ("blue",), Pose2())
    found = frontiers((9.0, 0.0, 9.0))
    sharing.take(share_of("blue", 10.0, 0.0, [(9.0, 0.0, 1.0)], claimed=0), S)
    assert own(sharing, found) == []
    assert sharing.waits(False, S)
    assert not sharing.is_done, "not for long enough"
    assert sharing.waits(True, S)
    assert sharing.is_done
    assert own(sharing, frontiers((9.0, 0.0, 9.0), (0.0, 5.0, 2.5))) == [(0.0, 5.0)]
    assert not sharing.is_done
    sharing.take(share_of("blue", 10.0, 0.0, [], sequence=2, active=False), S)
    sharing.begin_search(S)
    assert not sharing.waits(True, S)


def blue_with_a_map():
    grid = OccupancyGrid()
    grid.apply(message(drawn("...\n...\n###", 20)))
    return SharedExploration(CONFIG, "blue", ("red",), Pose2()).message(Pose2(), None, grid, True, 1, S)


def test_planner_and_traffic_hear_what_the_others_know_until_the_exploration_has_ended():
    robot = NavigatorBench(name="red")
    robot.call("map", message(ROOM_AND_DOOR))
    robot.pose = Pose2(2.0, 1.5)
    robot.explore("blue")
    robot.call("other_explorer", blue_with_a_map())
    robot.run(0.5)
    known = robot.others_map
    assert (known.cells[0, 0], known.cells[30, 30], known.cells[60, 60]) == (100, 0, -1)
    robot.cancel()
    robot.run(0.5)
    assert known.empty


def test_a_navigator_that_does_not_go_on_after_its_restart_says_that_the_others_know_nothing():
    robot = NavigatorBench(name="red")
    robot.run(1)
    assert robot.others_map.map_id == 0, "without an exploration with others it says nothing"
    robot.call("share_before_the_restart", blue_with_a_map())
    robot.run(1)
    assert robot.others_map.map_id != 0
    assert robot.others_map.empty
