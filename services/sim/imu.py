# SPDX-License-Identifier: Apache-2.0
"""A simulated inertial sensor: its turn rate has bias, scale error, noise and steps; its accelerations have noise.

The defaults are those of a Bosch BNO055: zero-rate offset 1 degree/s, sensitivity tolerance 1 %, noise 0.1 degrees/s at
47 Hz, steps of 1/16 degree/s, accelerometer noise 150 micro-g/sqrt(Hz) (data sheet BST-BNO055-DS000, tables 0-2 and
3-22; typical values). The drift of the offset is our own estimate.
"""

from math import sqrt

import numpy as np
from pydantic import Field

from shared.config import Section
from shared.messages import Imu

GRAVITY = 9.80665  # m/s^2


class ImuNoise(Section):
    """Errors of the inertial sensor."""

    bias: float = Field(0.0175, ge=-1, le=1, description="rad/s that the gyro reads at rest when it starts")
    bias_drift: float = Field(3e-5, ge=0, le=0.1, description="rad/s for each square root of a second: the bias walks")
    scale_error: float = Field(0.01, ge=-0.2, le=0.2, description="share by which it reads more than the turn rate")
    sigma: float = Field(0.0017, ge=0, le=1, description="rad/s, standard deviation of a reading")
    resolution: float = Field(0.00109, ge=0, le=0.1, description="rad/s, step of the readings; 0: none")
    acceleration_sigma: float = Field(0.01, ge=0, le=10, description="m/s^2, standard deviation of a reading")


class SimulatedImu:
    """Measures the motion between two calls. Random only by `rng`."""

    def __init__(self, noise: ImuNoise, rng: np.random.Generator) -> None:
        self.noise, self.rng = noise, rng
        self.bias = noise.bias
        self._last: tuple[int, float, float] | None = None  # stamp ns, yaw rad, v m/s

    def restart(self) -> None:
        """Begins again after a jump of the clock."""
        self._last = None

    def measure(self, stamp: int, yaw: float, v: float) -> Imu | None:
        """The mean turn rate and acceleration since the last call; None for the first. yaw: rad, unwrapped; v: m/s."""
        last, self._last = self._last, (stamp, yaw, v)
        if last is None or stamp <= last[0]:
            return None
        seconds = (stamp - last[0]) * 1e-9
        rate = (yaw - last[1]) / seconds
        drift, draw, *draws = (float(x) for x in self.rng.standard_normal(5))
        self.bias += self.noise.bias_drift * sqrt(seconds) * drift
        read = rate * (1 + self.noise.scale_error) + self.bias + self.noise.sigma * draw
        if self.noise.resolution:
            read = round(read / self.noise.resolution) * self.noise.resolution
        x, y, z = (
            true + self.noise.acceleration_sigma * error
            for true, error in zip(((v - last[2]) / seconds, v * rate, GRAVITY), draws, strict=True)
        )
        return Imu(stamp, read, x, y, z)
