# SPDX-License-Identifier: Apache-2.0
"""The greatest safe speed on an arc: the robot must be able to stop before contact (ISO 13855).

The field is the footprint, grown by `side_margin`, swept along the commanded arc over the stopping distance. In `base`
a static point moves on a circle about the centre of rotation. The first contact is where that circle meets the grown
outline. This is exact for any simple polygon, without sampled poses.

Unlike the minimum distance of ISO 13855, the field has no approach speed of a person: obstacles are static. The rule
for the speed is that of admissible velocities (Fox, Burgard and Thrun 1997, equation 14), with a reaction time. The
contact of any polygon on an arc is our own.
"""

from dataclasses import dataclass
from math import inf, pi, sqrt
from typing import ClassVar

import numpy as np
from pydantic import Field

from shared.config import Drive, Section
from shared.polygon import contains, offsets_from_outline, signed_distances
from shared.types import Float64s

TOUCHING_M = 0.005  # nearer than this the direction of motion decides, not the distance
MIN_CURVATURE = 1e-4  # 1/m; flatter arcs count as lines: over 3 m they differ by less than a millimetre
MIN_RIM_SPEED = 1e-6  # m/s of the fastest point of the outline; slower counts as standstill


class FieldConfig(Section):
    """The protective field."""

    RENAMED: ClassVar[dict[str, str]] = {"slowest": "min_speed"}

    reaction: float = Field(0.2, ge=0, le=2, description="s from a command until the wheels act, with all delays")
    stop_margin: float = Field(0.05, ge=0.02, le=1, description="m left free in front at standstill")
    side_margin: float = Field(0.02, ge=0, le=0.5, description="m by which the footprint is grown on all sides")
    self_mask: float = Field(0.03, ge=0, le=1, description="m: points deeper inside the footprint belong to the robot")
    min_speed: float = Field(0.02, ge=0, le=0.2, description="m/s below which a slowed robot stops")
    creep_speed: float = Field(
        0.15,
        gt=0,
        le=0.5,
        description="m/s up to which `side_margin` need not be free; also of leaving a contact and of the override",
    )
    creep_turn_rate: float = Field(
        0.5,
        gt=0,
        le=2,
        description="rad/s up to which `side_margin` need not be free; also of leaving a contact and of the override",
    )
    blind_speed: float = Field(
        0.15, gt=0, le=2, description="m/s in a direction without a view of the laser or a range sensor"
    )


@dataclass(frozen=True, slots=True)
class SafeSpeed:
    """Allowed share of a command's speed, and the travel (m) until contact, inf without."""

    share: float
    travel: float


NO_LIMIT = SafeSpeed(1.0, inf)


def safe_speed(points: Float64s, corners: Float64s, v: float, w: float, drive: Drive, config: FieldConfig) -> SafeSpeed:
    """The greatest share of the velocity (v m/s, w rad/s) from which the robot stops before contact.

    points: (n, 2) m, obstacles in `base`. corners: (k, 2) m, footprint. At creep speed `side_margin` is kept free in
    front only: a robot with an obstacle close beside it can leave.
    """
    permit = _safe_speed_with_margin(points, corners, v, w, drive, config)
    creep = min(
        config.creep_speed / max(abs(v), MIN_RIM_SPEED), config.creep_turn_rate / max(abs(w), MIN_RIM_SPEED), 1.0
    )
    if permit.share >= creep or creep * (abs(v) + abs(w)) < MIN_RIM_SPEED:
        return permit
    in_front = config.stop_margin + config.side_margin
    narrow = config.model_copy(update={"side_margin": 0.0, "stop_margin": in_front})
    creeping = _safe_speed_with_margin(points, corners, v * creep, w * creep, drive, narrow)
    return SafeSpeed(creeping.share * creep, creeping.travel) if creeping.share * creep > permit.share else permit


