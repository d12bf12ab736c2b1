# SPDX-License-Identifier: Apache-2.0
"""What local control commands and says, input by input and goal by goal."""

import subprocess
import sys
from dataclasses import replace
from math import pi

import numpy as np
import pytest

from services.local_ctrl.service import LocalCtrlConfig, LocalCtrlService
from services.traffic.outgoing import no_other_robot
from shared import messages as m
from shared import reasons, topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import FollowState, RecoveryKind
from shared.service import handlers
from shared.types import NS_PER_S
from tests.unit.services.local_ctrl.tiny_world import (
    ControlLoop,
    TinyWorld,
    drive_goal,
    off,
    path_message,
    planned,
    recovery,
)

ROBOT = load_robot("x80sv").robot
START, GOAL = Pose2(1.0, 2.0, 0.0), Pose2(6.0, 2.0, 0.0)


def moving(seconds: float = 2.0) -> ControlLoop:
    """In the open, at speed, on the way."""
    world = TinyWorld(8, 4)
    loop = ControlLoop(ROBOT, world, START).give(drive_goal(GOAL), planned(world, START, GOAL, 0.25))
    loop.drive(seconds)
    assert loop.run.commands[-1].v > 0.5
    return loop


def last(loop: ControlLoop) -> tuple[m.Velocity, m.FollowStatus]:
    return loop.run.commands[-1], loop.run.statuses[-1]


def test_it_listens_and_ticks_as_the_registry_says() -> None:
    found = handlers(LocalCtrlService)
    inputs = {"scan", "base/ranges", "odom", "pose", "map", "map/state", "plan", "goal", "recovery", "zones"}
    inputs |= {"hardware/contacts", "scan_2", "traffic/others", "traffic/right_of_way"}
    assert set(found.topics) == inputs | {"settings"}  # its own, after a restart
    assert found.ticks == ((topics.CMD_NAV.hz, "tick", "scan"),)


def test_without_a_goal_it_is_idle_and_stands() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(4, 4), Pose2(2, 2))
    loop.drive(0.3)
    command, status = last(loop)
    assert (command.v, command.w, command.reason, status.state) == (0, 0, "", FollowState.IDLE)


def test_an_inactive_goal_stops_at_once() -> None:
    loop = moving()
    loop.give(replace(drive_goal(GOAL, goal_id=2), active=False))
    loop.drive(0.1)
    command, status = last(loop)
    assert (command.v, command.w, status.state, status.goal_id) == (0, 0, FollowState.IDLE, 2)


@pytest.mark.parametrize(
    ("lost", "after", "reason"),
    [
        ("odometry", 0.2, reasons.ODOM_OLD),
        ("scan", 0.5, reasons.SCAN_OLD),
        ("pose", 1.2, reasons.POSE_OLD),
        ("new_plan", 2.5, reasons.PLAN_OLD),
    ],
)
def test_an_input_that_stops_coming_stops_the_robot_and_says_which(
    lost: str, after: float, reason: reasons.Reason
) -> None:
    loop = moving()
    loop.lost = {lost}
    loop.drive(after + 0.15, until=lambda loop: loop.run.commands[-1].reason != "")
    command, status = last(loop)
    assert command.reason == status.reason == reason.code
    assert status.state is FollowState.BLOCKED
    loop.drive(0.9)
    command, _ = last(loop)
    assert (command.v, command.w, command.reason) == (0, 0, reason.code)
    loop.lost = set()
    loop.drive(1.5)
    assert loop.run.commands[-1].v > 0.3


@pytest.mark.parametrize("stamp", [1, 10**18])
def test_an_input_from_another_clock_is_old(stamp: int) -> None:
    loop = moving()
    loop.lost = {"scan"}
    scan = loop.service.inputs.scans["scan"]
    assert scan is not None
    loop.service.now = loop.now
    list(loop.service.scan(replace(scan, stamp=stamp)))
    loop.drive(0.4)
    assert loop.run.commands[-1].reason == reasons.SCAN_OLD.code


