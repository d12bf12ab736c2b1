# SPDX-License-Identifier: Apache-2.0
"""Each robot file drives on emulated hardware: board and laser as bytes, or as messages where they have no port."""

import json

import pytest

from services.sim.hardware.faults import Fault
from shared import requests
from shared.geometry import Pose2
from shared.messages import NavState
from shared.requests import Break, Navigate
from shared.robot_files import ROBOTS_DIR
from shared.runners.lockstep import Lockstep
from tests.lockstep.stack import QUICK
from zenav.__main__ import _status
from zenav.scenario.lockstep_run import lockstep_services
from zenav.scenario.scenario import load_scenario
from zenav.stack.hardware import Hardware, wires

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

ROBOTS = (
    "x80sv", "jackal", "turtlebot2", "turtlebot3_burger", "turtlebot3_ros2", "turtlebot4", "create2", "arduino",
    "delivery",
)  # fmt: skip
WORLD = """
start: {x: 1.0, y: 1.5}
walls:
  - {points: [[0, 0], [4, 0], [4, 3], [0, 3]], closed: true}
boxes:
  - {x: 2.6, y: 0.2, size: [0.4, 0.3]}
goals:
  - {name: there, x: 2.2, y: 1.5}
"""
ROOMS = """
start: {x: 1.0, y: 1.0}
walls:
  - {points: [[0, 0], [5, 0], [5, 4], [0, 4]], closed: true}
  - {points: [[2.5, 0], [2.5, 2.2]]}
boxes:
  - {x: 3.4, y: 3.2, size: [0.4, 0.3]}
goals:
  - {name: behind the wall, x: 4.0, y: 1.0}
"""


class RobotRun:
    """The whole stack of a robot file, on emulated hardware in a small room."""

    def __init__(self, robot, folder, settings=()):
        (folder / "world.yaml").write_text(WORLD)
        scenario = load_scenario(robot, str(folder / "world.yaml"), 1, [*QUICK, *settings], Hardware.EMULATED)
        self.lockstep = Lockstep(lockstep_services(scenario), wires=wires(Hardware.EMULATED, scenario.file))
        self.newest, self.spoken = {}, set()
        for key in ("nav/status", "sim/truth", "base/status", "guard/status", "odom"):
            self.lockstep.watch(key, lambda message, key=key: self.newest.__setitem__(key, message))
        for key in ("port/rx/base_driver", "port/rx/lidar_driver", "base/wheels", "base/odometry"):
            self.lockstep.watch(key, lambda message, key=key: self.spoken.add(key))
        self.lockstep.run(2.0)

    def go(self, x, y):
        reply = self.lockstep.ask(requests.NAVIGATE, Navigate(self.lockstep.now, (Pose2(x, y, 0.0),), 0.0, 1, True))
        assert reply.accepted, reply

    def until(self, holds, seconds):
        assert self.lockstep.run(seconds, lambda: bool(holds())), (
            self.newest["guard/status"],
            self.newest["nav/status"],
        )

    @property
    def truth(self):
        return self.newest["sim/truth"]


def test_every_built_in_robot_has_its_test():
    names = {path.stem for path in ROBOTS_DIR.glob("*.yaml")}
    assert names == {*ROBOTS, "x80sv_xv11"}  # the same robot with another laser


@pytest.mark.parametrize("robot", [*ROBOTS, "x80sv_xv11"])
def test_the_robot_reaches_a_goal_without_contact(robot, tmp_path):
    run = RobotRun(robot, tmp_path)
    run.go(1.2, 0.0)
    run.until(lambda: run.newest["nav/status"].state is NavState.REACHED, 30.0)
    assert run.truth.n_contacts == 0
    assert 0.8 < run.truth.distance < 2.5
    assert run.newest["base/status"].fault == ""
    assert abs(run.newest["odom"].odom_from_base.x - 1.2) < 0.3
    is_velocity_base = robot in ("turtlebot3_burger", "turtlebot3_ros2", "turtlebot4")
    assert ("base/odometry" in run.spoken) is is_velocity_base
    assert ("port/rx/base_driver" in run.spoken) is not is_velocity_base


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["jackal", "create2", "turtlebot3_burger", "delivery"])  # each another base
def test_the_demo_explores_two_rooms_and_drives_behind_the_wall_and_back_without_contact(robot, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms.yaml").write_text(ROOMS)
    command = f"demo --lockstep --headless --hardware emulated --world rooms.yaml --robot {robot} --set {QUICK[0]}"
    assert _status(command.split()) == 0
    (written,) = tmp_path.glob("out/demo-*/summary.json")
    summary = json.loads(written.read_text())["summary"]
    assert (summary["goals_reached"], summary["collisions"]) == (summary["goals"], 0)
    assert summary["explored_share"] > 0.95


@pytest.mark.parametrize("robot", ["turtlebot2", "create2", "arduino"])
@pytest.mark.parametrize("fault", [Fault.STALLED, Fault.BAD_CRC, Fault.UNPLUGGED])
def test_a_broken_line_to_the_board_stops_the_robot_and_it_drives_on(robot, fault, tmp_path):
    run = RobotRun(robot, tmp_path)
    run.go(1.2, 0.0)
    run.until(lambda: run.truth.v > 0.15, 10.0)
    assert run.lockstep.ask(requests.FAULT, Break(run.lockstep.now, fault.value, 3.0, False)).accepted
    run.until(lambda: run.newest["base/status"].fault in ("board_silent", "port_closed"), 1.0)
    if robot == "arduino":  # a board with a watchdog
        run.until(lambda: abs(run.truth.v) < 0.01, 1.0)
    run.lockstep.run(4.0)
    assert run.newest["base/status"].fault == ""
    assert abs(run.truth.v) < 0.01, "the task has ended: it waits for a goal"
    assert run.truth.n_contacts == 0
    run.go(0.0, 0.0)
    run.until(lambda: run.newest["nav/status"].state is NavState.REACHED, 40.0)
    assert run.truth.n_contacts == 0


@pytest.mark.parametrize("board", ["ros_arduino_bridge", "roboclaw", "odrive"])
def test_the_boards_of_builders_drive_an_x80sv(board, tmp_path):
    settings = [f"base_driver.board.model={board}", "robot.ranges=[]", "robot.drive.encoder_wrap=2147483648"]
    run = RobotRun("x80sv", tmp_path, settings)
    run.go(1.2, 0.0)
    run.until(lambda: run.newest["nav/status"].state is NavState.REACHED, 30.0)
    assert run.truth.n_contacts == 0
    assert run.newest["base/status"].fault == ""