def _safe_speed_with_margin(
    points: Float64s, corners: Float64s, v: float, w: float, drive: Drive, config: FieldConfig
) -> SafeSpeed:
    """`safe_speed` with one side margin at all speeds.

    At a share s the robot drives on for `reaction` and then brakes on its arc: s reaction + s^2 T / 2 seconds of the
    command. T is the longer of |v| / braking and |w| / turn deceleration. `stop_margin` stays free beyond.
    """
    radius = float(np.hypot(corners[:, 0], corners[:, 1]).max())
    fastest = abs(v) + abs(w) * radius
    if fastest < MIN_RIM_SPEED or not len(points):
        return NO_LIMIT
    braking_time = max(abs(v) / drive.max_braking, abs(w) / drive.max_turn_acceleration)
    # only points within reach of the outline until standstill, with the margin, can matter
    reach = radius + config.side_margin + config.stop_margin + abs(v) * (config.reaction + braking_time / 2)
    points = points[np.hypot(points[:, 0], points[:, 1]) <= reach + 0.01]
    if not len(points):
        return NO_LIMIT
    contact = times_to_contact(points, corners, v, w, config.side_margin, config.self_mask)
    rim = np.maximum(np.hypot(v - w * points[:, 1], w * points[:, 0]), abs(v))
    met = np.isfinite(contact)
    if not met.any():
        return NO_LIMIT
    time = float((contact[met] - config.stop_margin / rim[met]).min())
    travel = float(contact[met].min()) * fastest
    if time <= 0:
        return SafeSpeed(0.0, travel)
    # s^2 T / 2 + s reaction = time, in the form that does not cancel for small T
    root = sqrt(config.reaction**2 + 2 * braking_time * time)
    share = min(1.0, 2 * time / (config.reaction + root))
    crawls = share < 1 and share * fastest < config.min_speed
    return SafeSpeed(0.0 if crawls else share, travel)


def times_to_contact(
    points: Float64s, corners: Float64s, v: float, w: float, margin: float, self_mask: float
) -> Float64s:
    """(n,) s until the footprint, grown by `margin` m, meets each static point at the velocity (v, w); inf without
    contact.

    A point nearer than the margin counts only while the robot approaches it, so driving away is always allowed. Points
    deeper inside the footprint than `self_mask` never count.
    """
    times = np.full(len(points), inf)
    straight = abs(w) <= MIN_CURVATURE * abs(v)
    lane, (low, high) = _lane_of_line(points, corners) if straight else _lane_of_arc(points, corners, v, w)
    reach = max(margin, TOUCHING_M)
    met = np.flatnonzero((lane >= low - reach) & (lane <= high + reach))
    points = points[met]
    depth, outward = distances_and_directions(points, corners)
    offsets = np.clip(depth - TOUCHING_M, 0.0, margin)
    with np.errstate(all="ignore"):
        if straight:
            contact = _line_contact_times(points, offsets, corners, v)
        else:
            contact = _arc_contact_times(points, offsets, corners, v, w)
    velocity = np.column_stack((v - w * points[:, 1], w * points[:, 0]))
    approaching = (velocity * outward).sum(axis=1) > 1e-9
    contact[depth <= 1e-6] = inf  # a touching point may be left freely
    contact[(depth <= TOUCHING_M) & approaching] = 0.0
    contact[depth < -self_mask] = inf
    times[met] = contact
    return times


def distances_and_directions(points: Float64s, corners: Float64s) -> tuple[Float64s, Float64s]:
    """Distance (n,) of points (n, 2) to the polygon's outline, m, negative inside, and the unit direction (n, 2) out
    of it.
    """
    away, nearest = offsets_from_outline(corners, points)
    distance = np.hypot(away[:, 0], away[:, 1])
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(edges[:, 0], edges[:, 1])[:, None]
    sign = np.where(contains(corners, points), -1.0, 1.0)
    # on the outline itself the direction is the edge's normal
    far = distance > 1e-9
    outward = np.where(far[:, None], away / np.where(far, distance * sign, 1.0)[:, None], normals[nearest])
    return distance * sign, outward


def _lane_of_line(points: Float64s, corners: Float64s) -> tuple[Float64s, tuple[float, float]]:
    """Offset (n,) of each point that a line keeps, m to the left, and the range of offsets that meet the outline."""
    return points[:, 1], (float(corners[:, 1].min()), float(corners[:, 1].max()))


