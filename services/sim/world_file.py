# SPDX-License-Identifier: Apache-2.0
"""Format of a world's YAML: walls with doors, boxes, cylinders, polygons, people, goals; and its World."""

from itertools import pairwise
from math import hypot, pi, radians

import numpy as np
from pydantic import Field, model_validator

from services.sim.contact import disc_touches_world
from services.sim.world import Pedestrian, Raster, World
from shared.config import RobotFile, Section, UserError
from shared.geometry import Pose2
from shared.types import Float64s

Point = tuple[float, float]

MAX_SIDE_M = 5_000.0  # of a world's bounds
TURN_JITTER = 2.0  # rad a metre of jitter: 0.1 m also turns a chair by up to 0.2 rad


class Door(Section):
    """A gap in a wall."""

    at: Point = Field(description="m, the middle of the gap; a point on the wall")
    width: float = Field(0.95, gt=0, le=20, description="m")


class Wall(Section):
    """A wall along a line of points."""

    points: tuple[Point, ...] = Field(min_length=2, description="m, corners of the wall's middle line")
    thickness: float = Field(0.1, gt=0, le=5, description="m")
    closed: bool = Field(False, description="whether the last point is joined to the first")
    doors: tuple[Door, ...] = Field((), description="gaps")


class Box(Section):
    """A solid rectangle."""

    x: float = Field(description="m, its middle")
    y: float = Field(description="m, its middle")
    size: Point = Field(description="m, along and across")
    yaw_deg: float = Field(0.0, ge=-360, le=360, description="degrees, counter-clockwise")
    loose: bool = Field(False, description="whether it stands somewhere else by `sim.clutter_jitter` in each seed")

    @model_validator(mode="after")
    def _extended(self) -> "Box":
        if min(self.size) <= 0:
            raise ValueError("size: both sides are over 0")
        return self


class Cylinder(Section):
    """A solid disc."""

    x: float = Field(description="m, its middle")
    y: float = Field(description="m, its middle")
    radius: float = Field(gt=0, le=50, description="m")
    loose: bool = Field(False, description="whether it stands somewhere else by `sim.clutter_jitter` in each seed")


class Polygon(Section):
    """A shape of any form."""

    points: tuple[Point, ...] = Field(min_length=3, description="m, corners in order; sides may not cross")


class Person(Section):
    """A person that walks along a route."""

    route: tuple[Point, ...] = Field(min_length=1, description="m, waypoints, free of walls by the person's radius")
    loop: bool = Field(False, description="whether the last waypoint leads to the first; else the way goes back")
    speed: float = Field(1.0, gt=0, le=3, description="m/s")
    pause: float = Field(2.0, ge=0, le=600, description="s at each waypoint, on average")
    radius: float = Field(0.25, gt=0, le=1, description="m")


class WorldPose(Section):
    """A pose in the world: the robot's start."""

    x: float = Field(description="m")
    y: float = Field(description="m")
    yaw_deg: float = Field(0.0, ge=-360, le=360, description="degrees, counter-clockwise")

    @property
    def pose(self) -> Pose2:
        return Pose2(self.x, self.y, radians(self.yaw_deg))


class WorldGoal(WorldPose):
    """A goal."""

    name: str = Field(min_length=1, description="unique")


class WorldFile(Section):
    """A world's YAML."""

    about: str = Field("", description="what it is, for people")
    bounds: tuple[float, float, float, float] | None = Field(
        None, description="m: low x, low y, high x, high y; without it: the box around everything"
    )
    map: str | None = Field(None, description="path of a ROS map's YAML, from this file's folder; its cells are solid")
    start: WorldPose | None = Field(None, description="where the robot starts; without it: the freest place")
    walls: tuple[Wall, ...] = Field((), description="walls")
    boxes: tuple[Box, ...] = Field((), description="rectangles")
    cylinders: tuple[Cylinder, ...] = Field((), description="discs")
    polygons: tuple[Polygon, ...] = Field((), description="other shapes")
    people: tuple[Person, ...] = Field((), description="walking people")
    cliffs: tuple[Polygon, ...] = Field((), description="regions without floor, that only cliff sensors see")
    goals: tuple[WorldGoal, ...] = Field((), description="places to send the robot to")

    @model_validator(mode="after")
    def _is_extended(self) -> "WorldFile":
        if self.bounds is not None and not (self.bounds[0] < self.bounds[2] and self.bounds[1] < self.bounds[3]):
            raise ValueError("bounds: low x, low y, high x, high y: each low one is below its high one")
        return self