@pytest.mark.parametrize(("age", "counts"), [(0.0, True), (0.2, True), (0.4, False), (1.9, False), (-3600.0, False)])
def test_an_echo_of_another_moment_is_no_obstacle_where_the_robot_is_now(age: float, counts: bool) -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), START)
    loop.drive(0.3)
    loop.service.now = loop.now
    sensors = ROBOT.ranges
    mounts = ((s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view) for s in sensors)
    columns = np.array(list(mounts), np.float32).T.copy()
    echoes = np.full(len(sensors), np.nan, np.float32)
    echoes[0] = 0.8
    list(loop.service.ranges(m.RangeReadings(loop.now - round(age * NS_PER_S), *columns, echoes)))
    assert loop.service.costmap.echo_at.any() == counts
    assert bool(loop.service.rejections.last_problem(topics.RANGES.key)) != counts


@pytest.mark.parametrize("ahead", [0.25, 0.29])
def test_scans_of_moments_that_odometry_does_not_tell_are_no_scans(ahead: float) -> None:
    loop = moving()
    send = loop.send

    def ahead_of_time(method: str, message: m.Message) -> None:
        if isinstance(message, m.LaserScan):
            message = replace(message, stamp=message.stamp + round(ahead * NS_PER_S))
        send(method, message)

    loop.send = ahead_of_time
    loop.drive(1.5)
    command, _ = last(loop)
    assert (command.v, command.reason) == (0, reasons.BAD_STAMPS.code)


def test_a_robot_that_does_not_know_where_it_is_stands() -> None:
    loop = moving()
    loop.lost = {"pose"}
    pose = loop.service.inputs.pose
    assert pose is not None
    list(loop.service.pose(replace(pose, stamp=pose.stamp + 1, state=m.Localization.LOST)))
    loop.drive(0.2)
    assert loop.run.commands[-1].reason == reasons.POSE_LOST.code


def test_a_pose_that_jumps_holds_the_robot_until_it_is_planned_again() -> None:
    loop = moving()
    loop.lost = {"pose", "new_plan"}
    pose = loop.service.inputs.pose
    assert pose is not None
    list(loop.service.pose(replace(pose, stamp=loop.now, map_from_odom=Pose2(1.0) @ pose.map_from_odom)))
    loop.drive(0.3)
    assert loop.run.commands[-1].reason == reasons.POSE_JUMPED.code
    loop.lost = set()
    loop.drive(1.5, until=lambda loop: loop.run.commands[-1].reason == "")
    assert loop.run.commands[-1].reason == ""


def test_a_plan_for_nothing_stops_with_the_planner_s_reason() -> None:
    loop = moving()
    loop.plan = None
    none = np.zeros(0)
    loop.send("new_plan", m.Path(loop.now, 1, 1, reasons.UNREACHABLE.code, none, none, none, 0.0, 0.0))
    loop.drive(1.2)
    command, status = last(loop)
    assert (command.v, command.reason, status.state) == (0, reasons.UNREACHABLE.code, FollowState.BLOCKED)


def test_without_any_plan_it_waits_for_one() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(4, 4), Pose2(2, 2)).give(drive_goal(Pose2(3, 2)))
    loop.drive(0.6)
    command, status = last(loop)
    assert (command.v, command.w, command.reason, status.state) == (0, 0, reasons.NO_PLAN.code, FollowState.BLOCKED)


def test_a_new_goal_ahead_is_taken_without_slowing_down() -> None:
    loop = moving()
    further = Pose2(7.0, 2.5, 0.0)
    n_before = len(loop.run.commands)
    loop.give(drive_goal(further, goal_id=2))
    loop.drive(0.4)
    loop.plan = planned(loop.world, loop.truth, further, 0.25)
    loop.drive(12)
    assert min(command.v for command in loop.run.commands[n_before : n_before + 30]) > 0.7
    assert loop.run.statuses[-1].goal_id == 2
    assert off(loop.truth, further)[0] < 0.15


