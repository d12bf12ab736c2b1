# SPDX-License-Identifier: Apache-2.0
"""Exploring with other robots: each one leaves the frontiers to the robot whose tour reaches them first.

Every robot sends the others its position, its map, its frontiers and the one that it drives to. All decide by the same
rule, and there is no central process. Frontiers are dealt out one by one. The next one goes to the
robot that reaches it first, after those that this robot has (list scheduling, Graham 1969). Burgard et al., T-RO 2005,
share frontiers by travel cost too, one to each robot. A robot that falls silent loses its frontiers after a lease.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, inf

import numpy as np
from pydantic import Field

from services.navigator.frontiers import Frontier, Frontiers
from services.navigator.others_map import OthersMap, PackedMap, packed_map
from shared.config import Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import ExplorationShare, MapUpdate
from shared.types import Float32s, Float64s, Int8s, Int64s

_DETOUR = 1.4  # m of driving per m of straight line, where no path is known
_KEEP_M = 1.0  # m by which another robot must be nearer to take a frontier that is driven to
_CLOSED_M = 0.2  # between the places of a border at which the robot saw no more, in a message
_MAX_FRONTIERS = 100  # in a message, the nearest

Point = tuple[float, float]


class SharingConfig(Section):
    """Exploring with other robots."""

    lease: float = Field(
        5.0, ge=0.5, le=120, description="s without a message of another robot until its frontiers are released"
    )
    period: float = Field(0.5, ge=0.1, le=10, description="s between two messages to the others")
    same_frontier: float = Field(
        1.5, ge=0.1, le=10, description="m between the frontiers of two maps that count as one"
    )


@dataclass(frozen=True, slots=True)
class Teammate:
    """The newest message of another robot, with when it arrived, ns."""

    share: ExplorationShare
    arrived: int

    def point(self, map_from_common: Pose2) -> Point:
        """Where it is, m in the own `map`."""
        pose = map_from_common @ Pose2(self.share.x, self.share.y)
        return pose.x, pose.y

    def frontiers(self, map_from_common: Pose2) -> Float64s:
        """(n, 2) m in the own `map`."""
        return _moved(map_from_common, self.share.frontier_xs, self.share.frontier_ys)

    def closed(self, map_from_common: Pose2) -> Float64s:
        """(n, 2) m in the own `map`: borders at which it saw no more."""
        return _moved(map_from_common, self.share.closed_xs, self.share.closed_ys)

    def seen(self, map_from_common: Pose2) -> list[Point]:
        """m in the own `map`: frontiers that vanished when it was near."""
        return [(x, y) for x, y in _moved(map_from_common, self.share.seen_xs, self.share.seen_ys).tolist()]


def _moved(transform: Pose2, xs: Float32s, ys: Float32s) -> Float64s:
    """(n, 2) m: points (n,), (n,) in another frame."""
    return np.asarray(transform @ np.column_stack((xs, ys)).astype(np.float64))


class SharedExploration:
    """What the other robots of one exploration said, and the own part of the frontiers.

    name: of this robot.  others: their names.  common_from_map: the own `map` in the frame that all have in common.
    """

    def __init__(self, config: SharingConfig, name: str, others: Sequence[str], common_from_map: Pose2) -> None:
        self.config, self.name, self.others, self.common_from_map = config, name, tuple(others), common_from_map
        self.map = OthersMap()
        self.found: Frontiers | None = None  # by the last search
        self.is_done = False  # nothing is left to this robot, and it waits for the others
        self.seen: list[Point] = []  # m in `map`: frontiers that vanished when it was near
        self._closed: set[tuple[int, int]] = set()  # (x, y) on a raster of _CLOSED_M: borders at which it saw no more
        self._searched_with_others = False
        self._teammates: dict[str, Teammate] = {}
        self._sequence = 0
        self._sent: int | None = None  # ns, of the last message
        self._sent_active = False
        self._session: int | None = None
        self._packed: tuple[Int8s, PackedMap] | None = None  # the last map that was sent, with its cells

    def take(self, share: ExplorationShare, now: int) -> None:
        """Takes the message of another robot, unless it is older than the last one, or of no robot that is known.

        A robot that is started again may have a clock that was set back. So after its lease any other session is newer.
        """
        before = self._teammates.get(share.robot)
        if share.robot in self.others and (before is None or self._is_newer(share, before, now)):
            self._teammates[share.robot] = Teammate(share, now)

    def _is_newer(self, share: ExplorationShare, before: Teammate, now: int) -> bool:
        if share.session == before.share.session:
            return share.sequence > before.share.sequence
        return share.session > before.share.session or not self._is_leased(before, now)

    def _is_leased(self, mate: Teammate, now: int) -> bool:
        return now - mate.arrived <= round(self.config.lease * 1e9)

    def alive(self, now: int) -> list[Teammate]:
        """The robots that explore and were heard within the lease."""
        return [mate for mate in self._teammates.values() if mate.share.active and self._is_leased(mate, now)]

    def _known(self, now: int) -> list[Teammate]:
        """The robots whose map counts: those that are alive, and those that have finished."""
        return [mate for mate in self._teammates.values() if not mate.share.active or self._is_leased(mate, now)]

    def map_update(self, resolution: float, now: int) -> MapUpdate | None:
        """Returns the tiles of what the others know that changed since the last call, in the own `map`; None without
        any.
        """
        return self.map.update((mate.share for mate in self._known(now)), self.common_from_map, resolution, now)

    def close(self, cells: Int64s, resolution: float) -> None:
        """Takes the cells (n, 2) rows and columns of `map` of a border at which the robot saw no more."""
        places = np.unique(np.round((cells[:, ::-1] + 0.5) * (resolution / _CLOSED_M)).astype(np.int64), axis=0)
        self._closed.update((x, y) for x, y in places.tolist())

    def begin_search(self, now: int) -> Float64s:
        """Returns (n, 2) m in the own `map`: the borders at which another robot saw no more, for one search."""
        self._searched_with_others = bool(self.alive(now))
        map_from_common = self.common_from_map.inverse()
        closed = [mate.closed(map_from_common) for mate in self._known(now)]
        return np.concatenate(closed) if closed else np.zeros((0, 2))

    def seen_by_others(self, now: int) -> list[Point]:
        """Returns m in the own `map`: frontiers that vanished when another robot was near."""
        map_from_common = self.common_from_map.inverse()
        return [place for mate in self._known(now) for place in mate.seen(map_from_common)]

    def own_frontiers(self, found: Frontiers, target: Point | None, now: int) -> Frontiers:
        """Returns the part of the found frontiers that this robot is to explore. target: the one that it drives to."""
        self.found = found
        dealt = self._dealt(found, target, self.alive(now))
        self.is_done = self.is_done and not dealt
        return subset(found, dealt)

    def waits(self, settled: bool, now: int) -> bool:
        """Whether to wait for the others, as no frontier is left to this robot.  settled: for long enough."""
        if not self.alive(now):
            return self._searched_with_others  # what a robot knew that fell silent is searched first
        self.is_done = self.is_done or settled
        return True

    def _dealt(self, found: Frontiers, target: Point | None, alive: list[Teammate]) -> list[int]:
        """Returns the indices of the frontiers that are dealt to this robot.

        A robot gets those near it, listed by it or not: it will see them soon. But where nothing is left to this robot,
        it keeps all that no other lists, and all where no robot drives to one. Else each of two robots may
        leave a frontier to the other.
        """
        map_from_common = self.common_from_map.inverse()
        own = [(frontier.x, frontier.y) for frontier in found.frontiers]
        places, same = list(own), self.config.same_frontier
        bids: dict[str, dict[int, float]] = {}  # of each robot, by place
        for mate in alive:
            bids[mate.share.robot] = {}
            theirs = mate.frontiers(map_from_common).tolist()
            for (x, y), cost in zip(theirs, mate.share.frontier_costs.tolist(), strict=True):
                k = _nearest(places, (x, y), same)
                if k is None:
                    k = len(places)
                    places.append((x, y))
                bids[mate.share.robot][k] = min(cost, bids[mate.share.robot].get(k, inf))
        listed = {name: [bid.get(k, inf) for k in range(len(places))] for name, bid in bids.items()}
        listed[self.name] = [frontier.distance for frontier in found.frontiers] + [inf] * (len(places) - len(own))
        near = dict(listed)
        for mate in alive:
            here, bid = mate.point(map_from_common), bids[mate.share.robot]
            near[mate.share.robot] = [bid.get(k, _DETOUR * _apart(here, place)) for k, place in enumerate(places)]
        claims = {mate.share.robot: _claim(mate, map_from_common) for mate in alive} | {self.name: target}
        for costs in (near, listed):
            if dealt := [k for k in deal(places, costs, claims, same)[self.name] if k < len(own)]:
                return dealt
        return list(range(len(own))) if all(claim is None for claim in claims.values()) else []

    def message(
        self, pose: Pose2, target: Point | None, grid: OccupancyGrid, explores: bool, task_id: int, now: int
    ) -> ExplorationShare | None:
        """Returns the message for the others, when it is due; None before.

        explores: it is on its way, or will be.  target: the frontier that it drives to.  grid: the own map.
        """
        active = explores and not self.is_done
        is_due = self._sent is None or not 0 <= now - self._sent < round(self.config.period * 1e9)
        if not is_due and active is self._sent_active:
            return None
        self._sent_active = active
        self._session = now if self._session is None else self._session
        self._sent, self._sequence = now, self._sequence + 1
        here = self.common_from_map @ pose
        frontiers = list(self.found.frontiers if self.found is not None else ())[:_MAX_FRONTIERS]
        xs, ys = self._in_common([(f.x, f.y) for f in frontiers])
        closed_xs, closed_ys = self._in_common([(x * _CLOSED_M, y * _CLOSED_M) for x, y in sorted(self._closed)])
        seen_xs, seen_ys = self._in_common(self.seen)
        if self._packed is None or self._packed[0] is not grid.cells:
            self._packed = grid.cells, packed_map(grid)
        packed = self._packed[1]
        return ExplorationShare(
            stamp=now,
            robot=self.name,
            session=self._session,
            sequence=self._sequence,
            task_id=task_id,
            others=self.others,
            active=active,
            common_from_map=self.common_from_map,
            x=here.x,
            y=here.y,
            frontier_xs=xs,
            frontier_ys=ys,
            frontier_costs=np.array([f.distance for f in frontiers], np.float32),
            claimed=-1 if target is None else _index_of(frontiers, target, self.config.same_frontier),
            closed_xs=closed_xs,
            closed_ys=closed_ys,
            seen_xs=seen_xs,
            seen_ys=seen_ys,
            cell=packed.cell,
            first_row=packed.first_row,
            first_column=packed.first_column,
            rows=packed.rows,
            columns=packed.columns,
            cells=packed.cells,
        )

    def _in_common(self, points: Sequence[Point]) -> tuple[Float32s, Float32s]:
        """x (n,) and y (n,) m in the common frame."""
        x, y = (self.common_from_map @ np.array(points, np.float64).reshape(-1, 2)).T.astype(np.float32)
        return x, y


def deal(
    places: Sequence[Point],
    first_costs: dict[str, list[float]],
    claims: dict[str, Point | None],
    same: float,
) -> dict[str, list[int]]:
    """Returns the places of each robot, in the order of its tour.

    The next place goes to the robot that reaches it first, behind the places that it has. Of equal times the robot with
    the first name gets it.  places: (x, y) m.  first_costs: m of driving from each robot to each place, inf
    where it cannot have it.
    claims: the place that each robot drives to. It keeps it unless one that drives nowhere is nearer by over a metre.
    Of two robots that drive to one place, the nearer one keeps it.
    """
    tours: dict[str, list[int]] = {name: [] for name in first_costs}
    length = dict.fromkeys(first_costs, 0.0)
    left = set(range(len(places)))
    claimed = {name: None if claim is None else _nearest(places, claim, same) for name, claim in claims.items()}
    free = [name for name, k in claimed.items() if k is None]
    bids = sorted((first_costs[name][k], name, k) for name, k in claimed.items() if k is not None)
    for cost, name, k in bids:
        if k in left and cost < inf and not any(first_costs[other][k] < cost - _KEEP_M for other in free):
            tours[name], length[name] = [k], cost
            left.discard(k)
    while left:
        arrivals = [
            (length[name] + (first_costs[name][k] if not tours[name] else _leg(places, tours[name][-1], k)), name, k)
            for name in sorted(first_costs)
            for k in sorted(left)
            if first_costs[name][k] < inf
        ]
        arrival, name, k = min(arrivals)
        tours[name].append(k)
        length[name] = arrival
        left.discard(k)
    return tours


def subset(found: Frontiers, indices: Sequence[int]) -> Frontiers:
    """Returns only these frontiers, in their order."""
    chosen = sorted(indices)
    measured = [k for k in chosen if k < len(found.between)]
    between = found.between[np.ix_(measured, measured)]
    return replace(found, frontiers=tuple(found.frontiers[k] for k in chosen), between=between)


def _claim(mate: Teammate, map_from_common: Pose2) -> Point | None:
    k = mate.share.claimed
    if not 0 <= k < len(mate.share.frontier_xs):
        return None
    x, y = mate.frontiers(map_from_common)[k].tolist()
    return x, y


def _index_of(frontiers: Sequence[Frontier], target: Point, same: float) -> int:
    k = _nearest([(frontier.x, frontier.y) for frontier in frontiers], target, same)
    return -1 if k is None else k


def _nearest(places: Sequence[Point], place: Point, within: float) -> int | None:
    apart = [_apart(other, place) for other in places]
    k = int(np.argmin(apart)) if apart else 0
    return k if apart and apart[k] <= within else None


def _leg(places: Sequence[Point], a: int, b: int) -> float:
    return _DETOUR * _apart(places[a], places[b])


def _apart(a: Point, b: Point) -> float:
    return hypot(a[0] - b[0], a[1] - b[1])
