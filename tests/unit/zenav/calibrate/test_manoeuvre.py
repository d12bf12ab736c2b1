# SPDX-License-Identifier: Apache-2.0
"""Manoeuvres in the simulator on the virtual clock."""

from math import pi

import numpy as np
import pytest

from shared.config import UserError
from shared.geometry import Pose2, wrapped
from shared.messages import GuardState, GuardStatus, Odometry
from tests.unit.zenav.calibrate.drive import CalibrationBench
from zenav.calibrate.manoeuvre import MAX_WAIT_S, StackState, back_to, ready, square, stand, turn_to
from zenav.calibrate.motor_response import directions, reversed_motors, wheel_turns
from zenav.calibrate.motor_test import PhaseKind, motor_drive, stopping_room
from zenav.calibrate.motors import by_motion

WALL = """
bounds: [-3, -3, 3, 3]
start: {x: 0.0, y: 0.0}
walls:
  - {points: [[0.8, -1], [0.8, 1]]}
"""


def off(a: Pose2, b: Pose2) -> tuple[float, float]:
    return a.distance(b), abs(wrapped(a.yaw - b.yaw))


@pytest.mark.parametrize("clockwise", [True, False])
def test_a_square_ends_where_odometry_says_that_it_began_and_drives_its_corners(clockwise):
    bench = CalibrationBench("sim.drive.radius_error=0.01")
    ways: list[Pose2] = []
    bench.lockstep.watch("odom", lambda m: ways.append(m.odom_from_base))
    bench.perform(square(1.0, clockwise, 0.4, 1.0, bench.robot.drive))
    bench.lockstep.run(0.5)
    far, turn = off(bench.newest["odom"].odom_from_base, Pose2())
    assert (far, turn) == pytest.approx((0, 0), abs=0.02)
    side = -1.0 if clockwise else 1.0
    for corner in (Pose2(1, 0), Pose2(1, side), Pose2(0, side)):
        assert min(corner.distance(pose) for pose in ways) < 0.02
    assert bench.newest["sim/truth"].n_contacts == 0


def test_turning_goes_the_short_way_round_and_stops_there():
    bench = CalibrationBench()
    for yaw in (3.0, -3.0, 0.0):
        bench.perform(turn_to(yaw, 1.0, bench.robot.drive, Pose2()))
        bench.lockstep.run(0.5)
        assert wrapped(bench.newest["odom"].odom_from_base.yaw - yaw) == pytest.approx(0, abs=0.015)
    assert abs(bench.newest["sim/truth"].distance) < 0.15  # 3 + 0.28 + 3 rad at most slip aside


def test_it_finds_back_by_the_map():
    bench = CalibrationBench(world="room", services=("base_driver", "odometry", "guard", "mapper"))
    bench.perform(ready())
    home = bench.newest["pose"].map_from_base
    bench.perform(turn_to(0.5, 1.0, bench.robot.drive, Pose2()))
    start = bench.newest["sim/truth"].start
    bench.perform(back_to(home @ Pose2(0.5, 0.3, 1.0), 0.3, 1.0, bench.robot.drive))
    bench.lockstep.run(0.5)
    assert off(start.inverse() @ bench.newest["sim/truth"].world_from_base, Pose2(0.5, 0.3, 1.0)) == pytest.approx(
        (0, 0), abs=0.05
    )


def test_a_wall_in_the_way_ends_it_with_its_reason(tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text(WALL)
    bench = CalibrationBench(world=str(world))
    with pytest.raises(UserError, match="protective field"):
        bench.perform(square(2.0, True, 0.3, 1.0, bench.robot.drive))
    assert bench.newest["sim/truth"].n_contacts == 0


IDLE, STOPPED = ((GuardState.IDLE, ""), (GuardState.STOPPED, "estop"))


@pytest.mark.parametrize(
    ("odom_age", "guard", "told"),
    [
        (None, None, "the guard does not answer"),
        (None, IDLE, "odometry is silent"),
        (1.0, IDLE, "odometry is silent"),
        (0.0, STOPPED, "STOP is pressed"),
    ],
)
def test_what_does_not_answer_is_named_after_a_few_seconds(odom_age, guard, told):
    manoeuvre = turn_to(pi, 1.0, CalibrationBench().robot.drive, Pose2())
    next(manoeuvre)
    now = 10**18

    def send_until_it_gives_up() -> None:
        nonlocal now
        for _ in range(1000):
            odom = None if odom_age is None else Odometry(now - round(odom_age * 1e9), Pose2(), 0.0, 0.0, np.zeros(9))
            status = None if guard is None else GuardStatus(now, guard[0], "", guard[1], "", 0.0)
            manoeuvre.send(StackState(now, odom, None, status))
            now += 50_000_000

    with pytest.raises(UserError, match=told):
        send_until_it_gives_up()
    assert MAX_WAIT_S <= (now - 10**18) * 1e-9 <= MAX_WAIT_S + 1


def test_standing_asks_for_nothing_and_ends():
    manoeuvre, asked, now = stand(1.0), [], 0
    asked.append(next(manoeuvre))
    while True:
        try:
            asked.append(manoeuvre.send(StackState(now)))
        except StopIteration:
            break
        now += 50_000_000
    assert now == pytest.approx(1_000_000_000, abs=60_000_000)
    assert not any(ask.v or ask.w or ask.stop for ask in asked)


def test_on_blocks_nothing_but_wheels_turns_and_stop_is_never_pressed():
    bench = CalibrationBench()
    presses = []
    bench.lockstep.watch("estop", presses.append)
    phases = bench.perform(motor_drive(bench.robot.drive, True, 0.5))
    assert [p.kind for p in phases] == [PhaseKind.ALONE] * 4 + [PhaseKind.STAIRS] * 2 + [PhaseKind.STEP] * 4
    assert presses == []


@pytest.mark.parametrize("direction", [1, -1])
def test_the_scans_tell_which_way_the_robot_really_drives(direction):
    bench = CalibrationBench(world="room", motor_direction=direction)
    drive = bench.robot.drive
    phases = bench.perform(motor_drive(drive, True, 0.5))
    found = by_motion(wheel_turns(bench.log, phases, drive), bench.log, phases, bench.robot)
    assert [t.counted for t in found] == [t.commanded for t in found]
    assert [t.seen for t in found] == [(t.wheel, direction * t.commanded[1]) for t in found]
    assert reversed_motors(found) == (direction == -1)
    assert len(directions(found, drive)) == (direction == -1)


def test_the_stop_needs_no_more_room_than_it_says():
    bench = CalibrationBench()
    bench.perform(motor_drive(bench.robot.drive, False, 0.5))
    assert bench.newest["guard/status"].state is not GuardState.STOPPED
    ways = [t.world_from_base for t in bench.log.truth]
    assert max(abs(pose.x) for pose in ways) < stopping_room(bench.robot.drive, 0.5) + 0.2
