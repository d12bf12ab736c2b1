# SPDX-License-Identifier: Apache-2.0
"""The simulated lasers: their sweeps, one after the other, as the robot moves."""

import numpy as np

from services.sim import dynamics as dyn
from services.sim.rays import Cells
from services.sim.sensors import LaserNoise, add_noise, sweep_ranges
from shared.lasers import lasers_by_topic
from shared.messages import LaserScan
from shared.robot import Laser, Robot
from shared.types import Float64s

PHASE = 0.5  # sweeps by which the second laser is behind: two lasers turn independently


def simulated_lasers(robot: Robot, noise: LaserNoise, seed: int) -> "dict[str, SimulatedLaser]":
    """The lasers of a robot by the key of their topic, each with noise of its own."""
    return {
        topic.key: SimulatedLaser(laser, noise, np.random.default_rng([seed, stream]), phase)
        for (topic, laser), stream, phase in zip(lasers_by_topic(robot).items(), (4, 13), (0, PHASE), strict=False)
    }


class SimulatedLaser:
    """Takes sweeps from the history of poses and people, as in dynamics.advance."""

    def __init__(self, laser: Laser, noise: LaserNoise, rng: np.random.Generator, phase: float = 0) -> None:
        """phase: of its first sweep, in sweeps."""
        self.laser, self.noise, self.rng, self.phase = laser, noise, rng, phase
        self.sweep = 0  # number of the next sweep since the epoch

    def due_scans(self, cells: Cells, history: Float64s, step: int, epoch: int) -> list[LaserScan]:
        """The sweeps that are complete at a step of the physics and were not returned before. epoch: ns of step 0."""
        laser, scans = self.laser, []
        while (begin := int((self.sweep + self.phase) * 1e9 / laser.rate)) + laser.scan_time * 1e9 <= step * dyn.DT_NS:
            self.sweep += 1
            if begin // dyn.DT_NS < step - len(history) + 2:
                continue  # older than the history, after a gap without ticks
            true = self.true_sweep(cells, history, begin)
            scans.append(
                LaserScan(
                    stamp=epoch + begin,
                    angle_min=laser.angle_min,
                    angle_increment=laser.angle_increment,
                    scan_time=laser.scan_time,
                    range_min=laser.range_min,
                    range_max=laser.range_max,
                    ranges=add_noise(true, self.noise, laser.range_min, laser.range_max, self.rng),
                )
            )
        return scans

    def true_sweep(self, cells: Cells, history: Float64s, begin: int) -> Float64s:
        """(n_beams,) true ranges, m, of the sweep that begins `begin` ns after the epoch; inf without echo."""
        laser = self.laser
        mount = laser.mount.x, laser.mount.y, laser.mount.yaw
        beam_step = laser.scan_time / (laser.n_beams - 1) / dyn.DT
        limit = laser.range_max + 5 * self.noise.sigma
        return sweep_ranges(
            cells, history, begin / dyn.DT_NS, beam_step, mount, laser.angle_min, laser.angle_increment,
            laser.n_beams, limit,
        )  # fmt: skip
