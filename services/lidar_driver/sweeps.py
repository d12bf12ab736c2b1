# SPDX-License-Identifier: Apache-2.0
"""Beams as they come, made into sweeps on the grid of the configuration."""

from dataclasses import dataclass
from math import pi

import numpy as np

from services.lidar_driver.device import Float32s, Float64s, Returns, steps_of
from shared.config import Laser

GAP = pi / 15  # rad without a beam that count as lost, not as sparse
LEAST_HEARD = 0.5  # share of a sweep's angle; a sweep with less is the rest of one, and is not told
LAST = 1.25  # steps before the end of the grid at which a beam is the last one; an earlier one in its place is not yet
LONGEST_PAUSE = 1.0  # s between two beams after which the turning must be learned anew
BACK = 0.05  # s by which the device's times may go back inside a packet's corrections
MOST_BEAMS = 100_000  # kept for a sweep; a device that never comes round must not fill the memory


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep on the grid.

    first, last: s on the device's clock when the first and the last beam were taken.  ranges: (n,) m, NaN without a
    measurement.  intensities: (n,), 0 without one, or none at all.
    """

    first: float
    last: float
    ranges: Float32s
    intensities: Float32s | None


class Sweeps:
    """Cuts where the device passes the grid's first angle, in its own direction of turning.

    angle_min, increment: rad, of the sweeps: the grid's own, or that grid mirrored where the device turns against it,
    so that beams always follow each other in time.
    """

    def __init__(self, laser: Laser, clockwise: bool, inverted: bool) -> None:
        self.n = laser.n_beams
        self.step = abs(laser.angle_increment)
        self.turn = 2 * pi / self.step  # steps of the grid in a full turn
        self.sign = -1.0 if inverted else 1.0  # from the device's angles to ours: it hangs upside down
        self.direction = -1.0 if clockwise != inverted else 1.0
        self.increment = self.direction * self.step
        last = laser.angle_min + (self.n - 1) * laser.angle_increment
        forward = laser.angle_increment * self.direction > 0
        self.angle_min = laser.angle_min if forward else (last + pi) % (2 * pi) - pi
        self.rate = laser.rate * self.turn  # steps of the grid per s, measured from sweep to sweep
        self.n_lost = 0  # sweeps of which too little came
        self.restart()

    def restart(self) -> None:
        """Forgets the sweep under way."""
        self.raw, self.phase, self.time = 0.0, 0.0, 0.0  # of the last beam; steps of the grid, s
        self.begun = False
        self.current = 0  # number of the sweep under way
        self.kept: list[tuple[Float64s, Float64s, Float32s, Float32s | None]] = []
        self.n_kept = 0

    def add(self, returns: Returns) -> list[Sweep]:
        """Takes beams; the sweeps that they complete."""
        if returns.restarted or (self.begun and not self._goes_on(returns.times)):
            self.restart()
        phases = self._unwrapped(returns)
        self.kept.append((phases, returns.times, returns.ranges, returns.intensities))
        self.n_kept += len(phases)
        found = []
        reached = float(phases.max())
        if reached >= self.current * self.turn + self.n - LAST:
            phases, times, ranges, intensities = self._joined()
            numbers = np.floor((phases + 0.5) / self.turn).astype(np.int64)
            newest = int(numbers.max())
            for number in np.unique(numbers[numbers >= self.current]).tolist():
                if number < newest or reached >= number * self.turn + self.n - LAST:
                    own = numbers == number
                    mine = intensities[own] if intensities is not None else None
                    sweep = self._finished(phases[own] - number * self.turn, times[own], ranges[own], mine)
                    found += [sweep] if sweep else []
                    self.current = number + 1
            later = numbers >= self.current
            rest = intensities[later] if intensities is not None else None
            self.kept, self.n_kept = [(phases[later], times[later], ranges[later], rest)], int(later.sum())
        if self.n_kept > MOST_BEAMS:
            self.restart()
        return found

    def _goes_on(self, times: Float64s) -> bool:
        steps = steps_of(times, self.time)
        return bool(steps.min() > -BACK and steps.max() < LONGEST_PAUSE)

    def _unwrapped(self, returns: Returns) -> Float64s:
        """(n,) steps of the grid since the first angle of sweep 0; whole turns that were lost are counted by time."""
        raw = self.direction * (self.sign * returns.angles - self.angle_min) / self.step
        if not self.begun:
            self.begun = True
            self.raw, self.time = float(raw[0]), float(returns.times[0])
            self.phase = (self.raw + 0.5) % self.turn - 0.5
            self.current = 0
        expected = self.rate * steps_of(returns.times, self.time)
        steps = steps_of(raw, self.raw) - expected
        steps -= self.turn * np.rint(steps / self.turn)
        phases: Float64s = self.phase + np.cumsum(steps + expected)
        self.raw, self.phase, self.time = float(raw[-1]), float(phases[-1]), float(returns.times[-1])
        return phases

    def _joined(self) -> tuple[Float64s, Float64s, Float32s, Float32s | None]:
        phases, times, ranges, intensities = zip(*self.kept)
        with_all = [i for i in intensities if i is not None]
        joined = np.concatenate(with_all) if len(with_all) == len(intensities) else None
        return np.concatenate(phases), np.concatenate(times), np.concatenate(ranges), joined

    def _finished(
        self, phases: Float64s, times: Float64s, ranges: Float32s, intensities: Float32s | None
    ) -> Sweep | None:
        """The sweep of these beams: phases from its first angle; None where too little of it was heard."""
        places = np.floor(phases + 0.5).astype(np.int64)
        inside = (places >= 0) & (places < self.n)
        heard = np.sort(phases[inside])
        gaps = np.diff(heard, prepend=-0.5, append=self.n - 0.5)
        lost = float(gaps[gaps > max(GAP / self.step, 2.0)].sum())
        line = fitted(phases[inside], times[inside]) if len(heard) > 1 and lost <= (1 - LEAST_HEARD) * self.n else None
        if line is None:
            self.n_lost += 1
            return None
        first, step = line
        self.rate = 1 / step
        valid = inside & ~np.isnan(ranges)
        order = np.flatnonzero(valid)[np.argsort(-np.abs(phases - places)[valid], kind="stable")]  # the nearest last
        grid = np.full(self.n, np.nan, np.float32)
        grid[places[order]] = ranges[order]
        bright = None
        if intensities is not None:
            bright = np.zeros(self.n, np.float32)
            bright[places[order]] = intensities[order]
        return Sweep(first, first + step * (self.n - 1), grid, bright)


def fitted(phases: Float64s, times: Float64s) -> tuple[float, float] | None:
    """Least squares time = first + step * phase; None where time does not go on."""
    mean_phase, mean_time = float(phases.mean()), float(times.mean())
    spread = phases - mean_phase
    square = float((spread * spread).sum())
    step = float((spread * (times - mean_time)).sum()) / square if square > 0 else 0.0
    return (mean_time - step * mean_phase, step) if step > 0 else None