def build_world(name: str, file: RobotFile, raster: Raster | None, seed: int, jitter: float) -> World:
    """The world of a file; loose things move by up to `jitter` m, by the seed, if routes and places stay free.

    Raises UserError with file and line where doors miss their wall, people walk through things, or goals share a name.
    """
    world = file.whole(WorldFile)
    fixed = [p for i, wall in enumerate(world.walls) for p in _wall(wall, file, i)]
    fixed += [np.array(p.points, float) for p in world.polygons]
    rng = np.random.default_rng([seed, 1])
    keep = _free_lines(world)
    boxes = [rectangle(*_jittered_pose(b, max(b.size) / 2 + jitter, keep, rng, jitter), b.size) for b in world.boxes]
    discs = [(*_jittered_pose(c, c.radius, keep, rng, jitter)[:2], c.radius) for c in world.cylinders]
    circles = np.array(discs, float).reshape(-1, 3)
    polygons = (*fixed, *boxes)
    goals = {g.name: g.pose for g in world.goals}
    if len(goals) < len(world.goals):
        names = [g.name for g in world.goals]
        i = next(i for i, n in enumerate(names) if n in names[:i])
        raise UserError(f"{file.place(('goals', i))}: a second goal {names[i]!r}", "give each goal its own name")
    whole = World(
        name=name,
        bounds=world.bounds or _bounds(polygons, circles, raster, world.start),
        start=world.start.pose if world.start else Pose2(),
        polygons=polygons,
        circles=circles,
        raster=raster,
        people=tuple(_walk(p) for p in world.people),
        cliffs=tuple(np.array(c.points, float) for c in world.cliffs),
        goals=goals,
    )
    low_x, low_y, high_x, high_y = whole.bounds
    if not max(high_x - low_x, high_y - low_y) <= MAX_SIDE_M:
        size = f"{high_x - low_x:.0f} x {high_y - low_y:.0f} m"
        raise UserError(f"{file.path}: the world has {size}, the limit is {MAX_SIDE_M:.0f} m", "coordinates are in m")
    _check_routes(whole, world, file)
    return whole


def rectangle(x: float, y: float, yaw: float, size: Point) -> Float64s:
    """Corners (4, 2) of a rectangle, counter-clockwise."""
    x1, y1 = size[0] / 2, size[1] / 2
    return Pose2(x, y, yaw) @ np.array([[-x1, -y1], [x1, -y1], [x1, y1], [-x1, y1]])


def _wall(wall: Wall, file: RobotFile, i: int) -> list[Float64s]:
    """A wall as rectangles: one a stretch between corners and doors, as long as the corners are square."""
    points = [*wall.points, wall.points[0]] if wall.closed else list(wall.points)
    gaps: list[list[tuple[float, float]]] = [[] for _ in points[1:]]
    for k, door in enumerate(wall.doors):
        for leg, (a, b) in enumerate(pairwise(points)):
            length = hypot(b[0] - a[0], b[1] - a[1])
            along = ((door.at[0] - a[0]) * (b[0] - a[0]) + (door.at[1] - a[1]) * (b[1] - a[1])) / max(length, 1e-9)
            across = ((door.at[0] - a[0]) * (b[1] - a[1]) - (door.at[1] - a[1]) * (b[0] - a[0])) / max(length, 1e-9)
            if abs(across) <= wall.thickness and door.width / 2 <= along <= length - door.width / 2:
                gaps[leg].append((along - door.width / 2, along + door.width / 2))
                break
        else:
            raise UserError(
                f"{file.place(('walls', i, 'doors', k))}: the door at {door.at} is not on a straight part of its wall",
                "`at` is a point on the wall's middle line, at least half the width from its corners",
            )
    out = []
    for (a, b), holes in zip(pairwise(points), gaps):
        length = hypot(b[0] - a[0], b[1] - a[1])
        if length == 0:
            continue
        ux, uy = (b[0] - a[0]) / length, (b[1] - a[1]) / length
        stops = [-wall.thickness / 2, *(s for hole in sorted(holes) for s in hole), length + wall.thickness / 2]
        for begin, end in zip(stops[::2], stops[1::2]):
            if end > begin:
                middle = (begin + end) / 2
                out.append(
                    rectangle(a[0] + middle * ux, a[1] + middle * uy, np.arctan2(uy, ux), (end - begin, wall.thickness))
                )
    return out