def test_the_old_plan_does_not_serve_a_new_goal_for_long() -> None:
    loop = moving(1.5)
    loop.give(drive_goal(Pose2(7.0, 2.5), goal_id=2))
    loop.drive(1.5)
    assert loop.run.commands[-1].reason == reasons.NO_PLAN.code


def test_the_end_of_the_old_plan_is_not_the_new_goal() -> None:
    loop = moving()
    loop.drive(12, until=lambda loop: loop.run.statuses[-1].state is FollowState.ARRIVED)
    there, further = loop.truth, Pose2(2.0, 2.5, 0.0)
    loop.give(drive_goal(further, goal_id=2))
    loop.drive(0.9)
    told = {status.state for status in loop.run.statuses if status.goal_id == 2}
    assert told == {FollowState.FOLLOWING}
    loop.plan = planned(loop.world, there, further, 0.25)
    loop.drive(20, until=lambda loop: loop.run.statuses[-1].state is FollowState.ARRIVED)
    assert off(loop.truth, further)[0] < 0.15


def test_what_is_left_of_the_old_plan_is_not_all_that_is_left_to_a_new_goal() -> None:
    loop = moving()
    loop.drive(12, until=lambda loop: loop.run.statuses[-1].distance_left < 0.5)
    further = Pose2(3.0, 2.0, 0.0)
    loop.give(drive_goal(further, goal_id=2))
    loop.drive(0.9)
    told = [status.distance_left for status in loop.run.statuses if status.goal_id == 2]
    assert len(told) > 10
    assert min(told) >= GOAL.distance(further) - 0.1


@pytest.mark.parametrize("reason", [reasons.PLAN_OLD, reasons.UNREACHABLE])
def test_what_was_no_plan_to_follow_is_none_for_a_new_goal_either(reason: reasons.Reason) -> None:
    loop = moving(1.0)
    loop.lost = {"new_plan"}
    if reason is reasons.UNREACHABLE:
        none = np.zeros(0)
        loop.service.now = loop.now
        list(loop.service.new_plan(m.Path(loop.now, 1, 1, reason.code, none, none, none, 0.0, 0.0)))
    loop.drive(4.0, until=lambda loop: loop.run.commands[-1].reason == reason.code)
    loop.drive(1.0)
    there = loop.truth
    loop.give(drive_goal(GOAL, goal_id=2))  # as after a recovery, when the navigator asks for a new plan
    loop.drive(1.5)
    assert loop.truth == there
    assert loop.run.commands[-1].reason == reasons.NO_PLAN.code


def test_the_same_goal_told_again_changes_nothing() -> None:
    loop = moving()
    assert loop.goal is not None
    before = loop.service.manoeuvre, loop.service.plan.goal_since
    loop.send("new_goal", loop.goal)
    assert (loop.service.manoeuvre, loop.service.plan.goal_since) == before


def test_an_older_goal_that_comes_late_is_ignored_and_a_restarted_navigator_is_not() -> None:
    loop = moving()
    loop.send("new_goal", replace(drive_goal(GOAL, goal_id=0), stamp=NS_PER_S))
    assert loop.service.order is not None
    assert loop.service.order.id == 1
    loop.send("new_goal", replace(drive_goal(GOAL, goal_id=0), stamp=loop.now))
    assert loop.service.order.id == 0


def test_clearing_the_costmap_forgets_what_was_seen() -> None:
    loop = moving()
    assert loop.service.costmap.evidence.any()
    loop.send("new_goal", replace(drive_goal(GOAL, goal_id=2), clear_costmap=True))
    assert not loop.service.costmap.evidence.any()


