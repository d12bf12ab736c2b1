# SPDX-License-Identifier: Apache-2.0
"""Generates an office building from a number, as the tree of a world's YAML.

It has crossing corridors, rooms of all sizes, rows of equal rooms, doors, furniture and people. The same number gives
the same building.
"""

from dataclasses import dataclass
from itertools import combinations, pairwise
from math import ceil, copysign
from typing import Any

import numpy as np

from services.sim.furniture import Rectangle, furnish_room, on_walls
from shared.types import Float64s

CorridorLine = tuple[Float64s, float]  # a corridor's middle line, (2, 2) m, and half its width
Opening = tuple[float, float, float]  # x, y of a door's middle, its width, m

WIDTH, HEIGHT = (15.0, 40.0), (12.0, 25.0)  # m of the building, from the smallest to the largest
CORRIDOR = 1.7, 2.4  # m wide
BLOCK = 7.5, 13.0  # m between two corridors along the building; across it, rooms stand in up to two rows
MIN_ROOM_SIDE_M, MAX_ROOM_AREA_M2 = 2.7, 34.0  # a larger room is split further
DOOR = 0.9, 1.1  # m wide
JAMB = 0.3  # m that a door leaves to the next corner
ROW_SHARE = 0.5  # share of the blocks that are rows of equal rooms
OUTER, INNER = 0.3, 0.12  # m, thickness of walls


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangle between the middle lines of its walls. like: rooms of equal number get equal furniture; -1 none."""

    at: Rectangle
    corridor: bool = False
    like: int = -1


@dataclass(frozen=True, slots=True)
class SharedWall:
    """The piece of wall between two rooms, by their numbers: from (x, y) along x (or y), m."""

    a: int
    b: int
    x: float
    y: float
    along_x: bool
    length: float

    def point(self, along: float) -> tuple[float, float]:
        return (self.x + along, self.y) if self.along_x else (self.x, self.y + along)


def building(number: int, floor: int = 0) -> dict[str, Any]:
    """The tree of the world's YAML, with every value plain.

    floor: 0 is the ground floor; another one has the same walls, doors and people, with other furniture.
    """
    rng = np.random.default_rng([number, 7])
    width, height = (round(float(rng.uniform(*side)), 1) for side in (WIDTH, HEIGHT))
    rooms, lines = _rooms(width, height, rng)
    edges = _shared_walls(rooms)
    doors = _doors(rooms, edges, rng)
    gaps = [door for doors_here in doors.values() for door in doors_here]
    tree: dict[str, Any] = {
        "about": f"Building {number}, {width:g} x {height:g} m, {sum(not room.corridor for room in rooms)} rooms.",
        "bounds": [-OUTER, -OUTER, width + OUTER, height + OUTER],
        "walls": [_outer_wall(width, height), *_walls(edges, doors)],
        "boxes": [], "cylinders": [], "people": [], "goals": [],
    }  # fmt: skip
    tree["people"] = _people(lines, gaps, rng)
    tree["start"] = _start(lines, rng)
    openings = gaps + _corridor_openings(rooms)
    floors = [floor] if floor else []
    rng = np.random.default_rng([number, 9, floor]) if floor else rng
    for i, room in enumerate(rooms):
        here = [opening for opening in gaps if on_walls(room.at, opening)]
        if room.corridor:
            tree["boxes"] += _cabinets(room.at, openings, rng)
            continue
        taste = np.random.default_rng([number, 8, room.like, *floors]) if room.like >= 0 else rng
        furniture = furnish_room(room.at, here, taste)
        tree["boxes"] += furniture.boxes
        tree["cylinders"] += furniture.cylinders
        x, y = furniture.middle
        yaw = int(rng.integers(-180, 181))
        tree["goals"].append({"name": f"room {i}", "x": round(x, 2), "y": round(y, 2), "yaw_deg": yaw})
    return tree


def _rooms(width: float, height: float, rng: np.random.Generator) -> tuple[list[Room], list[CorridorLine]]:
    """The parts of the floor, corridors first, without gap or overlap; and the corridors' lines."""
    across = _strips(height, *((9.0, 14.0) if height < 17 else (7.0, 11.0)), rng)
    along = _strips(width, *BLOCK, rng)
    rooms, lines, blocks = [], [], []
    for low, high, corridor in across:
        if corridor:
            rooms.append(Room((0.0, low, width, high), True))
            y = (low + high) / 2
            lines.append((np.array([[0.8, y], [width - 0.8, y]]), (high - low) / 2))
    for left, right, corridor in along:
        for low, high, crossing in across:
            if crossing:
                continue
            if corridor:
                rooms.append(Room((left, low, right, high), True))
                x = (left + right) / 2
                y0, y1 = (0.8 if low == 0 else low - 0.85), (height - 0.8 if high == height else high + 0.85)
                lines.append((np.array([[x, y0], [x, y1]]), (right - left) / 2))
            else:
                blocks.append((left, low, right, high))
    for k, block in enumerate(blocks):
        if rng.random() < ROW_SHARE:
            rooms += _row(block, k, rng)
        else:
            rooms += [Room(at) for at in _split(block, rng)]
    return rooms, lines


