# SPDX-License-Identifier: Apache-2.0
from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.navigator.config import NavigatorConfig
from services.navigator.exploration import Exploration, ExplorationConfig
from services.navigator.frontiers import Frontier, Frontiers
from shared import reasons
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.messages import FollowState, GuardState, Localization, NavState, Path
from tests.unit.services.maps import drawn, message
from tests.unit.services.navigator.bench import NavigatorBench

R = 0.1  # m a cell
ENDS = {NavState.REACHED, NavState.FAILED, NavState.CANCELED}
OFFICE = """
    ############################
    #.......#........#.........#
    #.......#........#.........#
    #..................#.......#
    #.......#........#.........#
    ###.#######.##########.#####
    #..........................#
    #..........................#
    ####.########.##########.###
    #......#........#..........#
    #......#........#....##....#
    #......#........#....##....#
    #......#...................#
    ############################
    """


class Explorer(NavigatorBench):
    """A robot that sees 3 m around itself in a building it does not know, and plans on the true one."""

    def __init__(self, text, x, y, sees=3.0, config=None, name="x80sv"):
        super().__init__(config, speed=1.0, name=name)
        self.truth = drawn(text, 5) > 0
        self.passable = distance_field(self.truth, R) >= 0.25
        self.known = np.full(self.truth.shape, -1, np.int8)
        self.pose, self.sees, self.version = Pose2(x, y), sees, 0
        self.planned = (-1, np.empty((0, 2)))

    @property
    def covered(self):
        """The share of the floor that the robot can get to that it has seen."""
        reached = self.reachable(self.pose)
        return float((self.known[reached] == 0).mean())

    def reachable(self, pose):
        parents = self.parents(pose)
        mask = np.zeros(self.truth.shape, bool)
        for cell in parents:
            mask[cell] = True
        return mask

    def parents(self, pose):
        start = int(pose.y / R), int(pose.x / R)
        parents, queue = {start: start}, deque([start])
        while queue:
            row, column = queue.popleft()
            for there in ((row, column + 1), (row + 1, column), (row, column - 1), (row - 1, column)):
                if there not in parents and self.passable[there]:
                    parents[there] = (row, column)
                    queue.append(there)
        return parents

    def see(self):
        before = self.known.copy()
        angles = np.linspace(0, 2 * np.pi, 240, endpoint=False)
        blocked = np.zeros(len(angles), bool)
        for away in np.arange(0, self.sees, R / 2):
            rows = ((self.pose.y + away * np.sin(angles)) / R).astype(int).clip(0, self.truth.shape[0] - 1)
            columns = ((self.pose.x + away * np.cos(angles)) / R).astype(int).clip(0, self.truth.shape[1] - 1)
            hit = self.truth[rows, columns]
            self.known[rows[~blocked & hit], columns[~blocked & hit]] = 100
            free = ~blocked & ~hit & (self.known[rows, columns] < 0)
            self.known[rows[free], columns[free]] = 0
            blocked |= hit
        if (self.known != before).any():
            self.version += 1
            since = before if self.version > 1 else None
            self.call("map", message(self.known, R, version=self.version, since=since))

    def path(self):
        if self.refusal:
            return super().path()
        goal = self.goal.map_from_goal
        if self.planned[0] != self.goal.id:
            parents = self.parents(self.pose)
            reached = np.array(sorted(parents))  # a goal beside a wall not seen yet is moved, as the planner does
            away = np.hypot((reached[:, 1] + 0.5) * R - goal.x, (reached[:, 0] + 0.5) * R - goal.y)
            nearest = int(np.argmin(away))
            cells = [tuple(map(int, reached[nearest]))] if away[nearest] < 0.4 else []
            while cells and parents[cells[-1]] != cells[-1]:
                cells.append(parents[cells[-1]])
            self.planned = self.goal.id, (np.array(cells[::-1], float).reshape(-1, 2)[:, ::-1] + 0.5) * R
        xs, ys = self.planned[1].T.copy()
        if not len(xs):
            empty = np.empty(0)
            return Path(self.now, self.goal.id, 1, reasons.UNREACHABLE.code, empty, empty, empty, 0.0, 0.0)
        near = int(np.argmin(np.hypot(xs - self.pose.x, ys - self.pose.y)))
        left = float(np.hypot(np.diff(xs[near:]), np.diff(ys[near:])).sum())
        return Path(self.now, self.goal.id, 1, "", xs[near:], ys[near:], np.zeros(len(xs) - near), left, left)

    def step(self):
        if self.n_steps % 10 == 0:
            self.see()
        super().step()