def test_odometry_that_starts_again_forgets_the_costmap_and_waits_for_a_pose_in_it() -> None:
    loop = moving()
    loop.lost = {"pose"}
    loop.send("odometry", m.Odometry(loop.now + 1, Pose2(30.0, 0.0, 0.0), 0.0, 0.0, np.zeros(9)))
    assert not loop.service.costmap.evidence.any()
    loop.service.now = loop.now + 2
    list(loop.service.scan(replace(scan_of(loop), stamp=loop.now - NS_PER_S // 20)))
    command = next(iter(loop.service.tick())).message
    assert isinstance(command, m.Velocity)
    assert (command.v, command.reason) == (0, reasons.POSE_OLD.code)


def scan_of(loop: ControlLoop) -> m.LaserScan:
    laser = loop.robot.laser
    ranges = np.full(laser.n_beams, 2.0, np.float32)
    return m.LaserScan(loop.now, laser.angle_min, laser.angle_increment, laser.scan_time, 0.06, 5.0, ranges)


@pytest.mark.parametrize("amount", [0.3, 0.1])
def test_backing_up_goes_back_by_the_amount_slowly(amount: float) -> None:
    start = Pose2(4, 2, 0.5)
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), start).give(recovery(RecoveryKind.BACK_UP, amount))
    run = loop.drive(8)
    moved = start.inverse() @ loop.truth
    assert run.reached
    assert moved.x == pytest.approx(-amount, abs=0.03)
    assert abs(moved.y) < 0.02
    assert min(run.v) >= -0.13


def test_a_recovery_that_arrives_after_a_later_goal_is_ignored() -> None:
    loop = moving()
    loop.give(drive_goal(GOAL, goal_id=3), loop.plan)
    sent_before = loop.goal.stamp - NS_PER_S // 50
    loop.send("new_recovery", replace(recovery(RecoveryKind.TURN, 1.0, order_id=2), stamp=sent_before))
    loop.drive(0.1)
    assert last(loop)[1].goal_id == 3
    assert last(loop)[1].state is FollowState.FOLLOWING


def test_backing_up_stops_before_what_stands_behind() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4).box(3.2, 1.5, 3.3, 2.5), Pose2(3.9, 2, 0)).give(
        recovery(RecoveryKind.BACK_UP, 1.0)
    )
    run = loop.drive(6)
    assert run.statuses[-1].reason == run.commands[-1].reason == reasons.BLOCKED.code
    assert 0.02 < run.least_clearance < 0.15


def test_backing_up_stops_before_what_lies_in_the_blind_sector_and_was_seen_before() -> None:
    world, start = TinyWorld(8, 4).box(5.2, 1.5, 5.4, 2.5), Pose2(4.0, 2.0, 0.0)
    loop = ControlLoop(load_robot("jackal").robot, world, start).give(recovery(RecoveryKind.TURN, pi))
    loop.drive(8)
    assert loop.run.reached
    loop.give(recovery(RecoveryKind.BACK_UP, 2.0, order_id=2))
    run = loop.drive(8, until=lambda loop: loop.run.commands[-1].reason != "")
    assert run.commands[-1].reason == reasons.BLOCKED.code
    assert loop.truth.x > 4.2
    assert run.least_clearance > 0.02


def test_no_recovery_moves_a_robot_that_does_not_hear_of_the_others() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), Pose2(4, 2)).give(recovery(RecoveryKind.BACK_UP, 0.3))
    loop.send("right_of_way", replace(no_other_robot(loop.now - 2 * NS_PER_S), active=True))
    run = loop.drive(1)
    command, status = last(loop)
    assert set(run.v) == {0.0}
    assert (command.v, command.reason) == (0, reasons.TRAFFIC_OLD.code)
    assert (status.state, status.reason) == (FollowState.BLOCKED, reasons.TRAFFIC_OLD.code)


