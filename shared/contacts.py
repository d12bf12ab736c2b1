# SPDX-License-Identifier: Apache-2.0
"""Where does a pressed bumper, or a cliff sensor without floor, forbid to go, and for how long does the place count?

A contact is an outward direction at points of the robot's outline. The rules are our own.
"""

from dataclasses import replace
from math import atan2, cos, hypot, pi, sin

import numpy as np

from shared.geometry import Pose2
from shared.messages import Contacts
from shared.robot import Bumper, Robot
from shared.stamps import fresh, precedes
from shared.types import NS_PER_S, Float64s

MEMORY_S = 60.0
"""For which the place of a contact is an obstacle of planner and local control: the laser may not see it."""
DEPTH_M = 0.1
"""Of that obstacle, beyond the outline. Nothing is known of its size."""
MAX_APPROACH_MPS = 0.01
"""Of a point of the outline, outward, by which a motion still leads away from a contact there."""
STEP_RAD = pi / 36
MAX_PLACES = 16
MAX_AGE_S = 0.25  # of a message whose contacts are where the robot is now
MIN_ADVANCE_M = 0.01


def outline_sector(corners: Float64s, bearing: float, width: float) -> tuple[Float64s, Float64s]:
    """Points (n, 2) m of an outline within a sector, counter-clockwise, and the outward normals (n, 2) there.

    corners: (k, 2) m, of a polygon around the origin, counter-clockwise.  bearing, width: rad, middle and whole sector.
    """
    half = min(width / 2, pi - STEP_RAD / 4)
    # between two steps: a corner has no normal of its own
    angles = bearing + np.linspace(-half, half, 2 + round(2 * half / STEP_RAD))
    ends = np.roll(corners, -1, axis=0)
    edges = ends - corners
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    crossing = directions[:, :1] * edges[:, 1] - directions[:, 1:] * edges[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (corners[:, 0] * edges[:, 1] - corners[:, 1] * edges[:, 0]) / crossing
        share = (corners[:, 0] * directions[:, 1:] - corners[:, 1] * directions[:, :1]) / crossing
    met = (np.abs(crossing) > 1e-12) & (along > 0) & (share >= -1e-9) & (share <= 1 + 1e-9)
    farthest = np.where(met, along, -np.inf)
    edge = farthest.argmax(axis=1)
    points = directions * farthest.max(axis=1)[:, None]
    normals = np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(edges[:, 0], edges[:, 1])[:, None]
    return points, normals[edge]


def contact_points(robot: Robot, contacts: Contacts) -> tuple[Float64s, Float64s]:
    """Points (n, 2) m in `base` at which the robot may not go on, and the directions (n, 2) in which it may not.

    A bumper that `robot.bumpers` does not have is anywhere on the outline; so is an unknown cliff sensor.
    """
    bumpers = {bumper.name: bumper for bumper in robot.bumpers}
    cliffs = {cliff.name: cliff for cliff in robot.cliffs}
    parts = [_bumper_part(robot, bumpers.get(name)) for name in contacts.bumpers]
    for name in contacts.cliffs:
        cliff = cliffs.get(name)
        away = hypot(cliff.x, cliff.y) if cliff is not None else 0.0
        if cliff is None or away < 1e-6:
            parts.append(outline_sector(robot.corners, 0.0, 2 * pi))
        else:
            parts.append((np.array([[cliff.x, cliff.y]]), np.array([[cliff.x, cliff.y]]) / away))
    if not parts:
        return np.empty((0, 2)), np.empty((0, 2))
    return np.concatenate([points for points, _ in parts]), np.concatenate([normals for _, normals in parts])


def _bumper_part(robot: Robot, bumper: Bumper | None) -> tuple[Float64s, Float64s]:
    if bumper is None:
        return outline_sector(robot.corners, 0.0, 2 * pi)
    return outline_sector(robot.corners, bumper.bearing, bumper.width)


def leads_away(robot: Robot, contacts: Contacts, v: float, w: float) -> bool:
    """Whether the velocity (m/s, rad/s) takes the robot from all its contacts: no point approaches, and most leave."""
    points, normals = contact_points(robot, contacts)
    if not len(points):
        return True
    outward = (v - w * points[:, 1]) * normals[:, 0] + w * points[:, 0] * normals[:, 1]
    return bool(outward.max() <= MAX_APPROACH_MPS and outward.mean() < -MAX_APPROACH_MPS)


def new_contacts(contacts: Contacts, before: Contacts | None) -> Contacts:
    """The contacts that the message before did not have."""
    if before is None:
        return contacts
    bumpers, cliffs = (
        tuple(name for name in now if name not in then)
        for now, then in ((contacts.bumpers, before.bumpers), (contacts.cliffs, before.cliffs))
    )
    return replace(contacts, bumpers=bumpers, cliffs=cliffs)


class ContactPlaces:
    """Places of contacts in `map`, as polygons, for `MEMORY_S` each."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._places: list[tuple[int, str, Float64s]] = []  # ns, name, polygon
        self._last: Contacts | None = None

    def add(self, contacts: Contacts, map_from_base: Pose2, now: int) -> bool:
        """Takes contacts at a pose, and forgets the oldest at `now` (ns). Returns whether the polygons changed.

        The place of a pressed bumper moves on while the robot rolls on. When the robot leaves, it stays. A message of
        another moment, as in a burst after a broken link, changes nothing.
        """
        last = self._last
        if not fresh(contacts.stamp, now, MAX_AGE_S) or (last and precedes(contacts.stamp, last.stamp, now)):
            return False
        self._last = contacts
        kept = [place for place in self._places if 0 <= now - place[0] < MEMORY_S * NS_PER_S]
        changed = len(kept) < len(self._places)
        begun, here = new_contacts(contacts, last), np.array((map_from_base.x, map_from_base.y))
        for name in dict.fromkeys((*contacts.bumpers, *contacts.cliffs)):
            area = map_from_base @ self._area(name, contacts)
            middle = area.mean(axis=0)
            i = max((i for i, place in enumerate(kept) if place[1] == name), default=None)
            if i is None or name in (*begun.bumpers, *begun.cliffs):
                kept.append((now, name, area))
                changed = True
            elif (middle - kept[i][2].mean(axis=0)) @ (middle - here) > MIN_ADVANCE_M * np.hypot(*(middle - here)):
                kept[i] = (now, name, area)
                changed = True
            else:
                kept[i] = (now, name, kept[i][2])
        self._places = kept[-MAX_PLACES:]
        return changed

    def clear(self) -> None:
        """Forgets all: another map."""
        self._places = []

    @property
    def polygons(self) -> tuple[Float64s, ...]:
        """(n, 2) m in `map`, each."""
        return tuple(polygon for *_, polygon in self._places)

    def _area(self, name: str, contacts: Contacts) -> Float64s:
        """(k, 2) m in `base`: the area beyond the outline at one contact."""
        only = Contacts(
            stamp=contacts.stamp,
            bumpers=tuple(n for n in contacts.bumpers if n == name),
            cliffs=tuple(n for n in contacts.cliffs if n == name),
            estop=False,
        )
        points, normals = contact_points(self._robot, only)
        if len(points) == 1:  # a cliff sensor: a square before it
            angle = atan2(normals[0, 1], normals[0, 0])
            side = DEPTH_M * np.array([[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]])
            c, s = cos(angle), sin(angle)
            return np.asarray(points + side @ np.array([[c, s], [-s, c]]))
        radial = points / np.hypot(points[:, 0], points[:, 1])[:, None]
        return np.concatenate([points, (points + DEPTH_M * radial)[::-1]])