def _free_lines(world: WorldFile) -> list[tuple[Float64s, float]]:
    """What loose things must leave free: lines (k, 2) and the clearance about each, m."""
    keep = [(np.array([*p.route, p.route[0]] if p.loop else p.route, float), p.radius + 0.02) for p in world.people]
    places = [*world.goals, *([world.start] if world.start else [])]
    return keep + [(np.array([[p.x, p.y]]), 0.5) for p in places]


def _jittered_pose(
    thing: Box | Cylinder, reach: float, keep: list[tuple[Float64s, float]], rng: np.random.Generator, jitter: float
) -> tuple[float, float, float]:
    """Where a thing stands in this seed: x, y, yaw. A draw that could block a kept line is not taken."""
    yaw = radians(thing.yaw_deg) if isinstance(thing, Box) else 0.0
    dx, dy, turn = rng.uniform(-1, 1, 3) * (jitter, jitter, TURN_JITTER * jitter)
    if not thing.loose:
        return thing.x, thing.y, yaw
    here, there = np.array([thing.x, thing.y]), np.array([thing.x + dx, thing.y + dy])
    for line, clearance in keep:
        if _distance(line, there) < clearance + reach and _distance(line, there) < _distance(line, here):
            return thing.x, thing.y, yaw
    return float(there[0]), float(there[1]), (yaw + turn + pi) % (2 * pi) - pi


def _distance(line: Float64s, point: Float64s) -> float:
    """Metres from a point to a line of points (k, 2)."""
    a, b = line, line[1:] if len(line) > 1 else line
    a = a[: len(b)]
    along = b - a
    share = np.clip(np.sum((point - a) * along, axis=1) / np.maximum(np.sum(along**2, axis=1), 1e-12), 0, 1)
    return float(np.min(np.hypot(*(a + share[:, None] * along - point).T)))


def _walk(person: Person) -> Pedestrian:
    route = np.array(person.route, float)
    if not person.loop:
        route = np.concatenate((route, route[-2:0:-1]))
    return Pedestrian(route, person.speed, person.pause, person.radius)


def _check_routes(world: World, source: WorldFile, file: RobotFile) -> None:
    """Raises UserError where a person's way touches what stands still."""
    for i, person in enumerate(source.people):
        route = world.people[i].route
        for k, (a, b) in enumerate(zip(route, np.roll(route, -1, axis=0))):
            n = max(2, int(np.hypot(*(b - a)) / 0.02) + 1)
            points = np.linspace(a, b, n)
            for (x, y), solid in zip(points, world.solid_at(points)):
                if solid or disc_touches_world(x, y, person.radius, world.cells):
                    leg = min(k, len(person.route) - 1)
                    raise UserError(
                        f"{file.place(('people', i, 'route', leg))}: the way from ({a[0]:g}, {a[1]:g}) to ({b[0]:g}, "
                        f"{b[1]:g}) runs into something at ({x:.2f}, {y:.2f})",
                        f"keep {person.radius:g} m of every way free; add waypoints around the obstacle",
                    )


def _bounds(
    polygons: tuple[Float64s, ...], circles: Float64s, raster: Raster | None, start: WorldPose | None
) -> tuple[float, float, float, float]:
    """The box around everything; 5 m about the start where there is nothing."""
    corners = [*polygons, circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]]
    if raster is not None:
        corners.append(np.array(raster.bounds).reshape(2, 2))
    points = np.concatenate(corners)
    if not len(points):
        x, y = (start.x, start.y) if start else (0.0, 0.0)
        return x - 5, y - 5, x + 5, y + 5
    (low_x, low_y), (high_x, high_y) = points.min(axis=0), points.max(axis=0)
    return float(low_x), float(low_y), float(high_x), float(high_y)
