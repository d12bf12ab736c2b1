# SPDX-License-Identifier: Apache-2.0
"""What a robot publishes for the others, and where the paths of two robots exclude each other.

Two points exclude each other where the robots would touch. In a wide passage that counts only for what a robot holds:
the other one waits, and is driven around. In a narrow one no robot may wait on the path of another. Where two face each
other, one drives around the other, which waits: two that swerve at once may choose the same side. Both robots find the
same points from the same two messages, so no segments of the map have to agree.
"""

from dataclasses import dataclass, field

import numpy as np

from shared.types import Bools, Float64s

NO_PATH: Float64s = np.zeros((0, 2))
NEARER_M = 0.05  # by which a point must be nearer than the robot is now: one that is too near may get away


@dataclass(frozen=True, slots=True)
class Clearances:
    """m between the outlines of two robots."""

    beside: float  # that their paths keep
    passing: float  # to both sides and between them, where they pass each other


@dataclass(frozen=True, slots=True)
class TrafficRobot:
    """One robot: place and radius (m, in `map`), its path (n, 2) with passage widths (n,), and what it holds of it.

    order: of two robots the one with the lower order goes first.  claim: number of its newest wish.
    heard: newest claim of each robot that it hears.  waits_for: robots that keep it from its wish.
    stuck: it cannot make way.
    """

    name: str
    x: float
    y: float
    radius: float
    order: tuple[int, int, int, str]
    path: Float64s = field(default_factory=lambda: NO_PATH)
    widths: Float64s = field(default_factory=lambda: np.zeros(0))
    held: int = 0
    wanted: int = 0
    claim: int = 0
    heard: dict[str, int] = field(default_factory=dict)
    waits_for: tuple[str, ...] = ()
    stuck: bool = False

    @property
    def place(self) -> Float64s:
        """(1, 2) m."""
        return np.array([[self.x, self.y]])


def order_of(name: str, priority: int, since: int, gives_way: bool) -> tuple[int, int, int, str]:
    """The total order of the robots: those that make way first, then priority, then the older task, then the name.

    since: ns of the task's begin, by the robot's own clock. Every robot compares the same numbers.
    """
    return (0 if gives_way else 1, -priority, since, name)


@dataclass(frozen=True, slots=True)
class Exclusions:
    """Where the paths of this robot (n points) and of another one (m) exclude each other.

    near: (n, m) bool, the robots would touch.  narrow: (n, m) bool, and they cannot pass each other there.
    place: (n,) bool, the other robot stands there, and it is narrow.  own_place: (m,) bool, the same for this robot on
    the other's path.  facing: (n, m) bool, each of two robots is in the other's way where it is wide. One drives around
    the other one, which does not come nearer meanwhile.
    """

    near: Bools
    narrow: Bools
    place: Bools
    own_place: Bools
    facing: Bools

    @property
    def on_path(self) -> Bools:
        """(n,) bool: points at which this robot must not wait."""
        return np.asarray(self.narrow.any(axis=1) | self.place)

    @property
    def contested(self) -> Bools:
        """(n,) bool: points that the other robot may ask for, too."""
        return np.asarray(self.near.any(axis=1) | self.place | self.facing.any(axis=1))


def exclusions(me: TrafficRobot, other: TrafficRobot, clearances: Clearances) -> Exclusions:
    """How two robots exclude each other on their paths."""
    passing = passing_width(me, other, clearances)
    near = _too_near(me, other, other.path, clearances)
    over_other, over_me = near_place(me, other, clearances), near_place(other, me, clearances)
    place, own_place = over_other & (me.widths < passing), over_me & (other.widths < passing)
    is_wide = not (place.any() or own_place.any())
    towards = over_other | _shifted(over_other, 1) | _shifted(over_other, 2)  # and the two points before
    return Exclusions(
        near=near,
        narrow=near & (np.minimum(me.widths[:, None], other.widths[None, :]) < passing),
        place=place,
        own_place=own_place,
        facing=towards[:, None] & over_me & is_wide,
    )


def _shifted(mask: Bools, n: int) -> Bools:
    """The mask, n points nearer to the robot."""
    return np.concatenate((mask[n:], np.zeros(min(n, len(mask)), bool)))


def near_place(me: TrafficRobot, other: TrafficRobot, clearances: Clearances) -> Bools:
    """(n,) bool: points of my path at which I would touch the other robot where it is."""
    return np.asarray(_too_near(me, other, other.place, clearances)[:, 0])


def passing_width(me: TrafficRobot, other: TrafficRobot, clearances: Clearances) -> float:
    """m of passage in which the two pass each other."""
    return 2.0 * (me.radius + other.radius) + 3.0 * clearances.passing


def reach_of(me: TrafficRobot, other: TrafficRobot, clearances: Clearances) -> float:
    """m between their places at which they exclude each other."""
    return me.radius + other.radius + clearances.beside


def _too_near(me: TrafficRobot, other: TrafficRobot, points: Float64s, clearances: Clearances) -> Bools:
    """(n, m) bool: pairs of a point of my path and another point that are too near, and nearer than I am now."""
    if not len(points) or not len(me.path):
        return np.zeros((len(me.path), len(points)), bool)
    reach = reach_of(me, other, clearances)
    before = me.path.max(axis=0) + reach < points.min(axis=0)
    behind = me.path.min(axis=0) - reach > points.max(axis=0)
    if (before | behind).any():
        return np.zeros((len(me.path), len(points)), bool)
    apart = np.hypot(me.path[:, None, 0] - points[None, :, 0], me.path[:, None, 1] - points[None, :, 1])
    now = np.hypot(me.x - points[:, 0], me.y - points[:, 1]) - NEARER_M
    return np.asarray(apart < np.minimum(reach, np.maximum(now, 0.0))[None, :])
