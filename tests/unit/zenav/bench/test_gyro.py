# SPDX-License-Identifier: Apache-2.0
"""`zenav bench gyro`: its error over 100 m, and a drive whose wheels are wrong."""

from math import isnan, radians

import numpy as np
import pytest

from services.sim.imu import ImuNoise, SimulatedImu
from shared.config import load_robot
from zenav.bench.gyro import Headings, Twins


def test_the_error_is_that_of_the_turn_over_100_m_not_of_the_heading():
    travel = np.arange(0.0, 301.0).tolist()
    truth = [0.0] * 301
    wheels = (radians(90) + radians(0.2) * np.arange(301)).tolist()  # a wrong start, and 20 degrees over 100 m
    drive = Headings(travel, truth, wheels, truth)
    assert drive.error(drive.wheels) == pytest.approx(20.0)
    assert drive.error(drive.gyro) == 0.0


def test_a_drive_of_less_than_100_m_has_no_error():
    assert isnan(Headings([0.0, 99.0], [0.0, 0.0], [0.0, 1.0], [0.0, 1.0]).error([0.0, 1.0]))


def test_wheels_that_turn_too_far_are_corrected_by_the_gyro_alone():
    twins = Twins(load_robot("x80sv").robot)
    imu = SimulatedImu(ImuNoise(bias_drift=0), np.random.default_rng(3))
    twins.go(imu, 5.0, 0.0, 0.0, 0.0)
    twins.note(0.0)
    for _ in range(50):
        twins.go(imu, 5.0, 2.0, 0.06, 0.05)
        twins.note(2.0)
        twins.go(imu, 5.0, 2.0, -0.05, -0.05)
        twins.note(2.0)
    drive = twins.headings()
    assert drive.error(drive.wheels) == pytest.approx(14.3, abs=0.7)
    assert drive.error(drive.gyro) < 5.0