def test_it_explores_a_whole_office_and_says_that_nothing_is_left():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    robot.run(300, until=ENDS)
    assert (robot.status.state, robot.status.reason) == (NavState.REACHED, reasons.NO_FRONTIER.code)
    assert "could not be reached" not in robot.status.detail
    assert robot.covered > 0.99
    assert robot.moved < 90  # m; the building is 14 x 7 m
    assert not robot.goal.active


def test_a_frontier_that_was_seen_on_the_way_is_left_for_the_next_without_a_stop():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    robot.run(20)
    assert sum(goal.active for goal in robot.goals) >= 3
    assert all(order.active for order in robot.orders[1:])
    assert robot.moved > 14  # of 20 m at most


def test_a_frontier_that_cannot_be_seen_better_is_given_up():
    robot = Explorer(OFFICE, 1.2, 3.3)
    hole = np.zeros(robot.truth.shape, bool)
    hole[12:18, 60:68] = True  # black carpet: no beam ever comes back
    see = robot.see

    def blind():
        see()
        robot.known[hole] = -1
        robot.call("map", message(robot.known, R, version=robot.version + 1))

    robot.see = blind
    robot.explore()
    robot.run(300, until=ENDS)
    assert (robot.status.state, robot.status.reason) == (NavState.REACHED, reasons.NO_FRONTIER.code)


def test_frontiers_that_cannot_be_reached_are_tried_once_more_and_then_left():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.refusal = reasons.UNREACHABLE.code
    robot.explore()
    assert robot.run(300, until=ENDS) < 120
    assert (robot.status.state, robot.status.reason) == (NavState.REACHED, reasons.NO_FRONTIER.code)
    places = [(g.map_from_goal.x, g.map_from_goal.y) for g in robot.goals if g.active]
    assert len(places) < 30
    assert any(places.count(place) > 1 for place in places)


def test_the_end_of_a_robot_that_got_stuck_says_what_it_could_not_reach():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    robot.run(12)
    robot.follow_state, robot.follow_reason = FollowState.BLOCKED, reasons.BLOCKED.code
    robot.run(600, until=ENDS)
    assert (robot.status.state, robot.status.reason) == (NavState.REACHED, reasons.NO_FRONTIER.code)
    n_missed = int(robot.status.detail.split()[0])
    assert n_missed > 0
    assert robot.status.detail.endswith(f"could not be reached; the last cause: {reasons.BLOCKED.text}")


def test_a_robot_that_cannot_move_at_all_fails():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.follow_state = FollowState.BLOCKED
    robot.explore()
    assert robot.run(600, until=ENDS) < 200
    assert (robot.status.state, robot.status.reason) == (NavState.FAILED, reasons.RECOVERIES_USED.code)


def test_frontiers_that_local_control_cannot_get_to_do_not_end_exploring():
    robot = Explorer(OFFICE, 1.2, 3.3)
    path, barred = robot.path, []

    def in_the_way():
        x = robot.goal.map_from_goal.x if robot.goal is not None else 0.0
        barred.append(x > 9.0)  # everything in the east is behind something that only local control sees
        robot.follow_state = FollowState.BLOCKED if barred[-1] else None
        return path()

    robot.path = in_the_way
    robot.explore()
    robot.run(600, until=ENDS)
    assert (robot.status.state, robot.status.reason) == (NavState.REACHED, reasons.NO_FRONTIER.code)
    assert any(barred)
    assert robot.status.n_recoveries > 0


