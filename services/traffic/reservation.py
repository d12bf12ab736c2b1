# SPDX-License-Identifier: Apache-2.0
"""Which part of its path a robot holds. It drives only there.

A robot takes its path in pieces. Each piece ends at a waiting place: a point that excludes no point of the path of any
other robot. It takes a piece only as a whole, and only where

1. no other robot holds a point that excludes one of the piece,
2. no robot before it in the order wants one, and
3. every robot whose path excludes one has answered this claim, and each one its newest path.

What is behind the robot is free again. So a robot that moves can always drive on to a place where it hinders no other.
The first robot in the order always gets its next piece (docs/decisions.md has the argument).

In a wide passage a piece may lead past a robot that stands there. Where this robot finds no way around it, it gives its
piece back and asks for nothing for a while. So the robots that stand in its way can drive.

Mutual exclusion by a total order and answers is that of Ricart and Agrawala 1981, with the answers in the messages that
are sent anyway. The pieces up to a safe place are those of Reveliotis 2000 for guided vehicles. The waiting places are
those of well-formed infrastructures (Cap, Novak, Kleiner, Selecky 2015).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.traffic.conflicts import NO_PATH, Clearances, Exclusions, TrafficRobot, exclusions, near_place
from services.traffic.passages import SPACING_M
from shared.types import NS_PER_S, Bools, Float64s

MAX_POINTS = 120  # of the path that the others hear: 36 m
WANTED_AHEAD = 7  # points behind the piece that it wants: the second robot stops so much earlier, and is driven around
BESIDE = 2  # points next to a robot that others may pass where it is wide: it may stand there
MAX_ADVANCE = 12  # points within which the robot is looked for
SAME_PATH_M = 0.02  # between the points of a path and of the rest of the one before
KEPT_M = 0.2  # from the held points within which a new path continues on what the robot holds
MAX_CLAIMS = 24  # that are remembered until they are answered
DEAF_NS = 3 * NS_PER_S
"""ns after which an answer is not waited for any more: the other one does not hear this robot."""
COMES_ON_M = 0.3  # in STALL_NS, or a robot that holds a piece stalls
STALL_NS = 4 * NS_PER_S
REST_NS = 3 * NS_PER_S
"""ns for which a robot that gave its piece back asks for nothing, at most: the others take theirs."""


@dataclass(frozen=True, slots=True)
class _Claim:
    """A wish: its number, the end of the points that it asks for, and when it was made, ns."""

    number: int
    end: int
    at: int


class Reservation:
    """The path of this robot, how much of it it holds and wants, and which robots it waits for."""

    def __init__(self, name: str, radius: float, clearances: Clearances, reach: float) -> None:
        """reach: m ahead that the robot wants to hold, at least."""
        self.name, self.radius, self.clearances = name, radius, clearances
        self.reach = max(1, round(reach / SPACING_M))
        self.path: Float64s = NO_PATH
        self.widths: Float64s = np.zeros(0)
        self.at = 0  # index of the point beside the robot
        self.held_end = self.wanted_end = 0  # indices behind the last held and wanted point
        self.number = 0  # of the newest claim
        self.waits_for: tuple[str, ...] = ()
        self.deaf: tuple[str, ...] = ()  # robots that do not answer
        self._unanswered: set[str] = set()  # robots whose answer is missing
        self._path_claim = _Claim(0, 0, 0)
        self._claims: list[_Claim] = []
        self._came_on = 0.0, 0.0, 0  # m, m, ns: where and when it was last found to come on, or to hold nothing
        self._rests_since: int | None = None  # ns

    def set_path(self, path: Float64s, widths: Float64s, x: float, y: float, now: int) -> bool:
        """Takes a path (n, 2) m in `map` at SPACING_M from its end, with widths (n,). x, y: of the robot.  now: ns.

        Returns whether it is another one. What the robot holds of the one before it goes on holding on a new one, as
        far as that runs along it.
        """
        n = len(path)
        if 0 < n <= len(self.path) and np.abs(self.path[-n:] - path).max() <= SAME_PATH_M:
            self.widths[-n:] = widths
            return False
        kept = np.concatenate((self.path[self.at : self.held_end], [[x, y]]))
        apart = np.hypot(path[:, None, 0] - kept[:, 0], path[:, None, 1] - kept[:, 1]).min(axis=1)
        beyond = np.flatnonzero(apart > KEPT_M) if n else np.zeros(0, np.int64)
        self.path, self.widths, self.at = path, widths.copy(), 0
        self.held_end = self.wanted_end = max(int(beyond[0]) if len(beyond) else n, min(n, 1))
        self._count(now)
        self._path_claim, self._claims = _Claim(self.number, 0, now), []
        return True

    def move(self, x: float, y: float) -> None:
        """Takes the robot's place, m in `map`: the points behind it are free again."""
        near = self.path[self.at : self.at + MAX_ADVANCE]
        if len(near):
            self.at += int(np.argmin((near[:, 0] - x) ** 2 + (near[:, 1] - y) ** 2))
            self.held_end = max(self.held_end, self.at + 1)

    @property
    def ahead(self) -> Float64s:
        """(n, 2) m: the path from the robot on, as far as the others hear it."""
        return self.path[self.at : self.at + MAX_POINTS]

    @property
    def held(self) -> int:
        """Points of `ahead` that it holds."""
        return min(self.held_end - self.at, len(self.ahead))

    @property
    def whole(self) -> bool:
        """Whether it holds its path to the end."""
        return self.held_end >= len(self.path)

    def told(self, x: float, y: float, order: tuple[int, int, int, str]) -> TrafficRobot:
        """This robot as the others hear of it, but for what it hears. x, y: m in `map`."""
        return TrafficRobot(
            name=self.name,
            x=x,
            y=y,
            radius=self.radius,
            order=order,
            path=self.ahead,
            widths=self.widths[self.at : self.at + MAX_POINTS],
            held=self.held,
            wanted=max(self.held, min(self.wanted_end - self.at, len(self.ahead))),
            claim=self.number,
            waits_for=self.waits_for,
        )

    def update(
        self, x: float, y: float, order: tuple[int, int, int, str], others: Sequence[TrafficRobot], now: int
    ) -> None:
        """Takes the next piece of the path, as far as the others allow it. now: ns."""
        me = self.told(x, y, order)
        n = len(me.path)
        self.waits_for, self.deaf, self._unanswered = (), (), set()
        if not n:
            self.held_end = self.wanted_end = self.at
            return
        if self._rests(me, others, now):
            return
        pairs = [exclusions(me, other, self.clearances) for other in others]
        on_path = _union([pair.on_path for pair in pairs], n)
        contests = [pair.contested for pair in pairs]
        hinders = [_hindered(me, other, pair) for other, pair in zip(others, pairs, strict=True)]
        waiting = ~on_path
        waiting[n - 1] |= self.at + n == len(self.path)
        target = _first(waiting, min(self.reach, n - 1), n - 1)
        self._want(min(self.at + target + 1 + WANTED_AHEAD, len(self.path)), now)
        held = self.held
        self.waits_for = tuple(
            other.name for other, hindered in zip(others, hinders, strict=True) if hindered[held : target + 1].any()
        )
        end = min(target + 1, _first(_union(hinders, n), held, n))
        contesting = [other for other, mask in zip(others, contests, strict=True) if mask[held:end].any()]
        answered = self._answered_end(contesting, now) - self.at
        end = min(end, max(_first(_union(contests, n), held, n), answered))
        if not self._knows_path(others, now):
            return
        places_left = np.flatnonzero(waiting[held:end])
        if len(places_left):
            self.held_end = self.at + held + int(places_left[-1]) + 1

    def _rests(self, me: TrafficRobot, others: Sequence[TrafficRobot], now: int) -> bool:
        """Whether this robot asks for nothing now. When that begins it gives back what it holds. now: ns."""
        if self._rests_since is None:
            x, y, since = self._came_on
            if me.held <= 1 or np.hypot(me.x - x, me.y - y) > COMES_ON_M or now < since:
                self._came_on = me.x, me.y, now
            if now - self._came_on[2] < STALL_NS:
                return False
        before = [other for other in others if near_place(me, other, self.clearances)[: self.reach + 1].any()]
        if not before or (self._rests_since is not None and not 0 <= now - self._rests_since < REST_NS):
            self._rests_since, self._came_on = None, (me.x, me.y, now)
            return False
        if self._rests_since is None:
            self._rests_since, self._claims = now, []
        self.held_end = self.at + 1
        self._want(self.held_end, now)
        self.waits_for = tuple(other.name for other in before)
        return True

    def _count(self, now: int) -> None:
        """Numbers from the clock, ms, are larger than those before a restart, which the others have answered."""
        self.number = max(self.number + 1, now // 1_000_000)

    def _want(self, end: int, now: int) -> None:
        if end != self.wanted_end or not self._claims:
            self.wanted_end = end
            self._count(now)
            self._claims = [*self._claims[1 - MAX_CLAIMS :], _Claim(self.number, end, now)]

    def _answered_end(self, contesting: Sequence[TrafficRobot], now: int) -> int:
        """The end of the largest claim that all of them have answered."""
        return max((c.end for c in self._claims if self._is_answered(c, contesting, now)), default=0)

    def _knows_path(self, others: Sequence[TrafficRobot], now: int) -> bool:
        """Whether every other robot has heard this path."""
        return self._is_answered(self._path_claim, others, now)

    def _is_answered(self, claim: _Claim, others: Sequence[TrafficRobot], now: int) -> bool:
        missing = tuple(other.name for other in others if other.heard.get(self.name, -1) < claim.number)
        if missing and not 0 <= now - claim.at < DEAF_NS:
            self.deaf = tuple(dict.fromkeys((*self.deaf, *missing)))
            return True
        self._unanswered.update(missing)
        return not missing

    def is_answered_by(self, robot: str, heard: dict[str, int]) -> bool:
        """Whether a robot's message has the answer to the newest claim, and that was missing. heard: by that robot."""
        return robot in self._unanswered and heard.get(self.name, -1) >= self.number


def _hindered(me: TrafficRobot, other: TrafficRobot, pair: Exclusions) -> Bools:
    """(n,) bool: points that this robot may not take now because of another one.

    What a robot before this one wants counts only as far as it gets there before this robot has left its way.
    """
    held = pair.narrow[:, : other.held].any(axis=1) | pair.near[:, BESIDE : other.held].any(axis=1) | pair.place
    held |= pair.facing[:, BESIDE : other.held].any(axis=1)
    if other.order > me.order:
        return np.asarray(held)
    held |= pair.facing[:, BESIDE : other.wanted].any(axis=1)  # it drives around this robot
    mine = pair.own_place | pair.narrow[: me.held].any(axis=0) | pair.near[BESIDE : me.held].any(axis=0)
    wanted = min(other.wanted, _first(mine, 0, other.wanted))
    return np.asarray(held | pair.near[:, BESIDE:wanted].any(axis=1) | pair.narrow[:, :wanted].any(axis=1))


def _union(masks: Sequence[Bools], n: int) -> Bools:
    """(n,) bool: what any of them has."""
    return np.any(masks, axis=0) if len(masks) else np.zeros(n, bool)


def _first(mask: Bools, begin: int, default: int) -> int:
    """The first index from `begin` on at which the mask is set."""
    found = np.flatnonzero(mask[begin:])
    return begin + int(found[0]) if len(found) else default
