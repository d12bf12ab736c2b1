# SPDX-License-Identifier: Apache-2.0
"""Which bumpers of the simulated robot are pressed, and which of its cliff sensors see no floor."""

from math import atan2, cos, pi, sin

import numpy as np

from services.sim.contact import offset_polygon, touches_people, touches_world, transform_polygon
from services.sim.rays import Cells
from shared.geometry import Pose2, wrapped
from shared.messages import Contacts
from shared.polygon import contains
from shared.robot import Robot
from shared.types import Float64s

PRESSED_M = 0.005  # m beyond the outline that a bumper feels: a blocked robot stands within 1 mm
STEP_RAD = pi / 36  # between the points of a bumper's outline


class ContactSensors:
    """The sensors' areas, in `base`."""

    def __init__(self, robot: Robot, cliffs: tuple[Float64s, ...]) -> None:
        """cliffs: polygons (k, 2) m in the world, without floor."""
        outer, inner = offset_polygon(robot.corners, PRESSED_M), robot.corners
        self._robot, self._cliffs = robot, cliffs
        self._bumpers = {b.name: _strip(inner, outer, b.bearing, b.width) for b in robot.bumpers}

    def contacts(self, stamp: int, pose: Pose2, cells: Cells, people: Float64s) -> Contacts:
        """What the sensors report at a pose in the world. people: (p, 3) x, y, radius, m."""
        areas = {name: transform_polygon(area, pose.x, pose.y, pose.yaw) for name, area in self._bumpers.items()}
        pressed = (name for name, area in areas.items() if touches_world(area, cells) or touches_people(area, people))
        open_floor = (c.name for c in self._robot.cliffs if self._is_over_cliff(pose @ np.array([[c.x, c.y]])))
        return Contacts(stamp, tuple(pressed), tuple(open_floor), False)

    def _is_over_cliff(self, point: Float64s) -> bool:
        return any(bool(contains(cliff, point)[0]) for cliff in self._cliffs)


def _strip(inner: Float64s, outer: Float64s, bearing: float, width: float) -> Float64s:
    """(k, 2) m: the area between two outlines around the origin, within a sector (rad)."""
    half = min(width / 2, pi - STEP_RAD / 4)
    corners = [atan2(y, x) for x, y in outer.tolist()]
    offsets = [o for o in (wrapped(a - bearing) for a in corners) if abs(o) < half]
    angles = bearing + np.array(sorted({*offsets, *np.linspace(-half, half, 2 + round(2 * half / STEP_RAD)).tolist()}))
    out = [_on_outline(outer, a) for a in angles.tolist()]
    back = [_on_outline(inner, a) for a in reversed(angles.tolist())]
    return np.array(out + back)


def _on_outline(corners: Float64s, angle: float) -> tuple[float, float]:
    """The farthest point of the outline in a direction (rad) from the origin, m."""
    dx, dy = cos(angle), sin(angle)
    ends = np.roll(corners, -1, axis=0)
    ex, ey = (ends - corners).T
    crossing = dx * ey - dy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (corners[:, 0] * ey - corners[:, 1] * ex) / crossing
        share = (corners[:, 0] * dy - corners[:, 1] * dx) / crossing
    met = (np.abs(crossing) > 1e-12) & (along > 0) & (share >= -1e-9) & (share <= 1 + 1e-9)
    far = float(along[met].max())
    return far * dx, far * dy
