# SPDX-License-Identifier: Apache-2.0
"""The critics of MPPI: their weights, and the cost of being near static and dynamic obstacles.

`obstacle`, `critical` and `collision` are derived from ObstaclesCritic of Nav2's MPPI, `goal` from its GoalCritic,
`reverse` from PreferForwardCritic, `twirl` from TwirlingCritic. Unlike there, all costs are metres of path. `progress`
and `haste` use the cost to go in place of Nav2's path critics. `overspeed`, `headway` and the terms of dynamic
obstacles are our own; the last two follow the guard's stopping distance.
"""

from math import hypot
from typing import ClassVar, NamedTuple

from numba import njit
from pydantic import Field

from services.local_ctrl.footprint import bilinear
from services.local_ctrl.rollout import Limits
from shared.config import Section
from shared.types import Float32s, Float64s

REACTION_S = 0.2  # delay between a command and the wheels' motion, as in the guard's field


class Critics(Section):
    """Cost of a rollout in metres of path: the weight of each term."""

    RENAMED: ClassVar[dict[str, str]] = {"mover": "dynamic_collision", "near_mover": "dynamic_obstacle"}

    progress: float = Field(2.0, ge=0, le=100, description="1: a metre of cost to go at the horizon's end")
    haste: float = Field(2.0, ge=0, le=100, description="1: a metre of cost to go, averaged over the horizon")
    goal: float = Field(2.0, ge=0, le=100, description="1: a metre from the end, averaged, within half a metre of it")
    obstacle: float = Field(1.0, ge=0, le=1000, description="m/s: driving with no clearance left; 0 at `clearance`")
    critical: float = Field(20.0, ge=0, le=1000, description="m/s: being without clearance; 0 at `critical_clearance`")
    overspeed: float = Field(
        4.0, ge=0, le=1000, description="s/m: squared speed above what the clearance, or stopping at the goal, allows"
    )
    headway: float = Field(
        20.0, ge=0, le=1000, description="1/(m s): squared part of the braking distance that is not free ahead"
    )
    dynamic_collision: float = Field(
        100.0, ge=0, le=1000, description="m: contact with a dynamic obstacle at once; less when it is later"
    )
    dynamic_obstacle: float = Field(
        10.0, ge=0, le=1000, description="m/s: a dynamic obstacle at the outline; 0 at `dynamic_clearance`"
    )
    reverse: float = Field(3.0, ge=0, le=100, description="1: a metre driven backward")
    twirl: float = Field(0.15, ge=0, le=100, description="m s/rad^2: squared turn rate")
    smooth: float = Field(
        0.01, ge=0, le=100, description="m: squared change of command, as a share of the possible one"
    )
    collision: float = Field(1000.0, ge=10, le=1e6, description="m: a collision at once; less when it is later")


class Weights(NamedTuple):
    """`Critics` and the clearances, as the kernel takes them."""

    progress: float
    haste: float
    goal: float
    obstacle: float
    critical: float
    overspeed: float
    headway: float
    dynamic_collision: float
    dynamic_obstacle: float
    reverse: float
    twirl: float
    smooth: float
    collision: float
    clearance: float
    critical_clearance: float
    full_speed_clearance: float
    min_speed_share: float
    dynamic_clearance: float


@njit(cache=True, nogil=True)
def dynamic_clearance(
    discs: Float64s,
    x: float,
    y: float,
    c: float,
    s: float,
    ahead: float,
    inscribed: float,
    circumscribed: float,
    far: float,
) -> float:
    """m from the outline at (x, y), and from its stopping distance, to discs (k, 3) x, y, radius m at that time.

    The guard brakes for an obstacle within the stopping distance, and a robot that stands before a moving one is hit.

    x, y: m in the frame of the discs. c, s: cosine and sine of the heading. ahead: m of stopping distance; negative:
    backward. far: m beyond which the distance does not matter.
    """
    least = far
    reach = far + max(circumscribed, abs(ahead) + inscribed)
    for k in range(len(discs)):
        dx, dy = discs[k, 0] - x, discs[k, 1] - y
        if dx * dx + dy * dy >= (reach + discs[k, 2]) ** 2:
            continue
        along = c * dx + s * dy
        nearest = min(max(along, 0.0), ahead) if ahead >= 0.0 else max(min(along, 0.0), ahead)
        here = hypot(dx, dy) - circumscribed
        least = min(least, min(here, hypot(along - nearest, c * dy - s * dx) - inscribed) - discs[k, 2])
    return least


@njit(cache=True, nogil=True, inline="always")
def stopping_distance(v: float, limits: Limits, weights: Weights) -> float:
    """m that the guard keeps free ahead at a speed of v m/s."""
    return abs(v) * REACTION_S + v * v / (2.0 * limits.braking) + weights.critical_clearance


@njit(cache=True, nogil=True, inline="always")
def obstacle_cost(
    field: Float32s,
    resolution: float,
    inscribed: float,
    circumscribed: float,
    limits: Limits,
    weights: Weights,
    x: float,
    y: float,
    c: float,
    s: float,
    v: float,
    room: float,
) -> float:
    """The cost, m/s, of a clearance of `room` m at a speed of v m/s.

    x, y: m from the centre of the field's lower left cell. c, s: cosine and sine of the heading.
    """
    cost = 0.0
    speed = abs(v)
    if room < weights.clearance:
        share = 1.0 - max(room, 0.0) / weights.clearance
        cost += weights.obstacle * speed * share * share
    if room < weights.critical_clearance:
        share = 1.0 - max(room, 0.0) / weights.critical_clearance
        cost += weights.critical * share * share * (0.2 + speed)
    if room < weights.full_speed_clearance:
        share = (
            weights.min_speed_share + (1.0 - weights.min_speed_share) * max(room, 0.0) / weights.full_speed_clearance
        )
        over = max(0.0, speed - share * limits.v_max)
        cost += weights.overspeed * over * over
    # the guard stops for an obstacle within the braking distance straight ahead
    stopping = stopping_distance(v, limits, weights)
    if room < stopping + circumscribed:
        ahead = stopping if v >= 0.0 else -stopping
        free = bilinear(field, (x + c * ahead) / resolution, (y + s * ahead) / resolution)
        short = max(0.0, inscribed - free)
        cost += weights.headway * short * short * speed
    return cost