def _strips(
    length: float, min_width: float, max_width: float, rng: np.random.Generator
) -> list[tuple[float, float, bool]]:
    """Blocks and the corridors between them, from 0 to length: low, high, whether it is a corridor; at least one is."""
    widths = rng.uniform(*CORRIDOR, 9)
    n = 1
    while (length - widths[:n].sum()) / (n + 1) > (min_width + max_width) / 2:
        n += 1
    shares = rng.uniform(0.75, 1.25, n + 1)
    blocks = shares / shares.sum() * (length - widths[:n].sum())
    ends = np.cumsum(np.column_stack((blocks, np.append(widths[:n], 0.0))).ravel()[:-1])
    ends = np.round(ends, 2)
    ends[-1] = length
    starts = np.concatenate(((0.0,), ends[:-1]))
    return [(float(a), float(b), bool(i % 2)) for i, (a, b) in enumerate(zip(starts, ends))]


def _row(block: Rectangle, like: int, rng: np.random.Generator) -> list[Room]:
    """Equal rooms side by side; in two rows, back to back, in a deep block."""
    left, low, right, high = block
    n = max(1, round((right - left) / float(rng.uniform(2.9, 4.0))))
    xs = np.round(np.linspace(left, right, n + 1), 2)
    ys = [low, high] if high - low < 6.5 else [low, round((low + high) / 2, 2), high]
    return [Room((x0, y0, x1, y1), like=like) for y0, y1 in pairwise(ys) for x0, x1 in pairwise(xs.tolist())]


def _split(block: Rectangle, rng: np.random.Generator) -> list[Rectangle]:
    """Splits a block recursively until its rooms are small enough."""
    left, low, right, high = block
    w, h = right - left, high - low
    if max(w, h) < 2 * MIN_ROOM_SIDE_M + 0.1 or (w * h < MAX_ROOM_AREA_M2 and rng.random() < 0.6) or w * h < 12:
        return [block]
    side = max(w, h)
    cut = round(float(rng.uniform(max(MIN_ROOM_SIDE_M, 0.3 * side), min(side - MIN_ROOM_SIDE_M, 0.7 * side))), 2)
    if w >= h:
        halves = (left, low, left + cut, high), (left + cut, low, right, high)
    else:
        halves = (left, low, right, low + cut), (left, low + cut, right, high)
    return [part for half in halves for part in _split(half, rng)]


def _shared_walls(rooms: list[Room]) -> list[SharedWall]:
    """The pieces of wall between rooms; two corridors have none."""
    shared = []
    for (i, a), (j, b) in combinations(enumerate(rooms), 2):
        if a.corridor and b.corridor:
            continue
        x0, x1 = max(a.at[0], b.at[0]), min(a.at[2], b.at[2])
        y0, y1 = max(a.at[1], b.at[1]), min(a.at[3], b.at[3])
        if abs(y1 - y0) < 1e-6 and x1 - x0 > 1e-6:
            shared.append(SharedWall(a=i, b=j, x=x0, y=y0, along_x=True, length=x1 - x0))
        elif abs(x1 - x0) < 1e-6 and y1 - y0 > 1e-6:
            shared.append(SharedWall(a=i, b=j, x=x0, y=y0, along_x=False, length=y1 - y0))
    return shared


