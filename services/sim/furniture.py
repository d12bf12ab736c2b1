# SPDX-License-Identifier: Apache-2.0
"""Generates a room's furniture: desks, shelves, tables, chairs, plants. All doors stay connected for a robot."""

from dataclasses import dataclass, field
from math import cos, radians, sin
from typing import Any

import numpy as np
import scipy

from shared.geometry import Pose2
from shared.types import Bools, Float64s

Rectangle = tuple[float, float, float, float]  # left, low, right, high, m

CELL = 0.05  # m: side of the cells in which room is counted
MIN_HALF_PASSAGE_M = 0.4  # m: half of the narrowest passage that furniture leaves, with a margin for loose things
DOOR_DEPTH_M, DOOR_SIDE_M = 1.0, 0.25  # m: free space in front of a door, and beside it
WALL_CLEARANCE_M = 0.07  # m: from a wall's middle line to furniture
MIN_REACHABLE_SHARE = 0.45  # minimum share of the floor that can be reached


@dataclass
class Furniture:
    """boxes, cylinders: as in a world's YAML.  middle: (x, y) m, the point with the largest clearance.

    top: top of a table on legs, a box above the laser's plane.
    """

    boxes: list[dict[str, Any]] = field(default_factory=list)
    cylinders: list[dict[str, Any]] = field(default_factory=list)
    top: list[dict[str, Any]] = field(default_factory=list)
    middle: tuple[float, float] = (0.0, 0.0)


def on_walls(room: Rectangle, distance_to_polygon: tuple[float, float, float]) -> bool:
    """Whether a door's middle lies on the room's outline."""
    x, y, _ = distance_to_polygon
    left, low, right, high = room
    inside_x, inside_y = left - 0.01 < x < right + 0.01, low - 0.01 < y < high + 0.01
    on_x, on_y = min(abs(x - left), abs(x - right)) < 0.01, min(abs(y - low), abs(y - high)) < 0.01
    return (inside_x and on_y) or (inside_y and on_x)


def furnish_room(room: Rectangle, gaps: list[tuple[float, float, float]], rng: np.random.Generator) -> Furniture:
    """Furniture for a room with these doors (x, y, width), m. A piece that would block a passage is left out.

    Rooms of equal size and doors get equal furniture from generators in equal states.
    """
    left, low, right, high = room
    w, h = right - left, high - low
    rows, columns = int(h / CELL), int(w / CELL)
    y, x = np.mgrid[:rows, :columns]
    x, y = left + (x + 0.5) * CELL, low + (y + 0.5) * CELL
    walls = (
        (x < left + WALL_CLEARANCE_M)
        | (x > right - WALL_CLEARANCE_M)
        | (y < low + WALL_CLEARANCE_M)
        | (y > high - WALL_CLEARANCE_M)
    )
    door_areas = []  # each door
    for door_x, door_y, width in gaps:
        half, on_side = width / 2 + DOOR_SIDE_M, min(abs(door_x - left), abs(door_x - right)) < 0.01
        deep, wide = (DOOR_DEPTH_M, half) if on_side else (half, DOOR_DEPTH_M)
        door_areas.append((abs(x - door_x) < deep) & (abs(y - door_y) < wide))
    doorways = np.logical_or.reduce(door_areas)
    furniture, solid = Furniture(), walls.copy()
    for _ in range(3 + int(w * h / 3)):
        kind = rng.random()
        beside = kind < 0.55
        piece = _wall_furniture(room, rng) if beside else _middle_furniture(room, rng, kind > 0.8)
        piece_area = _area(x, y, piece.boxes, piece.cylinders)
        claimed = piece_area | _area(x, y, piece.top, [])
        barred = doorways | (solid & ~walls if beside else solid)
        if not (claimed & barred).any() and _passable(solid | piece_area, door_areas, walls):
            solid |= piece_area
            furniture.boxes += piece.boxes
            furniture.cylinders += piece.cylinders
    room_left = scipy.ndimage.distance_transform_edt(np.pad(~solid, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(room_left)), solid.shape)
    furniture.middle = float(x[row, column]), float(y[row, column])
    return furniture


