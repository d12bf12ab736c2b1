# SPDX-License-Identifier: Apache-2.0
"""True and noisy ranges of the laser, the ultrasonic and the infrared sensors."""

from math import cos, floor, inf, sin

import numpy as np
from numba import njit
from pydantic import Field

from services.sim.rays import Cells, cast_ray, ray_to_circle
from shared.config import Robot, Section
from shared.types import Float32s, Float64s


class LaserNoise(Section):
    """Errors of the laser's ranges."""

    sigma: float = Field(0.01, ge=0, le=1, description="m, standard deviation at any range")
    sigma_share: float = Field(0.005, ge=0, le=0.5, description="share of the range that is added to sigma")
    resolution: float = Field(0.001, ge=0, le=0.5, description="m, step of the readings; 0: none")
    dropout: float = Field(0.01, ge=0, le=1, description="share of the beams that come back empty")


class RangeNoise(Section):
    """Errors of ultrasonic and infrared ranges."""

    sigma: float = Field(0.005, ge=0, le=1, description="m, standard deviation")
    resolution: float = Field(0.01, ge=0, le=0.5, description="m, step of the readings; 0: none")
    dropout: float = Field(0.0, ge=0, le=1, description="share of the readings that come back empty")
    n_rays: int = Field(9, ge=1, le=99, description="rays a cone; it reads the shortest")


@njit(cache=True, nogil=True)
def ray_range(cells: Cells, people: Float64s, x: float, y: float, angle: float, limit: float) -> float:
    """Metres to the nearest of what stands still and the discs (3 p,) x, y, radius, ...; inf past `limit`."""
    c, s = cos(angle), sin(angle)
    nearest = cast_ray(cells, x, y, c, s, limit)
    for i in range(0, len(people), 3):
        nearest = min(nearest, ray_to_circle(x, y, c, s, people[i], people[i + 1], people[i + 2]))
    return nearest if nearest <= limit else inf


@njit(cache=True, nogil=True)
def sweep_ranges(
    cells: Cells,
    history: Float64s,
    first_beam: float,
    beam_step: float,
    mount: tuple[float, float, float],
    angle_min: float,
    increment: float,
    n_beams: int,
    limit: float,
) -> Float64s:
    """(n_beams,) true ranges, m, inf without echo: each beam from the pose, and against the people, of its own time.

    history: as in dynamics.advance.  first_beam, beam_step: time of the first beam and between beams, in steps of the
    physics.  mount: base_from_laser.
    """
    ranges = np.empty(n_beams)
    mount_x, mount_y, mount_yaw = mount
    at = np.empty(history.shape[1])
    for i in range(n_beams):
        step = first_beam + i * beam_step
        k = floor(step)
        share = step - k
        before, after = history[k % len(history)], history[(k + 1) % len(history)]
        for j in range(len(at)):
            at[j] = before[j] + share * (after[j] - before[j]) if share > 0.0 else before[j]
        c, s = cos(at[2]), sin(at[2])
        x, y = at[0] + c * mount_x - s * mount_y, at[1] + s * mount_x + c * mount_y
        ranges[i] = ray_range(cells, at[3:], x, y, at[2] + mount_yaw + angle_min + i * increment, limit)
    return ranges


@njit(cache=True, nogil=True)
def cone_ranges(cells: Cells, at: Float64s, sensors: Float64s, n_rays: int) -> Float64s:
    """(n,) true ranges, m: the shortest of `n_rays` rays across each cone; inf where nothing is in reach.

    at: a row of the history.  sensors: (n, 5) x, y, yaw in `base`, field of view rad, reach m.
    """
    ranges = np.full(len(sensors), inf)
    c, s = cos(at[2]), sin(at[2])
    for i in range(len(sensors)):
        mount_x, mount_y, yaw, view, reach = sensors[i]
        x, y = at[0] + c * mount_x - s * mount_y, at[1] + s * mount_x + c * mount_y
        for k in range(n_rays):
            share = k / (n_rays - 1) - 0.5 if n_rays > 1 else 0.0
            ranges[i] = min(ranges[i], ray_range(cells, at[3:], x, y, at[2] + yaw + share * view, reach))
    return ranges


def add_noise(
    true: Float64s,
    noise: LaserNoise | RangeNoise,
    range_min: float,
    range_max: float | Float64s,
    rng: np.random.Generator,
) -> Float32s:
    """(n,) float32 readings of true ranges: noisy, in steps, NaN where dropped or not within range_min..range_max."""
    share = noise.sigma_share if isinstance(noise, LaserNoise) else 0.0
    draws, drops = rng.standard_normal(len(true)), rng.random(len(true))
    is_valid = np.isfinite(true) & (drops >= noise.dropout)
    ranges = np.where(is_valid, true, 0.0)
    ranges = ranges + (noise.sigma + share * ranges) * draws
    if noise.resolution > 0:
        ranges = np.round(ranges / noise.resolution) * noise.resolution
    is_valid &= (ranges >= range_min) & (ranges <= range_max)
    return np.where(is_valid, ranges, np.nan).astype(np.float32)


def cone_table(robot: Robot) -> Float64s:
    """The range sensors in the order of a board report, ultrasonic first: (n, 5) as `cone_ranges` takes them."""
    sensors = [s for kind in ("ultrasonic", "infrared") for s in robot.ranges if s.kind == kind]
    rows = [(s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view, s.range_max) for s in sensors]
    return np.array(rows, float).reshape(-1, 5)
