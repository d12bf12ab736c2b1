# SPDX-License-Identifier: Apache-2.0
"""Which bumpers of the simulated robot are pressed, and which of its cliff sensors see no floor."""

import numpy as np

from services.sim.contact import offset_polygon, touches_people, touches_world, transform_polygon
from services.sim.rays import Cells
from shared.contacts import outline_sector
from shared.geometry import Pose2
from shared.messages import Contacts
from shared.polygon import contains
from shared.robot import Robot
from shared.types import Float64s

PRESSED_M = 0.005  # m beyond the outline that a bumper feels: a blocked robot stands within 1 mm


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
    (out, _), (back, _) = (outline_sector(corners, bearing, width) for corners in (outer, inner))
    return np.concatenate([out, back[::-1]])