def _area(x: Float64s, y: Float64s, boxes: list[dict[str, Any]], cylinders: list[dict[str, Any]]) -> Bools:
    """(h, w) bool: which cells these things overlap. x, y: (h, w) m, middles of the cells."""
    area = np.zeros(x.shape, bool)
    for box in boxes:
        (a, b), turn = box["size"], radians(box["yaw_deg"])
        dx, dy = x - box["x"], y - box["y"]
        along, across = cos(turn) * dx + sin(turn) * dy, cos(turn) * dy - sin(turn) * dx
        area |= (abs(along) <= a / 2 + CELL / 2) & (abs(across) <= b / 2 + CELL / 2)
    for disc in cylinders:
        area |= np.hypot(x - disc["x"], y - disc["y"]) <= disc["radius"] + CELL / 2
    return area


def _passable(solid: Bools, door_areas: list[Bools], walls: Bools) -> bool:
    """Whether a disc of ROOM m still gets from every door to every other and over much of the floor."""
    clear = scipy.ndimage.distance_transform_edt(np.pad(~solid, 1))[1:-1, 1:-1] * CELL > MIN_HALF_PASSAGE_M
    parts, n = scipy.ndimage.label(clear)
    if not n:
        return False
    largest = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    covered = scipy.ndimage.distance_transform_edt(~largest) * CELL <= MIN_HALF_PASSAGE_M
    meets = all((largest & door).any() for door in door_areas)
    return bool(meets and covered.sum() >= MIN_REACHABLE_SHARE * (~walls).sum())


def _wall_furniture(room: Rectangle, rng: np.random.Generator) -> Furniture:
    """A desk with its chair, a shelf or a cabinet along a wall."""
    left, low, right, high = room
    deep, wide, chair = (
        (0.8, 1.6, True), (0.4, float(rng.uniform(0.6, 2.0)), False), (0.5, 0.9, False), (0.75, 1.4, True),
    )[int(rng.integers(4))]  # fmt: skip
    side, share, at_chair = int(rng.integers(4)), float(rng.uniform()), float(rng.uniform(-0.3, 0.3))
    flat = side < 2  # along the lower or the upper wall
    start, end = (left, right) if flat else (low, high)
    along = start + WALL_CLEARANCE_M + wide / 2 + share * max(end - start - wide - 2 * WALL_CLEARANCE_M, 0.0)
    sign = 1 if side in (0, 2) else -1
    wall = (low, high, left, right)[side]
    off, off_chair = wall + sign * (WALL_CLEARANCE_M + deep / 2), wall + sign * (WALL_CLEARANCE_M + deep + 0.3)
    place, size = ((along, off), [wide, deep]) if flat else ((off, along), [deep, wide])
    box = {"x": round(place[0], 3), "y": round(place[1], 3), "size": [round(s, 3) for s in size], "yaw_deg": 0.0}
    if not chair:
        return Furniture([box])
    x, y = (along + at_chair, off_chair) if flat else (off_chair, along + at_chair)
    return Furniture([box], [{"x": round(x, 3), "y": round(y, 3), "radius": 0.22, "loose": True}])


def _middle_furniture(room: Rectangle, rng: np.random.Generator, small: bool) -> Furniture:
    """A table, whole or on legs and turned a little, or something small: a box on the floor, a plant, a stool."""
    left, low, right, high = room
    x, y = float(rng.uniform(left + 0.5, right - 0.5)), float(rng.uniform(low + 0.5, high - 0.5))
    turn = float(rng.uniform(-20, 20))
    form, a, b = float(rng.random()), float(rng.uniform(0.9, 2.2)), float(rng.uniform(0.7, 1.1))
    x, y, turn, a, b = round(x, 3), round(y, 3), round(turn, 1), round(a, 3), round(b, 3)
    if small and form < 0.5:
        return Furniture([{"x": x, "y": y, "size": [0.45, 0.35], "yaw_deg": turn, "loose": True}])
    if small:
        return Furniture([], [{"x": x, "y": y, "radius": round(0.1 + 0.2 * form, 3), "loose": form < 0.8}])
    table = {"x": x, "y": y, "size": [a, b], "yaw_deg": turn}
    if form < 0.5:
        return Furniture([table])
    legs = Pose2(x, y, radians(turn)) @ np.array([(i * a / 2, k * b / 2) for i in (-1, 1) for k in (-1, 1)])
    return Furniture([], [{"x": round(u, 3), "y": round(v, 3), "radius": 0.03} for u, v in legs.tolist()], [table])
