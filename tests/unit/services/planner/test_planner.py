# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.planner.costmap import CostConfig
from services.planner.service import PlannerConfig, PlannerService
from shared import reasons, topics
from shared.config import Robot, load_robot
from shared.geometry import Pose2
from shared.messages import TILE_CELLS, Goal, Localization, MapUpdate, Odometry, PoseEstimate, Recovery, RecoveryKind
from shared.service import Log
from tests.strategies import faults, publications
from tests.unit.services.maps import message, room

S = 1_000_000_000
X80 = load_robot("x80sv").robot
COVARIANCE = np.zeros(9)


AT = Pose2(1.0, 2.0)


class PlannerBench:
    """A planner with a clock and a map that changes; the robot stands where it is put."""

    def __init__(self, cells, pose=AT, **cost):
        self.planner = PlannerService(PlannerConfig(cost=CostConfig(**cost)), X80)
        self.cells, self.version, self.out = None, 0, []
        self.planner.now = 100 * S
        self.show(cells)
        self.put(pose)

    def take(self, effects):
        paths = [effect.message for effect in effects if effect.topic is topics.PLAN]
        for path in paths:
            assert not list(faults(path))
        self.out += paths
        return paths

    def show(self, cells):
        self.version += 1
        update = message(cells, version=self.version, since=self.cells)
        self.cells = cells.copy()
        return self.take(self.planner.map(update))

    def put(self, pose, state=Localization.GOOD):
        now = self.planner.now
        return self.take(self.planner.pose(PoseEstimate(now, pose, pose, COVARIANCE, 1.0, state))) + self.take(
            self.planner.odometry(Odometry(now, Pose2(), 0.0, 0.0, COVARIANCE))
        )

    def recover(self, number):
        recovery = Recovery(self.planner.now, number, RecoveryKind.BACK_UP, 0.3)
        return self.take(self.planner.new_recovery(recovery))

    def go(self, pose, number=1, active=True):
        now = self.planner.now
        return self.take(self.planner.new_goal(Goal(now, number, active, pose, 0.15, 0.25, False)))

    def pass_time(self, seconds):
        """The confirmations of that time; the last one's path."""
        for _ in range(round(seconds * 2)):
            self.planner.now += S // 2
            self.take(self.planner.confirm())
        return self.out[-1]


def two_ways(upper=True, lower=True):
    """10 x 8 m with a block in the middle: a way over it and a way under it, each 1.5 m wide, or closed."""
    cells = room(8, 10)
    cells[32:132, 80:120] = 100
    if not upper:
        cells[132:, 90:95] = 100
    if not lower:
        cells[:32, 90:95] = 100
    return cells


def goes_above(path):
    return bool(path.ys[np.argmin(np.abs(path.xs - 5.0))] > 4.0)


def test_a_new_goal_is_answered_at_once_and_confirmed_twice_a_second():
    bench = PlannerBench(room(4, 8))
    (path,) = bench.go(Pose2(6.0, 2.0, 1.0), number=7)
    assert (path.goal_id, path.map_version, path.reason) == (7, 1, "")
    assert path.length == pytest.approx(5.0, abs=0.02)
    bench.pass_time(3.0)
    assert len(bench.out) == 1 + 6
    assert len({confirmed.stamp for confirmed in bench.out}) == 7
    assert all((p.xs == path.xs).all() for p in bench.out)


@pytest.mark.parametrize("recovers", [False, True])
def test_while_the_robot_stands_or_recovers_it_publishes_nothing(recovers):
    bench = PlannerBench(room(4, 8))
    bench.go(Pose2(6.0, 2.0))
    n = len(bench.out)
    if recovers:
        bench.recover(2)
    else:
        bench.go(Pose2(6.0, 2.0), number=2, active=False)
    bench.pass_time(3.0)
    bench.show(room(4, 9))
    assert len(bench.out) == n
    bench.go(Pose2(6.0, 2.0), number=3)
    assert len(bench.out) == n + 1


