# SPDX-License-Identifier: Apache-2.0
"""Assembles beams into sweeps on the grid of `robot.laser`."""

from dataclasses import dataclass
from math import pi

import numpy as np

from services.lidar_driver.device import Returns, differences
from shared.config import Laser
from shared.types import Float32s, Float64s

MIN_GAP_RAD = pi / 15  # a larger angle without a beam counts as lost beams
MIN_COVERAGE = 0.5  # minimum share of a sweep's angle with beams; others are dropped
END_MARGIN = 1.25  # steps before the grid's end from which a beam completes the sweep
MAX_PAUSE_S = 1.0  # s between two beams; a longer pause restarts the assembly
MAX_TIME_BACK_S = 0.05  # s; corrections within a packet may set times back by so much
MAX_BEAMS = 100_000  # maximum number of stored beams, for a device that never completes a turn


@dataclass(frozen=True, slots=True)
class GridSweep:
    """One sweep on the grid.

    first, last: s on the device's clock, times of the first and the last beam.
    ranges: (n,) m, NaN without a measurement.  intensities: (n,), 0 without one; None if the device has none.
    """

    first: float
    last: float
    ranges: Float32s
    intensities: Float32s | None


class SweepAssembler:
    """Collects beams and separates sweeps at the grid's first angle, in the device's direction of rotation.

    angle_min, increment: rad, of the sweeps. They are those of the grid, reversed if the device turns against it: beams
    are always in the order of time.
    """

    def __init__(self, laser: Laser, clockwise: bool, inverted: bool) -> None:
        self.n = laser.n_beams
        self.step = abs(laser.angle_increment)
        self.turn = 2 * pi / self.step  # steps of the grid in a full turn
        self.sign = -1.0 if inverted else 1.0  # of the device's angles in `laser`; an inverted device is mirrored
        self.direction = -1.0 if clockwise != inverted else 1.0
        self.increment = self.direction * self.step
        last = laser.angle_min + (self.n - 1) * laser.angle_increment
        forward = laser.angle_increment * self.direction > 0
        self.angle_min = laser.angle_min if forward else (last + pi) % (2 * pi) - pi
        self.rate = laser.rate * self.turn  # steps of the grid per s, measured from sweep to sweep
        self.n_lost = 0  # sweeps dropped for too few beams
        self.restart()

    def restart(self) -> None:
        """Drops the present sweep."""
        self.raw, self.phase, self.time = 0.0, 0.0, 0.0  # of the last beam; steps of the grid, s
        self.has_beams = False
        self.current = 0  # number of the present sweep
        self.batches: list[tuple[Float64s, Float64s, Float32s, Float32s | None]] = []
        self.n_stored = 0

    def add(self, returns: Returns) -> list[GridSweep]:
        """Adds beams, and returns the sweeps that they complete."""
        if returns.restarted or (self.has_beams and not self._is_continuous(returns.times)):
            self.restart()
        phases = self._unwrap_phases(returns)
        self.batches.append((phases, returns.times, returns.ranges, returns.intensities))
        self.n_stored += len(phases)
        sweeps = []
        reached = float(phases.max())
        if reached >= self.current * self.turn + self.n - END_MARGIN:
            phases, times, ranges, intensities = self._concatenate()
            numbers = np.floor((phases + 0.5) / self.turn).astype(np.int64)
            newest = int(numbers.max())
            for number in np.unique(numbers[numbers >= self.current]).tolist():
                if number < newest or reached >= number * self.turn + self.n - END_MARGIN:
                    in_sweep = numbers == number
                    selected = intensities[in_sweep] if intensities is not None else None
                    sweep = self._make_sweep(
                        phases[in_sweep] - number * self.turn, times[in_sweep], ranges[in_sweep], selected
                    )
                    sweeps += [sweep] if sweep else []
                    self.current = number + 1
            later = numbers >= self.current
            remaining = intensities[later] if intensities is not None else None
            self.batches, self.n_stored = (
                [(phases[later], times[later], ranges[later], remaining)],
                int(later.sum()),
            )
        if self.n_stored > MAX_BEAMS:
            self.restart()
        return sweeps

    def _is_continuous(self, times: Float64s) -> bool:
        steps = differences(times, self.time)
        return bool(steps.min() > -MAX_TIME_BACK_S and steps.max() < MAX_PAUSE_S)

    def _unwrap_phases(self, returns: Returns) -> Float64s:
        """(n,) steps of the grid since the first angle of sweep 0; times give the number of lost turns."""
        raw = self.direction * (self.sign * returns.angles - self.angle_min) / self.step
        if not self.has_beams:
            self.has_beams = True
            self.raw, self.time = float(raw[0]), float(returns.times[0])
            self.phase = (self.raw + 0.5) % self.turn - 0.5
            self.current = 0
        expected = self.rate * differences(returns.times, self.time)
        steps = differences(raw, self.raw) - expected
        steps -= self.turn * np.rint(steps / self.turn)
        phases: Float64s = self.phase + np.cumsum(steps + expected)
        self.raw, self.phase, self.time = float(raw[-1]), float(phases[-1]), float(returns.times[-1])
        return phases

    def _concatenate(self) -> tuple[Float64s, Float64s, Float32s, Float32s | None]:
        phases, times, ranges, intensities = zip(*self.batches)
        with_all = [i for i in intensities if i is not None]
        joined = np.concatenate(with_all) if len(with_all) == len(intensities) else None
        return np.concatenate(phases), np.concatenate(times), np.concatenate(ranges), joined

    def _make_sweep(
        self, phases: Float64s, times: Float64s, ranges: Float32s, intensities: Float32s | None
    ) -> GridSweep | None:
        """The sweep of these beams, phases (n,) in steps from its first angle; None with too few beams."""
        places = np.floor(phases + 0.5).astype(np.int64)
        inside = (places >= 0) & (places < self.n)
        beam_phases = np.sort(phases[inside])
        gaps = np.diff(beam_phases, prepend=-0.5, append=self.n - 0.5)
        lost = float(gaps[gaps > max(MIN_GAP_RAD / self.step, 2.0)].sum())
        line = (
            fit_line(phases[inside], times[inside])
            if len(beam_phases) > 1 and lost <= (1 - MIN_COVERAGE) * self.n
            else None
        )
        if line is None:
            self.n_lost += 1
            return None
        first, step = line
        self.rate = 1 / step
        valid = inside & ~np.isnan(ranges)
        order = np.flatnonzero(valid)[np.argsort(-np.abs(phases - places)[valid], kind="stable")]  # the nearest last
        grid = np.full(self.n, np.nan, np.float32)
        grid[places[order]] = ranges[order]
        grid_intensities = None
        if intensities is not None:
            grid_intensities = np.zeros(self.n, np.float32)
            grid_intensities[places[order]] = intensities[order]
        return GridSweep(first, first + step * (self.n - 1), grid, grid_intensities)


def fit_line(phases: Float64s, times: Float64s) -> tuple[float, float] | None:
    """Least squares fit time = first + step * phase, s; None if time does not increase."""
    mean_phase, mean_time = float(phases.mean()), float(times.mean())
    spread = phases - mean_phase
    square = float((spread * spread).sum())
    step = float((spread * (times - mean_time)).sum()) / square if square > 0 else 0.0
    return (mean_time - step * mean_phase, step) if step > 0 else None
