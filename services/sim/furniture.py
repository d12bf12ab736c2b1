# SPDX-License-Identifier: Apache-2.0
"""A room's furniture: desks, shelves, tables on legs, chairs, plants, such that a robot still gets through."""

from dataclasses import dataclass, field
from math import cos, radians, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from shared.geometry import Float64s, Pose2

Bools = NDArray[np.bool_]
Rectangle = tuple[float, float, float, float]  # left, low, right, high, m

CELL = 0.05  # m: side of the cells in which room is counted
ROOM = 0.4  # m: half of the narrowest way that furniture leaves, and what loose things may take of it
DEPTH, SIDE = 1.0, 0.25  # m: that stay free before a door, and beside it
WALL = 0.07  # m: from a wall's middle line to furniture
PARTS = 0.45  # of the floor that can be reached, in a furnished room


@dataclass
class Furniture:
    """boxes and cylinders as a world's YAML has them. top: of a table on legs, a box that no laser sees. middle: m, the
    place with the most room."""

    boxes: list[dict[str, Any]] = field(default_factory=list)
    cylinders: list[dict[str, Any]] = field(default_factory=list)
    top: list[dict[str, Any]] = field(default_factory=list)
    middle: tuple[float, float] = (0.0, 0.0)


def on_walls(room: Rectangle, gap: tuple[float, float, float]) -> bool:
    """Whether a door's middle lies on the room's outline."""
    x, y, _ = gap
    left, low, right, high = room
    inside_x, inside_y = left - 0.01 < x < right + 0.01, low - 0.01 < y < high + 0.01
    on_x, on_y = min(abs(x - left), abs(x - right)) < 0.01, min(abs(y - low), abs(y - high)) < 0.01
    return (inside_x and on_y) or (inside_y and on_x)


def furnished(room: Rectangle, gaps: list[tuple[float, float, float]], rng: np.random.Generator) -> Furniture:
    """Furniture for a room with these doors (x, y, width). What would close a way is left out.

    Rooms of one size with doors at the same places get the same from generators of the same state.
    """
    left, low, right, high = room
    w, h = right - left, high - low
    rows, columns = int(h / CELL), int(w / CELL)
    y, x = np.mgrid[:rows, :columns]
    x, y = left + (x + 0.5) * CELL, low + (y + 0.5) * CELL
    walls = (x < left + WALL) | (x > right - WALL) | (y < low + WALL) | (y > high - WALL)
    before = []  # each door
    for door_x, door_y, width in gaps:
        half, on_side = width / 2 + SIDE, min(abs(door_x - left), abs(door_x - right)) < 0.01
        deep, wide = (DEPTH, half) if on_side else (half, DEPTH)
        before.append((abs(x - door_x) < deep) & (abs(y - door_y) < wide))
    kept = np.logical_or.reduce(before)
    found, solid = Furniture(), walls.copy()
    for _ in range(3 + int(w * h / 3)):
        kind = rng.random()
        beside = kind < 0.55
        piece = _against(room, rng) if beside else _in_the_middle(room, rng, kind > 0.8)
        taken = _area(x, y, piece.boxes, piece.cylinders)
        claimed = taken | _area(x, y, piece.top, [])
        barred = kept | (solid & ~walls if beside else solid)
        if not (claimed & barred).any() and _passable(solid | taken, before, walls):
            solid |= taken
            found.boxes += piece.boxes
            found.cylinders += piece.cylinders
    room_left = distance_transform_edt(np.pad(~solid, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(room_left)), solid.shape)
    found.middle = float(x[row, column]), float(y[row, column])
    return found


def _area(x: Float64s, y: Float64s, boxes: list[dict[str, Any]], cylinders: list[dict[str, Any]]) -> Bools:
    """Which of the cells with middles x, y, both (h, w) m, these things reach into."""
    area = np.zeros(x.shape, bool)
    for box in boxes:
        (a, b), turn = box["size"], radians(box["yaw_deg"])
        dx, dy = x - box["x"], y - box["y"]
        along, across = cos(turn) * dx + sin(turn) * dy, cos(turn) * dy - sin(turn) * dx
        area |= (abs(along) <= a / 2 + CELL / 2) & (abs(across) <= b / 2 + CELL / 2)
    for disc in cylinders:
        area |= np.hypot(x - disc["x"], y - disc["y"]) <= disc["radius"] + CELL / 2
    return area


def _passable(solid: Bools, before: list[Bools], walls: Bools) -> bool:
    """Whether a disc of ROOM m still gets from every door to every other and over much of the floor."""
    clear = distance_transform_edt(np.pad(~solid, 1))[1:-1, 1:-1] * CELL > ROOM
    parts, n = label(clear)
    if not n:
        return False
    largest = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    covered = distance_transform_edt(~largest) * CELL <= ROOM
    meets = all((largest & door).any() for door in before)
    return bool(meets and covered.sum() >= PARTS * (~walls).sum())


def _against(room: Rectangle, rng: np.random.Generator) -> Furniture:
    """A desk with its chair, a shelf or a cabinet along a wall."""
    left, low, right, high = room
    deep, wide, chair = (
        (0.8, 1.6, True), (0.4, float(rng.uniform(0.6, 2.0)), False), (0.5, 0.9, False), (0.75, 1.4, True),
    )[int(rng.integers(4))]  # fmt: skip
    side, share, at_chair = int(rng.integers(4)), float(rng.uniform()), float(rng.uniform(-0.3, 0.3))
    flat = side < 2  # along the lower or the upper wall
    start, end = (left, right) if flat else (low, high)
    along = start + WALL + wide / 2 + share * max(end - start - wide - 2 * WALL, 0.0)
    sign = 1 if side in (0, 2) else -1
    wall = (low, high, left, right)[side]
    off, off_chair = wall + sign * (WALL + deep / 2), wall + sign * (WALL + deep + 0.3)
    place, size = ((along, off), [wide, deep]) if flat else ((off, along), [deep, wide])
    box = {"x": round(place[0], 3), "y": round(place[1], 3), "size": [round(s, 3) for s in size], "yaw_deg": 0.0}
    if not chair:
        return Furniture([box])
    x, y = (along + at_chair, off_chair) if flat else (off_chair, along + at_chair)
    return Furniture([box], [{"x": round(x, 3), "y": round(y, 3), "radius": 0.22, "loose": True}])


def _in_the_middle(room: Rectangle, rng: np.random.Generator, small: bool) -> Furniture:
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
