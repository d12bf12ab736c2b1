# SPDX-License-Identifier: Apache-2.0
"""Robots with two lasers: each is watched alone, both keep the robot from obstacles, and runs replay to the byte."""

from math import pi

import pytest

from services.sim.message_faults import SECOND_LASER_FAULTS, MessageFault
from shared import requests, topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import GuardState, Velocity
from shared.requests import Break, Navigate
from shared.runners.host import Sent
from shared.runners.lockstep import Lockstep
from shared.runners.replay import replay
from tests.lockstep.stack import HALL, MS, QUICK, STACK, LockstepStack
from tests.lockstep.test_ports import KeptBytes
from zenav.scenario.lockstep_run import lockstep_services
from zenav.scenario.scenario import load_scenario
from zenav.stack.hardware import Hardware, wires
from zenav.stack.service_loader import build_service

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

STEP = pi / 225
HALF_TURN = {"angle_min": -pi / 2, "angle_increment": STEP, "n_beams": 226, "scan_time": 0.05}


def robot_file(folder, rear=True, mapping=True):
    """An X80SV without range sensors, with a laser of 180 degrees ahead and perhaps one back, which may map."""
    file = load_robot("x80sv")
    robot = file.tree["robot"]
    del robot["ranges"]
    both = dict(robot.pop("laser")) | HALF_TURN
    front = both | {"name": "front", "mount": {"x": 0.15, "y": 0.0, "yaw": 0.0}}
    back = both | {"name": "rear", "mount": {"x": -0.15, "y": 0.0, "yaw": pi}, "mapping": mapping}
    robot["lasers"] = [front, back] if rear else [front]
    (folder / "robot.yaml").write_text(file.text)
    return str(folder / "robot.yaml")


def two_lasers(folder, mapping=True):
    return LockstepStack(folder, robot=robot_file(folder, mapping=mapping), settings=QUICK)


def pose_error(stack):
    return (stack.truth.start @ stack.newest["pose"].map_from_base).distance(stack.truth.world_from_base)


def break_(stack, fault, seconds=0.0):
    assert stack.lockstep.ask(requests.FAULT, Break(stack.now, fault, seconds, False)).accepted


def backed_off(folder, rear):
    """The stack after teleoperation backs towards the wall behind the start for 6 s."""
    stack = LockstepStack(folder, robot=robot_file(folder, rear), settings=QUICK)
    for _ in range(120):
        stack.lockstep.publish(topics.TELEOP(Velocity(stack.now, -0.3, 0.0, "")))
        stack.lockstep.run(0.05)
    return stack


def test_a_robot_that_backs_off_stops_before_the_wall_that_its_rear_laser_sees(tmp_path):
    stack = backed_off(tmp_path, rear=True)
    assert stack.truth.n_contacts == 0
    assert 0.25 < stack.truth.world_from_base.x < 0.6  # the wall is at 0, the outline reaches 0.2 m back
    assert stack.guard.reason == "obstacle"


def test_without_a_rear_laser_it_creeps_and_touches_the_wall(tmp_path):
    assert backed_off(tmp_path, rear=False).truth.n_contacts > 0


def test_it_arrives_and_nothing_is_held(tmp_path):
    stack, held = two_lasers(tmp_path), set()
    stack.lockstep.watch("guard/status", lambda s: held.add(s.reason))
    stack.go(7.0)
    stack.until(stack.reached, 40.0)
    assert stack.truth.n_contacts == 0
    assert not held & {"scan_old", "scan_blind", "scan_frozen", "scan_unlike", "bad_stamps"}


@pytest.mark.parametrize(
    ("fault", "reason", "detail", "within"),
    [
        ("scan_2_silent", "scan_old", "laser rear", 450),
        ("scan_silent", "scan_old", "laser front", 450),
        ("scan_2_frozen", "scan_frozen", "laser rear: ", 700),
        ("scan_2_nan", "scan_blind", "laser rear: 0 of 226 beams return", 700),
        ("scan_2_beams", "scan_unlike", "laser rear: 113 beams came, robot.lasers.rear.n_beams is 226", 250),
        ("scan_2_old", "bad_stamps", "laser rear: scan_2: stamps are 10", 600),
    ],
)
def test_each_laser_is_watched_although_the_other_one_measures(fault, reason, detail, within, tmp_path):
    stack = two_lasers(tmp_path)
    stack.go(4.5)
    stack.drives(0.6)
    break_(stack, fault, 2.0)
    assert stack.until(lambda: not stack.commanded, 2.0) <= within * MS
    stack.lockstep.run(0.3)
    assert (stack.guard.state, stack.guard.reason) == (GuardState.HOLD, reason)
    assert stack.guard.detail.startswith(detail), stack.guard.detail
    stack.until(stack.reached, 40.0)
    assert stack.truth.n_contacts == 0