@pytest.mark.parametrize("ultrasonic", [True, False])
@pytest.mark.parametrize("infrared", [True, False])
def test_only_the_chosen_range_sensors_mark_obstacles(ultrasonic: bool, infrared: bool) -> None:
    chosen = {"ultrasonic": ultrasonic, "infrared": infrared}
    loop = ControlLoop(ROBOT, TinyWorld(4, 4), Pose2(2, 2), LocalCtrlConfig.model_validate({"costmap": chosen}))
    loop.drive(0.1)
    sensors = ROBOT.ranges
    columns = np.array([[s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view] for s in sensors], np.float32).T.copy()
    loop.send("ranges", m.RangeReadings(loop.now, *columns, np.full(len(sensors), 0.3, np.float32)))
    costmap, here = loop.service.costmap, loop.service.inputs.odometry.odom_from_base
    for sensor in sensors:
        at = here @ Pose2(sensor.mount.x, sensor.mount.y, sensor.mount.yaw) @ Pose2(0.3, 0.0, 0.0)
        row, column = (round((v - v0) / costmap.resolution) for v, v0 in ((at.y, costmap.y0), (at.x, costmap.x0)))
        if chosen[sensor.kind] or not (ultrasonic or infrared):  # else another kind's arc may lie on it
            assert bool(costmap.echo_at[row, column]) == chosen[sensor.kind]


@pytest.mark.parametrize("drive_s", [0.0, 0.3])
def test_a_robot_that_must_not_reverse_says_so_at_once_and_may_still_go_ahead(drive_s: float) -> None:
    robot = ROBOT.model_copy(update={"drive": ROBOT.drive.model_copy(update={"max_reverse_speed": drive_s})})
    config = LocalCtrlConfig(max_reverse_speed=0.0)
    loop = ControlLoop(robot, TinyWorld(8, 4), Pose2(4, 2), config).give(recovery(RecoveryKind.BACK_UP, 0.3))
    run = loop.drive(1, until=lambda loop: loop.run.statuses[-1].reason != reasons.SCAN_OLD.code)
    assert (run.statuses[-1].state, run.statuses[-1].reason) == (FollowState.FAILED, reasons.NO_REVERSE.code)
    assert set(run.v) == {0.0}
    assert loop.give(recovery(RecoveryKind.BACK_UP, -0.2, order_id=2)).drive(5).reached


@pytest.mark.parametrize("amount", [1.57, -2.5, 2 * pi, -0.2])
def test_turning_goes_round_by_the_amount_on_the_spot(amount: float) -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), Pose2(4, 2, 3.0)).give(recovery(RecoveryKind.TURN, amount))
    run = loop.drive(12)
    turned = np.unwrap([pose.yaw for pose in [Pose2(4, 2, 3.0), *run.poses]])
    assert run.reached
    assert turned[-1] - turned[0] == pytest.approx(amount, abs=0.12)
    assert loop.truth.distance(Pose2(4, 2)) < 0.02


def test_waiting_takes_its_time_and_moves_nothing() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), Pose2(4, 2)).give(recovery(RecoveryKind.WAIT, 1.0))
    run = loop.drive(5)
    assert run.reached
    assert run.seconds == pytest.approx(1.3, abs=0.15)  # its first scan comes 0.2 s after the start
    assert {(command.v, command.w) for command in run.commands} == {(0, 0)}


def test_arrived_stays_arrived_until_the_next_goal() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), Pose2(4, 2)).give(recovery(RecoveryKind.TURN, 0.3))
    loop.drive(4)
    loop.drive(1, until=lambda _: False)
    assert loop.run.reached
    loop.give(recovery(RecoveryKind.TURN, 0.3, order_id=2))
    loop.drive(0.2)
    assert loop.run.statuses[-1].state is FollowState.FOLLOWING


def test_scans_of_any_length_and_content_are_survived() -> None:
    loop = moving()
    for n, value in ((2, np.nan), (2000, 0.0), (7, 4.9), (360, 0.01)):
        scan = replace(scan_of(loop), stamp=loop.now, ranges=np.full(n, value, np.float32), angle_increment=2 * pi / n)
        loop.send("scan", scan)
        loop.drive(0.06)
    readings = m.RangeReadings(loop.now, *(np.full(3, 0.3, np.float32) for _ in range(5)))
    loop.send("ranges", readings)
    assert np.isfinite([command.v for command in loop.run.commands]).all()


