# SPDX-License-Identifier: Apache-2.0
"""What the simulated robot's board measures: encoder counts, ranges, currents and the battery."""

from math import pi

import numpy as np

from services.sim import dynamics as dyn
from services.sim.config import SimConfig
from services.sim.drive import battery_voltage, encoder_counts
from services.sim.rays import Cells
from services.sim.sensors import add_noise, cone_ranges, cone_table
from services.sim.velocity_base import BaseOdometer
from shared.config import Robot
from shared.messages import BaseOdometry, BoardReport
from shared.types import Float32s, Float64s


class SimulatedBoard:
    """Random only by the two generators: of the ranges, and of the first counts.

    used_charge: Ah that were taken from the battery.
    """

    def __init__(self, config: SimConfig, robot: Robot, rng: np.random.Generator, once: np.random.Generator) -> None:
        self.config, self.drive, self._rng = config, robot.drive, rng
        self.first_counts = [int(n) for n in once.integers(robot.drive.encoder_wrap, size=2)]
        self.used_charge = 0.0
        self._n_ultrasonic = sum(sensor.kind == "ultrasonic" for sensor in robot.ranges)
        self._cones = cone_table(robot)
        self._odometer = BaseOdometer(robot.drive)

    def warm_up(self, cells: Cells, row: Float64s) -> None:
        """Compiles the kernels."""
        cone_ranges(cells, row, self._cones, self.config.ranges.n_rays)

    def discharge(self, currents: Float32s, seconds: float) -> None:
        """Takes the currents of both motors (A) and the idle current from the battery."""
        self.used_charge += (float(currents.sum()) + self.config.battery.idle_current) * seconds / 3600

    def voltage(self, currents: Float32s) -> float:
        """V of the battery under the currents of both motors, A."""
        battery = self.config.battery
        return battery_voltage(battery, self.used_charge, float(currents.sum()) + battery.idle_current)

    def report(self, stamp: int, state: Float64s, row: Float64s, cells: Cells, currents: Float32s) -> BoardReport:
        """The report at a state of the physics. row: of its history, at `stamp` (ns).  currents: (2,) A."""
        drive = self.drive
        true = cone_ranges(cells, row, self._cones, self.config.ranges.n_rays)
        ranges = add_noise(true, self.config.ranges, 0.0, self._cones[:, 4], self._rng)
        left, right = -drive.motor_direction, drive.motor_direction  # signs of the board's encoders
        per_radian = drive.counts_per_turn / (2 * pi)
        return BoardReport(
            stamp=stamp,
            left_counts=encoder_counts(left * state[dyn.LEFT_ANGLE], self.first_counts[0], drive),
            right_counts=encoder_counts(right * state[dyn.RIGHT_ANGLE], self.first_counts[1], drive),
            left_speed=float(np.rint(left * state[dyn.LEFT_SPEED] * per_radian)),
            right_speed=float(np.rint(right * state[dyn.RIGHT_SPEED] * per_radian)),
            ultrasonic=ranges[: self._n_ultrasonic],
            infrared=ranges[self._n_ultrasonic :],
            battery=self.voltage(currents),
            currents=currents,
        )

    def odometry(self, stamp: int, epoch: int, state: Float64s, currents: Float32s) -> BaseOdometry:
        """The odometry of a base that does its own, instead of a report. stamp, epoch: ns.  currents: (2,) A."""
        angles = float(state[dyn.LEFT_ANGLE]), float(state[dyn.RIGHT_ANGLE])
        speeds = float(state[dyn.LEFT_SPEED]), float(state[dyn.RIGHT_SPEED])
        return self._odometer.odometry(stamp, epoch, angles, speeds, self.voltage(currents))