@pytest.mark.parametrize("mapping", [True, False])
def test_the_pose_is_right_by_both_lasers_and_by_the_first_one_alone(mapping, tmp_path):
    stack = two_lasers(tmp_path, mapping)
    stack.go(6.0)
    stack.until(stack.reached, 40.0)
    assert pose_error(stack) < 0.05


@pytest.mark.parametrize("fault", [fault for fault in MessageFault if fault in SECOND_LASER_FAULTS])
def test_a_second_laser_that_breaks_while_the_robot_drives_does_not_stop_the_mapper(fault, tmp_path):
    stack, poses = two_lasers(tmp_path), []
    stack.go(4.5)
    stack.drives(0.6)
    stack.lockstep.watch("pose", poses.append)
    break_(stack, fault, 3.0)
    stack.lockstep.run(3.0)
    assert len(poses) >= 29
    assert {str(pose.state) for pose in poses} == {"good"}
    stack.until(stack.reached, 40.0)
    assert pose_error(stack) < 0.05


def emulated(folder, recorded):
    """The delivery robot in a hall, both lasers and the board behind their ports."""
    (folder / "world.yaml").write_text(HALL + "goals: [{name: there, x: 6.0, y: 2.0}]\n")
    scenario = load_scenario("delivery", str(folder / "world.yaml"), 1, list(QUICK), Hardware.EMULATED)
    services = lockstep_services(scenario)
    return Lockstep(services, recorded, wires=wires(Hardware.EMULATED, scenario.file)), scenario.file


def test_both_devices_are_driven_by_one_driver_and_one_that_is_pulled_out_stops_the_robot_by_its_name(tmp_path):
    lockstep, _ = emulated(tmp_path, lambda sent: None)
    newest, lines = {}, []
    for key in ("nav/status", "guard/status", "sim/truth", "health/lidar_driver"):
        lockstep.watch(key, lambda message, key=key: newest.__setitem__(key, message))
    lockstep.watch("log/lidar_driver", lambda line: lines.append(line.text))
    lockstep.run(3.0)
    lockstep.ask(requests.NAVIGATE, Navigate(lockstep.now, (Pose2(4.0, 0.0, 0.0),), 0.0, 1, True))
    assert lockstep.run(10.0, lambda: newest["sim/truth"].v > 0.4)
    assert lockstep.ask(requests.FAULT, Break(lockstep.now, "laser_2_unplugged", 2.0, False)).accepted
    assert lockstep.run(1.0, lambda: newest["guard/status"].reason == "scan_old")
    assert newest["guard/status"].detail == "laser rear"
    lockstep.run(1.0)
    assert lines == ["laser rear: unplugged"]
    assert lockstep.run(40.0, lambda: str(newest["nav/status"].state) == "reached")
    assert lines[-1] == "laser rear: in order again"
    assert newest["sim/truth"].n_contacts == 0


def test_every_service_replays_to_the_byte(tmp_path):
    recorded: list[Sent] = []
    lockstep, file = emulated(tmp_path, recorded.append)
    lockstep.run(2.0)
    lockstep.ask(requests.NAVIGATE, Navigate(lockstep.now, (Pose2(2.0, 0.0, 0.0),), 0.0, 1, True))
    lockstep.run(6.0)
    lockstep.flush()
    assert sum(sent.key == "scan_2" for sent in recorded) > 50
    for name in ("guard", "local_ctrl", "mapper", "lidar_driver"):
        replayed = replay(KeptBytes(recorded, name), [name], lambda name: build_service(name, file, file.robot))
        assert not replayed.gaps
        spoken = [s.payload for s in recorded if s.envelope.publisher == name and "/" + name not in s.key]
        again = [s.payload for s in replayed.sent[name] if "/" + name not in s.key]
        assert again == spoken, name


def test_the_same_run_twice_is_the_same_bytes(tmp_path):
    runs: list[list[bytes]] = []
    for _ in range(2):
        recorded: list[Sent] = []
        lockstep = LockstepStack(tmp_path, robot=robot_file(tmp_path), names=STACK).lockstep
        lockstep.watch("scan_2", lambda scan, kept=recorded: kept.append(scan.ranges.tobytes()))
        lockstep.run(1.0)
        runs.append(recorded)
    assert runs[0] == runs[1]
    assert len(runs[0]) == 10