def test_an_order_that_arrives_after_a_later_one_is_ignored():
    bench = PlannerBench(room(4, 8))
    bench.go(Pose2(6.0, 2.0), number=3)
    n = len(bench.out)
    bench.planner.now += S // 100
    late = Recovery(bench.planner.now - S // 50, 2, RecoveryKind.TURN, 1.0)
    bench.take(bench.planner.new_recovery(late))
    bench.pass_time(3.0)
    assert len(bench.out) > n


def test_an_older_goal_that_arrives_late_is_not_taken():
    bench = PlannerBench(room(4, 8))
    late = Goal(bench.planner.now - S, 1, True, Pose2(2.0, 2.0), 0.1, 0.1, False)
    bench.go(Pose2(6.0, 2.0), number=2)
    assert not bench.take(bench.planner.new_goal(late))
    assert bench.pass_time(0.5).goal_id == 2


def test_the_path_begins_at_the_robot_as_it_drives():
    bench = PlannerBench(room(4, 8))
    bench.go(Pose2(6.0, 2.0))
    bench.put(Pose2(3.0, 2.1))
    path = bench.pass_time(0.5)
    assert path.xs[0] == pytest.approx(3.0, abs=0.06)
    assert path.length == pytest.approx(3.0, abs=0.06)


def test_odometry_carries_the_pose_on():
    bench = PlannerBench(room(4, 8), pose=Pose2(1.0, 2.0, np.pi / 2))
    for step in range(1, 11):  # 2 m to the right, 0.4 m ahead
        bench.planner.odometry(Odometry(bench.planner.now, Pose2(0.04 * step, -0.2 * step), 0.5, 0.0, COVARIANCE))
    (path,) = bench.go(Pose2(6.0, 2.0))
    assert (path.xs[0], path.ys[0]) == pytest.approx((3.0, 2.4))


def test_without_map_or_pose_it_says_so():
    planner = PlannerService(PlannerConfig(), X80)
    goal = Goal(0, 1, True, Pose2(6.0, 2.0), 0.15, 0.25, False)

    def told(effects):
        return [effect.message.reason for effect in effects if effect.topic is topics.PLAN]

    assert told(planner.new_goal(goal)) == [reasons.NO_MAP.code]
    assert told(planner.map(message(room(4, 8)))) == [reasons.POSE_OLD.code]
    assert told(planner.confirm()) == [reasons.POSE_OLD.code]


def test_a_robot_off_the_plan_gets_a_new_one_at_once():
    bench = PlannerBench(room(4, 8))
    bench.go(Pose2(6.0, 2.0))
    (path,) = bench.put(Pose2(2.0, 3.0))
    assert (path.xs[0], path.ys[0]) == pytest.approx((2.0, 3.0))
    assert not bench.put(Pose2(2.0, 3.05))


def test_a_wall_that_is_discovered_on_the_way_changes_the_plan_at_once():
    unseen, seen = two_ways(), two_ways(upper=False)
    unseen[130:, 85:] = -1
    bench = PlannerBench(unseen, pose=Pose2(3.0, 7.0), unknown="allowed")
    bench.go(Pose2(8.0, 7.0))
    assert goes_above(bench.out[-1])
    bench.planner.now += S
    (path,) = bench.show(seen)
    assert not goes_above(path)
    assert path.map_version == 2


def test_a_way_closed_in_space_that_was_seen_free_changes_the_plan_after_a_while():
    bench = PlannerBench(two_ways(), pose=Pose2(3.0, 7.0))
    bench.go(Pose2(8.0, 7.0))
    bench.show(two_ways(upper=False))
    assert goes_above(bench.pass_time(2.0))
    assert not goes_above(bench.pass_time(2.0))


def test_a_map_that_shuts_the_goal_off_is_answered_with_the_reason_and_its_opening_with_a_path():
    bench = PlannerBench(two_ways(), pose=Pose2(3.0, 4.0))
    bench.go(Pose2(8.0, 4.0))
    bench.show(two_ways(upper=False, lower=False))
    path = bench.pass_time(5.0)
    assert (path.reason, len(path.xs), path.length) == (reasons.UNREACHABLE.code, 0, 0.0)
    bench.show(two_ways())
    assert bench.pass_time(0.5).reason == ""


def test_a_slightly_shorter_other_side_does_not_change_the_plan():
    bench = PlannerBench(two_ways(), pose=Pose2(1.0, 4.3))
    bench.go(Pose2(8.0, 4.1))
    assert goes_above(bench.out[-1])
    for y in (3.9, 4.2, 3.8, 4.3, 3.9):
        bench.put(Pose2(1.0, y))
        assert goes_above(bench.pass_time(0.5))


def test_a_person_far_ahead_on_the_way_does_not_send_the_robot_around_the_house():
    cells = room(8, 12)
    cells[80:84, :200] = 100  # two long halves, joined at the far end only
    cells[80:84, 60:80] = 0  # and by a door
    bench = PlannerBench(cells, pose=Pose2(1.0, 1.0))
    bench.go(Pose2(1.5, 7.0))
    direct = bench.out[-1].length
    crossed = cells.copy()
    crossed[80:84, 60:80] = 100
    bench.show(crossed)
    assert bench.pass_time(1.5).length == pytest.approx(direct, abs=0.1)
    bench.show(cells)
    assert bench.pass_time(1.0).length == pytest.approx(direct, abs=0.1)
    bench.show(crossed)  # for good, this time
    assert bench.pass_time(4.0).length > direct + 5


def test_people_walking_through_do_not_make_the_plan_change_sides():
    rng = np.random.default_rng(3)
    bench = PlannerBench(two_ways(), pose=Pose2(1.0, 4.3))
    bench.go(Pose2(9.0, 4.1))
    sides = []
    for step in range(120):
        cells = two_ways()
        for walker in range(4):
            row, column = 20 + 30 * walker + int(rng.integers(-5, 5)), (7 * step + 53 * walker) % 180 + 10
            cells[row : row + 6, column : column + 6] = 100
        cells[60:110, 4:40] = 0  # no person walks into the robot
        bench.show(cells)
        path = bench.pass_time(0.5)
        if not path.reason:
            sides.append(goes_above(path))
    assert len(sides) > 100
    assert sum(a != b for a, b in pairwise(sides)) <= 4  # in one minute


def test_while_the_pose_is_lost_the_plan_stays_what_it_was():
    bench = PlannerBench(room(4, 8))
    (path,) = bench.go(Pose2(6.0, 2.0))
    bench.put(Pose2(2.0, 3.5), Localization.LOST)
    assert (bench.pass_time(1.0).ys == path.ys).all()


def test_another_map_is_planned_on_from_scratch():
    bench = PlannerBench(room(4, 8))
    bench.go(Pose2(6.0, 2.0))
    bench.planner.now += S
    (path,) = bench.take(bench.planner.map(message(room(3, 5), version=1, map_id=2)))
    assert path.reason == reasons.UNREACHABLE.code  # the goal lies outside of the smaller room now


def test_a_path_leads_through_what_other_robots_know_and_around_their_walls():
    """The own map ends at the door. Behind it another robot knows a wall with a gap to the right."""
    whole = room(4, 8)
    whole[:60, 80:84] = 100
    mine = whole.copy()
    mine[:, 70:] = -1
    bench = PlannerBench(mine)
    (straight,) = bench.go(Pose2(6.0, 2.0))
    bench.planner.now += S
    (around,) = bench.take(bench.planner.others_map(message(whole, map_id=9)))
    assert straight.ys.max() < 2.5
    assert around.ys.max() > 3.2
    bench.planner.now += S
    nothing = replace(message(whole, map_id=10).only(np.zeros(0, int)), version=1)
    (again,) = bench.take(bench.planner.others_map(nothing))
    assert again.ys.max() < 2.5, "the others have left"


@pytest.mark.parametrize("robot", ["x80sv", "jackal"])
def test_warming_up_changes_no_state(robot):
    planner = PlannerService(PlannerConfig(), load_robot(robot).robot)
    planner.warm_up()
    assert planner.present.grid.empty
    assert planner.goal is planner.monitor.plan is planner.present.costmap is None


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(publications(PlannerService), max_size=25))
def test_any_valid_messages_are_survived(events):
    planner = PlannerService(PlannerConfig(), X80)
    for method, event in events:
        planner.now += S // 3
        for effect in list(getattr(planner, method)(*([event] if event else []))):
            assert isinstance(effect, Log) or not list(faults(effect.message))