def test_a_blocked_frontier_costs_two_recoveries_and_a_few_seconds():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.follow_state = FollowState.BLOCKED
    robot.explore()
    robot.run(1.5)
    first = robot.goal.map_from_goal
    n = round(robot.run(60, until={NavState.FAILED, NavState.REACHED}))
    others = [g for g in robot.goals if g.active and g.map_from_goal != first]
    assert n
    assert robot.status.n_recoveries >= 2
    assert (others[0].stamp - robot.goals[0].stamp) / 1e9 < 10


def test_without_a_map_it_waits_and_then_fails():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.see = lambda: None
    robot.explore()
    assert robot.run(60, until=ENDS) < 25
    assert (robot.status.state, robot.status.reason) == (NavState.FAILED, reasons.NO_MAP.code)


def test_outside_of_the_map_it_waits_for_a_pose_and_then_says_so():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.run(1.0)
    robot.pose = Pose2(-50.0, 3.3)
    robot.see = lambda: None
    robot.explore()
    assert robot.run(60, until=ENDS) < 25
    assert (robot.status.state, robot.status.reason) == (NavState.FAILED, reasons.START_OUTSIDE.code)


def test_a_search_whose_result_never_comes_is_asked_for_again():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    while not robot.jobs:
        robot.step()
    robot.jobs.clear()
    robot.run(12)
    assert any(goal.active for goal in robot.goals)


def test_the_result_of_a_former_tasks_search_is_not_taken():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    while not robot.jobs:
        robot.step()
    ((_, job),) = robot.jobs
    robot.jobs.clear()
    robot.cancel()
    robot.call("frontiers_found", job.function(*job.arguments))
    robot.explore()
    robot.call("frontiers_found", job.function(*job.arguments))
    assert not any(goal.active for goal in robot.goals)


def test_exploring_can_be_paused_and_goes_on():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    robot.run(5)
    robot.pause()
    at = robot.pose
    robot.run(30)
    assert robot.pose == at
    robot.pause(False)
    robot.run(300, until=ENDS)
    assert robot.status.state is NavState.REACHED
    assert robot.covered > 0.99


def test_stop_ends_exploring():
    robot = Explorer(OFFICE, 1.2, 3.3)
    robot.explore()
    robot.run(5)
    robot.guarded(GuardState.STOPPED, reasons.ESTOP.code)
    robot.run(1)
    robot.guarded(GuardState.IDLE)
    at = robot.pose
    robot.run(10)
    assert robot.status.state is NavState.CANCELED
    assert robot.pose == at


def frontier_at(x, y, distance, size=1.0):
    cells = np.column_stack((np.full(10, round(y / R)), round(x / R) + np.arange(10) - 5)).astype(np.int64)
    return Frontier(x, y, 0.0, size, distance, cells)


def found(*frontiers, unreachable=()):
    places = np.array([(f.x, f.y) for f in frontiers]).reshape(-1, 2)
    between = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
    return Frontiers(frontiers, unreachable, False, between)


HERE = Pose2()
NEAR, FAR = frontier_at(2.0, 0.0, 2.0), frontier_at(8.0, 0.0, 8.0)


def test_near_before_far_large_before_small_ahead_before_behind():
    for better, worse in [
        (NEAR, FAR),
        (frontier_at(3.0, 0.0, 3.0, size=3.0), frontier_at(3.0, 2.0, 3.0, size=0.5)),
        (frontier_at(3.0, 0.0, 3.0), frontier_at(-3.0, 0.0, 3.0)),
    ]:
        target = Exploration(ExplorationConfig()).choose_target(found(worse, better), HERE, R)
        assert target is not None
        assert target.frontier is better


def test_a_small_corner_is_seen_before_a_long_way_off_that_would_lead_back_to_it():
    corner, rooms = frontier_at(-1.5, 0.0, 1.5, size=0.5), frontier_at(2.0, 0.0, 2.0, size=3.0)
    beyond = frontier_at(9.0, 0.0, 9.0)
    alone = Exploration(ExplorationConfig()).choose_target(found(rooms, corner), HERE, R)
    assert alone.frontier is rooms
    assert Exploration(ExplorationConfig()).choose_target(found(rooms, corner, beyond), HERE, R).frontier is corner