def _corridor_openings(rooms: list[Room]) -> list[Opening]:
    """The crossings of corridors."""
    openings = []
    for a, b in combinations((room.at for room in rooms if room.corridor), 2):
        x0, x1, y0, y1 = max(a[0], b[0]), min(a[2], b[2]), max(a[1], b[1]), min(a[3], b[3])
        if x1 >= x0 and y1 >= y0:
            openings.append(((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0 + y1 - y0))
    return openings


def _doors(rooms: list[Room], edges: list[SharedWall], rng: np.random.Generator) -> dict[SharedWall, list[Opening]]:
    """Doors such that every room can be reached, most from a corridor, some from two sides: loops."""
    doors: dict[SharedWall, list[Opening]] = {}
    reached = {i for i, room in enumerate(rooms) if room.corridor}
    share = {room.like: float(np.random.default_rng(room.like + 1).uniform()) for room in rooms}

    def door(edge: SharedWall) -> None:
        width = round(float(rng.uniform(*DOOR)), 2)
        near, far = JAMB + width / 2, edge.length - JAMB - width / 2
        like = rooms[edge.b].like if rooms[edge.a].corridor else -1
        along = near + (far - near) * (share[like] if like >= 0 else float(rng.uniform()))
        x, y = edge.point(along)
        doors.setdefault(edge, []).append((round(x, 3), round(y, 3), width))

    wide = [edge for edge in edges if edge.length > DOOR[1] + 2 * JAMB]
    for edge in wide:  # corridors come first: edge.a
        if rooms[edge.a].corridor and edge.b not in reached:
            reached.add(edge.b)
            door(edge)
    while len(reached) < len(rooms):
        connecting = [edge for edge in wide if (edge.a in reached) != (edge.b in reached)]
        if not connecting:
            raise ValueError("a room shares no wall that is long enough for a door")
        edge = connecting[int(rng.integers(len(connecting)))]
        reached |= {edge.a, edge.b}
        door(edge)
    for edge in wide:
        if edge not in doors and rng.random() < (0.3 if rooms[edge.a].corridor else 0.12):
            door(edge)
    return doors


def _outer_wall(width: float, height: float) -> dict[str, Any]:
    """The outer wall: its inner face is the floor's edge."""
    low, right, high = -OUTER / 2, width + OUTER / 2, height + OUTER / 2
    return {"points": [[low, low], [right, low], [right, high], [low, high]], "closed": True, "thickness": OUTER}


def _walls(edges: list[SharedWall], doors: dict[SharedWall, list[Opening]]) -> list[dict[str, Any]]:
    return [
        {
            "points": [list(edge.point(0.0)), list(edge.point(edge.length))],
            "thickness": INNER,
            "doors": [{"at": [x, y], "width": width} for x, y, width in doors.get(edge, [])],
        }
        for edge in edges
    ]


def _people(lines: list[CorridorLine], gaps: list[Opening], rng: np.random.Generator) -> list[dict[str, Any]]:
    """One to three people, each along a corridor and back, with a step into one of its doors, if it has any."""
    people = []
    for i in rng.permutation(len(lines))[: int(rng.integers(1, 4))].tolist():
        line, half = lines[i]
        (x0, y0), (x1, y1) = line.tolist()
        flat = y0 == y1
        route = [[x0, y0], [x1, y1]]
        beside = [(x, y) for x, y, _ in gaps if abs((abs(y - y0) if flat else abs(x - x0)) - half) < 0.02]
        beside = [(x, y) for x, y in beside if (x0 < x < x1 if flat else y0 < y < y1)]
        if beside:
            x, y = beside[int(rng.integers(len(beside)))]
            into = copysign(0.45, y - y0 if flat else x - x0)
            here, there = ([x, y0], [x, y + into]) if flat else ([x0, y], [x + into, y])
            route[1:1] = [here, there, here]
        speed, pause = float(rng.uniform(0.7, 1.2)), float(rng.uniform(1, 4))
        people.append({"route": route, "speed": round(speed, 2), "pause": round(pause, 1)})
    return people


def _start(lines: list[CorridorLine], rng: np.random.Generator) -> dict[str, float]:
    """A random pose on a corridor's middle line."""
    (a, b), _ = lines[int(rng.integers(len(lines)))]
    x, y = a + float(rng.uniform(0.05, 0.95)) * (b - a)
    return {"x": round(float(x), 2), "y": round(float(y), 2), "yaw_deg": float(rng.integers(-180, 181))}


def _cabinets(corridor: Rectangle, openings: list[Opening], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Flat things along a corridor's walls, away from doors and crossings; its middle stays free."""
    left, low, right, high = corridor
    flat = right - left > high - low
    length, width = (right - left, high - low) if flat else (high - low, right - left)
    cabinets = []
    for _ in range(ceil(length / 6)):
        size, depth = float(rng.uniform(0.4, 1.2)), float(rng.uniform(0.2, min(0.4, width / 2 - 0.65)))
        along = float(rng.uniform(size / 2 + 0.3, length - size / 2 - 0.3))
        off = width - INNER / 2 - depth / 2 if rng.integers(2) else INNER / 2 + depth / 2
        x, y = (left + along, low + off) if flat else (left + off, low + along)
        if all(abs(x - at) + abs(y - to) > size / 2 + wide + 0.8 for at, to, wide in openings):
            box = [size, depth] if flat else [depth, size]
            cabinets.append({"x": round(x, 3), "y": round(y, 3), "size": [round(box[0], 3), round(box[1], 3)]})
    return cabinets