def _lane_of_arc(points: Float64s, corners: Float64s, v: float, w: float) -> tuple[Float64s, tuple[float, float]]:
    """Distance (n,) of each point from the arc's centre, m, and the range of distances that meet the outline."""
    centre = np.array([[0.0, v / w]])
    spokes, hubs = points - centre, corners - centre
    nearest = max(float(signed_distances(corners, centre)[0]), 0.0)
    return np.hypot(spokes[:, 0], spokes[:, 1]), (nearest, float(np.hypot(hubs[:, 0], hubs[:, 1]).max()))


def _line_contact_times(points: Float64s, offsets: Float64s, corners: Float64s, v: float) -> Float64s:
    """Contact times (n,) on a line: points move along x against the robot and meet shifted edges or rounded corners."""
    way = -1.0 if v > 0 else 1.0
    starts, edges = _offset_edges(offsets, corners)
    gap = starts - points[:, None, None, :]
    ex, ey = edges[:, 0], edges[:, 1]
    across = way * ey
    path = (gap[..., 0] * ey - gap[..., 1] * ex) / across
    share = gap[..., 1] * -way / across
    meets = (path >= 0) & (share >= -1e-9) & (share <= 1 + 1e-9)
    first = np.where(meets, path, inf).min(axis=(1, 2))
    ahead = points[:, None, :] - corners
    middle = -way * ahead[..., 0]
    root = np.sqrt(offsets[:, None] ** 2 - ahead[..., 1] ** 2)
    path = middle - root
    first = np.minimum(first, np.where(path >= 0, path, inf).min(axis=1))
    return np.asarray(first / abs(v))


def _arc_contact_times(points: Float64s, offsets: Float64s, corners: Float64s, v: float, w: float) -> Float64s:
    """Contact times (n,) on an arc: points turn about (0, v / w) against the robot's turn."""
    centre = np.array([0.0, v / w])
    spokes = points - centre
    angles, radii = np.arctan2(spokes[:, 1], spokes[:, 0]), np.hypot(spokes[:, 0], spokes[:, 1])
    starts, edges = _offset_edges(offsets, corners)
    starts = starts - centre
    a = (edges**2).sum(axis=1)
    b = (starts * edges).sum(axis=3)
    c = (starts**2).sum(axis=3) - (radii**2)[:, None, None]
    root = np.sqrt(b * b - a * c)
    first = np.full(len(points), inf)
    for share in ((-b - root) / a, (-b + root) / a):
        meets = (share >= -1e-9) & (share <= 1 + 1e-9)
        where = starts + np.where(meets, share, 0.0)[..., None] * edges
        turn = _turn_angle(angles[:, None, None], np.arctan2(where[..., 1], where[..., 0]), w)
        first = np.minimum(first, np.where(meets, turn, inf).min(axis=(1, 2)))
    hubs = corners - centre
    reach = np.hypot(hubs[:, 0], hubs[:, 1])
    half = (reach**2 + (radii**2 - offsets**2)[:, None]) / (2 * reach * radii[:, None])
    half = np.arccos(half)  # NaN where the circles do not meet
    at = np.arctan2(hubs[:, 1], hubs[:, 0])
    for where in (at - half, at + half):
        turn = _turn_angle(angles[:, None], where, w)
        first = np.minimum(first, np.where(np.isnan(turn), inf, turn).min(axis=1))
    return np.asarray(first / abs(w))


def _offset_edges(offsets: Float64s, corners: Float64s) -> tuple[Float64s, Float64s]:
    """Both parallels of each edge at each point's offset: starts (n, 2, k, 2), edges (k, 2)."""
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(edges[:, 0], edges[:, 1])[:, None]
    sides = np.array([1.0, -1.0])
    return corners + (offsets[:, None] * sides)[:, :, None, None] * normals, edges


def _turn_angle(start: Float64s, end: Float64s, w: float) -> Float64s:
    """Angle (rad) in [0, 2 pi) from one direction of a point to another, against the robot's turn `w`."""
    return (start - end if w > 0 else end - start) % (2 * pi)
