# SPDX-License-Identifier: Apache-2.0
"""Zones in local control: a keep-out zone is an obstacle, a speed zone a limit that begins before it.

A virtual wall of the map counts as a keep-out zone, and so does the place of a contact. The laser would clear an
obstacle of the map alone.

A zone lies in `map`, so its place in `odom` depends on the pose. Without a pose no zone applies, and no plan is
driven.

After Nav2's KeepoutFilter and SpeedFilter, with polygons in place of a mask. Braking before a speed zone is our own.
"""

from itertools import pairwise
from math import inf, sqrt

import numpy as np

from services.local_ctrl.controller import APPROACH_BRAKING_SHARE
from services.local_ctrl.rollout import Limits, Motion
from shared.config import Robot
from shared.contacts import ContactPlaces
from shared.geometry import Pose2
from shared.messages import Contacts, EditKind, MapEdit, MapState, ZoneKind, Zones
from shared.polygon import contains
from shared.types import Bools, Float64s
from shared.zones import KeepOut, mark_cells, polygon_of

MARGIN_S = 0.25  # at the present speed, by which a zone begins earlier and ends later: ticks, cells, late commands


class LocalZones:
    """The present zones, and which keep-out zones the robot stands in."""

    def __init__(self, robot: Robot) -> None:
        reach = robot.circumscribed_radius
        self._contact_places = ContactPlaces(robot)
        self._keep_out, self._walls, self._contacts = KeepOut(reach), KeepOut(reach), KeepOut(reach)
        self._map_of_walls = self._map_of_contacts = 0  # their ids
        self._slow: tuple[tuple[Float64s, float, float], ...] = ()  # polygon in `map`, m/s, share of the top speed

    def set_zones(self, zones: Zones) -> None:
        """Replaces the zones."""
        self._keep_out.take(zones)
        self._slow = tuple((polygon_of(z), z.speed, z.share) for z in zones.zones if z.kind is ZoneKind.SLOW)

    def add_contacts(self, contacts: Contacts, map_from_base: Pose2, now: int, map_id: int) -> None:
        """Takes contacts of the robot at a pose on a map: their places are zones on it for a while. now: ns."""
        if is_other_map := map_id != self._map_of_contacts:
            self._map_of_contacts = map_id
            self._contact_places.clear()
        if self._contact_places.add(contacts, map_from_base, now) or is_other_map:
            self._contacts.take_polygons(self._contact_places.polygons)

    def set_walls(self, state: MapState) -> None:
        """Replaces the virtual walls of the map."""
        walls = (edit for edit in state.edits if edit.kind is EditKind.WALL)
        self._walls.take_polygons(tuple(polygon for edit in walls for polygon in wall_polygons(edit)))
        self._map_of_walls = state.map_id

    def forbidden_cells(
        self, odom_from_map: Pose2, here: Pose2, window: tuple[float, float, float, int], map_id: int
    ) -> Bools | None:
        """(n, n) bool: cells in keep-out zones and walls, for the robot at `here` in `odom`; None without any.

        window: x0, y0 m in `odom` of the centre of its lower left cell; m a cell; cells along a side.
        map_id: of the present map; walls and contacts of another one do not count.
        """
        walls = (self._walls,) if map_id == self._map_of_walls else ()
        contacts = (self._contacts,) if map_id == self._map_of_contacts else ()
        kinds = (self._keep_out, *contacts, *walls)
        for kind in kinds:
            kind.moved(odom_from_map.inverse() @ here)
        x0, y0, resolution, n = window
        low, size = np.array((x0, y0)) - 0.5 * resolution, n * resolution
        cells: Bools | None = None
        for polygon in (polygon for kind in kinds for polygon in kind.holding):
            in_odom = odom_from_map @ polygon
            if (in_odom.max(axis=0) < low).any() or (in_odom.min(axis=0) > low + size).any():
                continue
            cells = np.zeros((n, n), bool) if cells is None else cells
            mark_cells(cells, low[0], low[1], resolution, in_odom)
        return cells

    def limits_in_zones(self, limits: Limits, path: Float64s, motion: Motion, odom_from_map: Pose2) -> Limits:
        """The limits with a speed from which the robot brakes gently to that of each zone ahead.

        path: (k, 2) m in `odom`, the path ahead of the robot; k may be 0.
        """
        if not self._slow:
            return limits
        slack = MARGIN_S * motion.v
        behind = motion.pose @ Pose2(-slack, 0.0, 0.0)
        points = np.concatenate(([[behind.x, behind.y], [motion.pose.x, motion.pose.y]], path))
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T)))) - 2.0 * abs(slack)
        in_map = odom_from_map.inverse() @ points
        least = inf
        for polygon, speed, share in self._slow:
            low, high = polygon.min(axis=0), polygon.max(axis=0)
            near = ((in_map >= low) & (in_map <= high)).all(axis=1)
            entered = np.flatnonzero(near)[contains(polygon, in_map[near])] if near.any() else near[:0]
            if len(entered):
                most = min(speed, share * limits.v_max)
                way = max(float(along[entered[0]]), 0.0)
                least = min(least, sqrt(most**2 + 2.0 * APPROACH_BRAKING_SHARE * limits.braking * way))
        if least >= limits.v_max:
            return limits
        return limits._replace(v_max=least, v_min=max(limits.v_min, -least))


def wall_polygons(wall: MapEdit) -> list[Float64s]:
    """The rectangle (4, 2), m in `map`, along each piece of a wall."""
    points = np.column_stack((wall.xs, wall.ys))
    rectangles = []
    for start, end in pairwise(points) if len(points) > 1 else ((points[0], points[0]),):
        along = end - start
        length = float(np.hypot(*along))
        along = along / length if length > 0 else np.array((1.0, 0.0))
        ahead, aside = 0.5 * wall.width * along, 0.5 * wall.width * np.array((-along[1], along[0]))
        rectangles.append(
            np.array([start - ahead - aside, end + ahead - aside, end + ahead + aside, start - ahead + aside])
        )
    return rectangles