def test_a_target_is_kept_until_another_is_notably_better():
    exploration = Exploration(ExplorationConfig())
    far = exploration.choose_target(found(FAR), HERE, R)
    assert exploration.choose_target(found(FAR, frontier_at(0.0, 5.0, 6.5)), HERE, R) is far
    after = [exploration.choose_target(found(FAR, NEAR), HERE, R) for _ in range(ExplorationConfig().switch_after)]
    assert all(target is far for target in after[:-1])
    assert after[-1].frontier is NEAR


def test_a_better_frontier_that_is_gone_again_at_once_changes_nothing():
    exploration = Exploration(ExplorationConfig())
    far = exploration.choose_target(found(FAR), HERE, R)
    for _ in range(10):
        assert exploration.choose_target(found(FAR, NEAR), HERE, R) is far
        assert exploration.choose_target(found(FAR), HERE, R) is far


def test_a_target_that_no_way_leads_to_right_now_is_kept_and_one_that_was_seen_is_not():
    exploration = Exploration(ExplorationConfig())
    far = exploration.choose_target(found(FAR), HERE, R)
    assert exploration.choose_target(found(NEAR, unreachable=(FAR.cells,)), HERE, R) is far
    assert exploration.choose_target(found(NEAR), HERE, R).frontier is NEAR


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32))
def test_frontiers_that_come_and_go_are_not_chosen_for_ever(seed):
    rng = np.random.default_rng(seed)
    some = [frontier_at(float(x), float(y), 3.0) for x, y in rng.uniform(-5, 5, (6, 2))]
    exploration, n_chosen, last = Exploration(ExplorationConfig()), 0, None
    for _ in range(300):
        dropped = {tuple(cell) for cell in exploration.dropped}
        there = [f for f in some if rng.random() < 0.5 and not dropped & {tuple(cell) for cell in f.cells}]
        target = exploration.choose_target(found(*there), HERE, R)
        n_chosen += target is not None and target is not last
        last = target
    assert n_chosen <= len(some) * ExplorationConfig().max_visits


def test_any_office_is_explored_to_the_end_whatever_the_view():
    for sees in (1.5, 6.0):
        robot = Explorer(OFFICE, 12.0, 3.3, sees=sees, config=NavigatorConfig())
        robot.explore()
        robot.run(600, until=ENDS)
        assert robot.status.reason == reasons.NO_FRONTIER.code
        assert robot.covered > 0.98


@pytest.mark.parametrize("config", [ExplorationConfig(), ExplorationConfig(switch_gain=0.0)])
def test_targets_do_not_swing_between_two_like_frontiers(config):
    exploration = Exploration(config)
    pair = found(frontier_at(3.0, 2.0, 3.6), frontier_at(3.0, -2.0, 3.6))
    targets = [exploration.choose_target(pair, Pose2(0.1 * i, 0.0), R) for i in range(10)]
    assert all(a is b for a, b in pairwise(targets))


def test_who_explores_and_is_lost_before_there_is_anywhere_to_go_gives_up_with_the_reason():
    bench = Explorer(OFFICE, 1.0, 1.0)
    bench.localization = Localization.LOST
    bench.run(3)
    bench.explore()
    assert bench.run(60, until=ENDS) > 20
    assert (bench.status.state, bench.status.reason) == (NavState.FAILED, reasons.POSE_LOST.code)


def small(x):
    """A frontier of 0.6 m at x, 0."""
    return Frontier(x, 0.0, 0.0, 0.6, abs(x), np.array([[0, round(x / R)]]))


def test_a_small_frontier_that_moves_on_before_the_robot_is_followed():
    """As in a narrow corridor with a short view."""
    exploration = Exploration(ExplorationConfig())
    for step in range(20):
        x = 1.0 + 0.6 * step
        target = exploration.choose_target(found(small(x)), Pose2(x - 1.0, 0.0), R)
        assert target is not None
        assert target.x == pytest.approx(x, abs=R)
