# SPDX-License-Identifier: Apache-2.0
"""Board and laser both as bytes on wires: the drivers meet what they meet on the robot."""

import json
from pathlib import Path

import pytest

from services.imu_driver.service import NO_BYTES, NO_SENSE
from services.sim.hardware.faults import Fault
from shared import requests
from shared.recording import Recording
from shared.requests import Break
from tests.lockstep.stack import MS, QUICK, STACK, LockstepStack
from tests.lockstep.test_board_faults import STOPS
from zenav.__main__ import _status

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

EMULATED = ("sim.hardware=emulated", "base_driver.port.device=wired", "lidar_driver.port.device=wired")


def wired(folder: Path) -> LockstepStack:
    return LockstepStack(folder, settings=(*EMULATED, *QUICK), names=(*STACK, "lidar_driver"))


def test_on_emulated_hardware_the_robot_reaches_its_goal(tmp_path):
    stack = wired(tmp_path)
    stack.go(4.5, 0.5)
    stack.until(stack.reached, 30.0)
    assert stack.truth.n_contacts == 0
    assert stack.truth.distance > 4.0


@pytest.mark.slow
def test_the_demo_explores_and_drives_its_goals_on_emulated_hardware(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = "demo --lockstep --headless --hardware emulated --world room"
    assert _status([*command.split(), "--record", "run.mcap"]) == 0
    (told,) = tmp_path.glob("out/demo-*/summary.json")
    summary = json.loads(told.read_text())["summary"]
    assert (summary["goals_reached"], summary["collisions"]) == (summary["goals"], 0)
    assert summary["explored_share"] > 0.99
    spoken = {entry.channel.key for entry in Recording(tmp_path / "run.mcap").entries()}
    assert {f"port/rx/{name}" for name in ("sim", "base_driver", "lidar_driver")} <= spoken
    assert not {"hardware/board"} & spoken


LASER_STOPS = {
    "laser_stopped": ("the laser stopped turning", 0.5),
    "laser_garbage": ("bytes arrive, none make sense: check lidar_driver.model and .port.baud", 2.5),
    "laser_stalled": ("no bytes: is the laser powered, and does it turn?", 1.5),
    "laser_unplugged": ("unplugged", 0.5),
}
"""Fault, what the laser's driver says of it, and s by which it has."""


@pytest.mark.parametrize("fault", LASER_STOPS)
def test_without_the_laser_the_robot_stands_is_told_why_and_drives_on_when_it_is_back(tmp_path, fault):
    words, told_after = LASER_STOPS[fault]
    stack = wired(tmp_path)
    lines: list[str] = []
    stack.lockstep.watch("log/lidar_driver", lambda line: lines.append(line.text))
    stack.go(4.0)
    stack.drives()
    assert stack.lockstep.ask(requests.FAULT, Break(stack.now, fault, 3.0, False)).accepted
    assert stack.until(lambda: not stack.commanded, 1.0) <= 300 * MS
    stack.lockstep.run(0.2)
    assert stack.guard.reason == "scan_old"
    stack.lockstep.run(told_after - 0.3)
    assert lines == [f"laser: {words}"]
    stack.until(stack.reached, 40.0)
    assert lines[-1] == "laser: in order again"
    assert stack.truth.n_contacts == 0


def test_every_fault_that_can_be_asked_for_is_known_to_stop_the_robot_or_to_leave_it_its_wheels():
    second = {f"laser_2_{fault.removeprefix('laser_')}" for fault in LASER_STOPS}  # test_two_lasers.py
    assert {*STOPS, *LASER_STOPS, *second, *IMU_FAULTS} == set(Fault)


IMU_FAULTS = {
    "imu_garbage": NO_SENSE,
    "imu_stalled": NO_BYTES,
    "imu_unplugged": "unplugged",
}
"""Fault, and what the driver says of it: odometry goes on by the wheels."""


@pytest.mark.parametrize("model", ["bno055", "bno085"])
def test_with_an_emulated_inertial_sensor_the_gyro_gives_the_heading(tmp_path, model):
    sensor = ("robot.imu={yaw: 1.5}", f"sim.emulation.imu_model={model}", "imu_driver.port.device=wired")
    settings = (*EMULATED, *sensor, f"imu_driver.model={model}")
    stack = LockstepStack(tmp_path, settings=settings, names=(*STACK, "lidar_driver", "imu_driver"))
    lines: list[str] = []
    stack.lockstep.watch("log/imu_driver", lambda line: lines.append(line.text))
    rates: list[float] = []
    stack.lockstep.watch("imu", lambda imu: rates.append(imu.yaw_rate))
    stack.go(6.0, 0.5)
    stack.drives()
    for fault, words in IMU_FAULTS.items():
        assert stack.lockstep.ask(requests.FAULT, Break(stack.now, fault, 1.5, False)).accepted
        stack.lockstep.run(3.0)
        assert lines == [f"imu: {words}", "imu: in order again"]
        lines.clear()
    stack.until(stack.reached, 30.0)
    assert stack.truth.n_contacts == 0
    assert max(rates) > 0.1
    assert stack.newest["odom"].odom_from_base.yaw == pytest.approx(stack.truth.world_from_base.yaw, abs=0.1)