@pytest.mark.parametrize("resolution", [0.5979310939815127, 0.3, 0.1, 0.07])
def test_a_robot_on_the_edge_of_its_cell_has_a_path_of_no_negative_cost(resolution):
    """The edge lies beside the cell or in it by a rounding: with other cells blocked, the path would be too."""
    for name, column in product(("x80sv", "jackal"), range(-3, 1)):
        planner = PlannerService(PlannerConfig(), load_robot(name).robot)
        planner.now = S
        cells = np.full((2, TILE_CELLS**2), 100, np.int8)
        places = np.array([0, 0], np.int32), np.array([0, column], np.int32)
        list(planner.map(MapUpdate(0, 0, 0, resolution, *places, cells)))
        list(planner.pose(PoseEstimate(0, Pose2(), Pose2(), np.zeros(9), 0.0, Localization.STARTING)))
        sent = list(planner.new_goal(Goal(0, 0, True, Pose2(), 3.93, 4.0, False)))
        assert [fault for publication in sent for fault in faults(publication.message)] == []


@pytest.mark.parametrize("radius", [0.05, 0.1, 0.3])
def test_a_robot_that_is_on_its_plan_keeps_it_however_tight_its_arcs(radius):
    drive = {**X80.drive.model_dump(), "min_turning_radius": radius}
    planner = PlannerService(PlannerConfig(), Robot.model_validate({**X80.model_dump(), "drive": drive}))
    planner.now = 100 * S
    list(planner.map(message(room(4, 12))))

    def put(x):
        list(planner.pose(PoseEstimate(planner.now, Pose2(x, 2.0), Pose2(), COVARIANCE, 1.0, Localization.GOOD)))
        list(planner.odometry(Odometry(planner.now, Pose2(x, 2.0), 1.0, 0.0, COVARIANCE)))

    put(1.0)
    list(planner.new_goal(Goal(planner.now, 1, True, Pose2(10.5, 2.0), 0.15, 0.25, False)))
    plan = planner.monitor.plan
    for step in range(1, 80):
        planner.now += S // 10
        put(1.0 + 0.1 * step)
        if step % 5 == 0:
            list(planner.confirm())
    assert planner.monitor.plan is plan


AFTER_WARMING = """
import shared.repeatable
from shared.geometry import Pose2
from tests.compiling import nothing_compiles
from tests.unit.services.maps import room
from tests.unit.services.planner.test_planner import PlannerBench
from tests.unit.services.planner.test_keep_out_layer import MIDDLE, hold

bench = PlannerBench(room(4, 8))
bench.planner.warm_up()
with nothing_compiles():
    bench.go(Pose2(6.0, 2.0))
    bench.go(Pose2(7.97, 2.0), 2)
    hold(bench, MIDDLE)
    bench.go(Pose2(6.0, 2.0), 3)
"""


def test_after_warming_nothing_is_compiled_while_the_robot_moves():
    ended = subprocess.run([sys.executable, "-c", AFTER_WARMING], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