def test_a_robot_without_range_sensors_ignores_readings() -> None:
    loop = ControlLoop(load_robot("jackal").robot, TinyWorld(4, 4), Pose2(2, 2))
    loop.send("ranges", m.RangeReadings(loop.now, *(np.zeros(1, np.float32) for _ in range(5))))
    loop.drive(0.1)
    assert loop.run.statuses[-1].state is FollowState.IDLE


def test_warming_changes_no_state() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(4, 4), Pose2(2, 2))
    loop.service.warm_up()
    assert loop.service.order is None
    assert loop.service.inputs.odometry.latest is None
    assert loop.service.last_tick == 0


AFTER_WARMING = """
import shared.repeatable
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import RecoveryKind, Zones
from shared.zones import ZoneConfig
from tests.compiling import nothing_compiles
from tests.unit.services.local_ctrl.tiny_world import ControlLoop, TinyWorld, drive_goal, planned, recovery

def zone(name, **asks):
    return ZoneConfig(corners=((1.0, 0.5), (2.5, 0.5), (2.5, 1.2), (1.0, 1.2)), **asks).zone(name)

world, start, goal = TinyWorld(6, 4), Pose2(1, 2, 2), Pose2(4, 2, 0)
robot = load_robot("x80sv").robot
loop = ControlLoop(robot, world, start)
loop.service.warm_up()
world.clearance(robot, start)  # a kernel of the test: its compilation in the loop would load one of shared
with nothing_compiles():
    loop.give(drive_goal(goal), planned(world, start, goal, 0.25)).drive(1)
    loop.send("new_zones", Zones(0, (zone("stairs"), zone("hall", speed=0.3))))
    loop.drive(1)
    loop.give(recovery(RecoveryKind.BACK_UP, 0.1, 2)).drive(0.5)
    loop.give(recovery(RecoveryKind.TURN, 0.2, 3)).drive(0.5)
"""


def test_after_warming_nothing_is_compiled_while_the_robot_moves() -> None:
    ended = subprocess.run([sys.executable, "-c", AFTER_WARMING], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_a_robot_walled_in_stands_and_says_blocked() -> None:
    world = TinyWorld(6, 4).box(1.5, 1.5, 2.5, 2.5).box(1.65, 1.65, 2.35, 2.35, full=False)
    start = Pose2(2.0, 2.0, 0.0)
    loop = ControlLoop(ROBOT, world, start).give(drive_goal(GOAL), np.array([[2.0, 2.0], [6.0, 2.0]]))
    run = loop.drive(3)
    assert run.commands[-1].reason == reasons.BLOCKED.code
    assert run.least_clearance > 0.03


def test_the_same_events_give_the_same_bytes() -> None:
    def commands() -> list[tuple[float, float]]:
        world = TinyWorld(8, 4).box(3.5, 1.8, 3.8, 2.2)
        loop = ControlLoop(ROBOT, world, START).give(drive_goal(GOAL), planned(TinyWorld(8, 4), START, GOAL, 0.25))
        return [(command.v, command.w) for command in loop.drive(4).commands]

    assert commands() == commands()


def test_the_path_of_another_goal_is_not_followed() -> None:
    loop = ControlLoop(ROBOT, TinyWorld(8, 4), START).give(drive_goal(GOAL, goal_id=5))
    other = drive_goal(GOAL, goal_id=4)
    loop.send("new_plan", path_message(planned(loop.world, START, GOAL, 0.25), other, loop.now))
    loop.drive(0.6)
    assert loop.run.commands[-1].reason == reasons.NO_PLAN.code


def test_the_configuration_may_be_absent() -> None:
    assert load_robot("x80sv").section("local_ctrl", LocalCtrlConfig) == LocalCtrlConfig()
