# SPDX-License-Identifier: Apache-2.0
"""What the simulated inertial sensor, bumpers and cliff sensors say of a drive."""

from math import pi

import numpy as np
import pytest

from shared.robot import Bumper, CliffSensor, ImuMount
from tests.unit.services.sim.scenes import PERFECT, X80SV, drive, simulator, told, written

NO_ERROR = {"bias": 0, "bias_drift": 0, "scale_error": 0, "sigma": 0, "resolution": 0, "acceleration_sigma": 0}
BUMPERS = (Bumper(name="front", bearing=0.0, width=2.0), Bumper(name="back", bearing=pi, width=2.0))
CLIFFS = (CliffSensor(name="left", x=0.19, y=0.08), CliffSensor(name="right", x=0.19, y=-0.08))
WORLD = """
start: {x: 1.0, y: 1.0}
walls:
  - {points: [[0, 0], [4, 0], [4, 2], [0, 2]], closed: true}
cliffs:
  - {points: [[2.0, 1.0], [2.5, 1.0], [2.5, 2.0], [2.0, 2.0]]}
"""


def sensing(folder, **settings):
    robot = X80SV.model_copy(update={"imu": ImuMount(), "bumpers": BUMPERS, "cliffs": CLIFFS})
    return simulator(written(folder, WORLD), robot, **{**PERFECT, "imu": NO_ERROR, **settings})


def test_a_robot_without_these_sensors_says_nothing_of_them():
    out = list(drive(simulator("room"), 0.5, 0.1, 0.0))
    assert not told(out, "imu")
    assert not told(out, "hardware/contacts")


def test_the_turn_rates_of_an_exact_sensor_add_up_to_the_turn(tmp_path):
    sim = sensing(tmp_path)
    out = list(drive(sim, 2.0, 0.1, 0.7))
    truth, imu = told(out, "sim/truth"), told(out, "imu")
    stamps = [truth[0].stamp, *(message.stamp for message in imu)]
    turn = sum(message.yaw_rate * dt * 1e-9 for message, dt in zip(imu, np.diff(stamps), strict=True))
    assert turn == pytest.approx(truth[-1].world_from_base.yaw - truth[0].world_from_base.yaw, abs=1e-9)
    assert turn > 1.2


def test_accelerations_are_those_of_the_start_of_the_curve_and_of_gravity(tmp_path):
    sim = sensing(tmp_path)
    list(drive(sim, 0.1, 0.0, 0.0))
    imu = told(list(drive(sim, 2.0, 0.2, 0.5)), "imu")
    assert max(message.acceleration_x for message in imu[:5]) > 1.0
    assert imu[-1].acceleration_x == pytest.approx(0.0, abs=1e-6)
    assert imu[-1].acceleration_y == pytest.approx(0.2 * 0.5, abs=1e-6)
    assert imu[-1].acceleration_z == pytest.approx(9.807, abs=0.001)


def test_at_rest_the_sensor_reads_its_bias(tmp_path):
    imu = told(list(drive(sensing(tmp_path, imu={"bias": 0.03}), 4.0, 0.0, 0.0)), "imu")
    assert np.mean([message.yaw_rate for message in imu]) == pytest.approx(0.03, abs=0.001)
    assert np.std([message.yaw_rate for message in imu]) == pytest.approx(0.0017, rel=0.3)


@pytest.mark.parametrize(("v", "pressed"), [(0.5, ("front",)), (-0.3, ("back",))])
def test_a_bumper_is_pressed_on_the_side_of_the_wall(tmp_path, v, pressed):
    out = told(list(drive(sensing(tmp_path), 9.0, v, 0.0)), "hardware/contacts")
    assert out[0].bumpers == ()
    assert out[-1].bumpers == pressed


def test_a_cliff_sensor_sees_the_edge_under_it_and_no_laser_does(tmp_path):
    out = list(drive(sensing(tmp_path), 2.2, 0.4, 0.0))
    assert told(out, "hardware/contacts")[-1].cliffs == ("left",)
    x = told(out, "sim/truth")[-1].world_from_base.x
    first = next(message for message in told(out, "hardware/contacts") if message.cliffs)
    reached = next(message for message in told(out, "sim/truth") if message.stamp == first.stamp)
    assert reached.world_from_base.x + 0.19 == pytest.approx(2.0, abs=0.01)
    assert np.nanmin(told(out, "scan")[-1].ranges) > 0.5
    assert x < 2.31  # still over it
