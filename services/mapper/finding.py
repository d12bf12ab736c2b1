# SPDX-License-Identifier: Apache-2.0
"""Where on a saved map the robot is, from nowhere: the last keyframes are looked for on all of it, and then believed
only when, along a way driven, they are found at the same place again and again, and could be at no other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, pi, sqrt

import numpy as np
from pydantic import Field

from services.mapper.branch_and_bound import BranchAndBoundConfig, Pyramid, drawn, search_cost, search_counted
from services.mapper.keyframe import Keyframe
from services.mapper.occupancy import OccupancyConfig
from services.mapper.registration import Match, Prior, RegistrationConfig
from services.mapper.saved_map import SavedMap
from services.mapper.submap import Submap
from shared.config import Section
from shared.geometry import Float64s, Pose2, wrapped
from shared.service import Job, Out

MOST_POINTS = 2000  # of all keyframes together that are aligned at once
LEAST_POINTS = 30  # of a keyframe that tells anything
SAME, SAME_TURN = 0.3, 0.15  # m, rad: within these, two places are one
ALWAYS = 0.02  # of the beams, that may speak against any place
LOOKUPS = 1e10  # cells of a search that a second of CPU looks up
WINDOWS = 1.4e6  # that it looks at in a second
PART_BUDGET = 1_000_000  # windows of a search for a part of the map
MAX_LOOKUPS = 2e10  # of a search around a guess; a wider one is cut
MAX_REST = 60_000_000_000  # ns between two looks
REST, PART_REST = 1.0, 10.0  # the same for a robot that waits to be found, and for one that maps meanwhile


class FindingConfig(Section):
    """Finding the robot on a saved map."""

    every: float = Field(0.4, ge=0, le=20, description="m driven between two looks")
    keyframes: int = Field(15, ge=1, le=100, description="the newest ones, that are looked for together")
    looks: int = Field(3, ge=1, le=100, description="in a row that must find the same place")
    way: float = Field(1.2, ge=0, le=100, description="m driven meanwhile, at least")
    alone: int = Field(2, ge=1, le=100, description="of these looks, the last in a row that must find no other place")
    score: float = Field(0.5, ge=0, le=1, description="of a place, from which it is tried")
    share: float = Field(0.65, ge=0, le=1, description="of the beams that must agree")
    balance: float = Field(0.6, ge=0, le=1, description="agreeing beams less contradicting ones, as a share of all")
    worst: float = Field(0.35, ge=0, le=1, description="balance that each of the keyframes must have")
    unlike: float = Field(
        0.35, ge=0, le=1, description="of what speaks against the second best place, that may speak against the best"
    )
    sureness: float = Field(
        0.01, ge=0, le=1, description="least share of what the beams tell of one direction in what they tell of another"
    )
    wide: float = Field(3.0, ge=0.5, le=100, description="m from the best place beyond which a further one is sought")
    near: float = Field(1.5, ge=0.1, le=20, description="m that a given pose may be off")
    near_turn: float = Field(0.6, ge=0.05, le=3.1, description="rad that its heading may be off")
    near_looks: int = Field(3, ge=1, le=100, description="in vain near a given pose, until it is looked for everywhere")
    kept: int = Field(200, ge=10, le=100_000, description="keyframes at most that wait until the robot is found")
    search: BranchAndBoundConfig = BranchAndBoundConfig(rival=0.7, budget=50_000_000)


@dataclass(frozen=True, slots=True)
class Place:
    """A place that was tried. balance: mean of the keyframes' own.  sure: whether nothing about itself speaks against
    it."""

    map_from_local: Pose2
    balance: float
    sure: bool


class Surface:
    """All of a saved map to match with, in `map`, made when first asked for.

    It is a memory of what can be computed again, so a Job that uses it stays pure.
    """

    def __init__(
        self, saved: SavedMap, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float
    ) -> None:
        self._saved, self._settings = saved, (registration, occupancy, range_max)
        self._made: tuple[Submap, Pyramid] | None = None

    def made(self, config: BranchAndBoundConfig) -> tuple[Submap, Pyramid]:
        """What to align with, and pictures to search in."""
        if self._made is None:
            submap = Submap(*self._settings)
            for keyframe, row in zip(self._saved.keyframes, self._saved.graph.poses.tolist()):
                submap.extend(Pose2(*row), *keyframe.surface())
            submap.grid.load(self._saved.tiles)
            points = submap.registrar.map.points[: submap.registrar.map.n, :2]
            self._made = submap, drawn(np.ascontiguousarray(points), config)
        return self._made


def places_of(
    surface: Surface,
    keyframes: Sequence[Keyframe],
    guesses: Sequence[Pose2],
    config: FindingConfig,
    near: Pose2 | None = None,
    about: Pose2 | None = None,
) -> tuple[list[Place], float]:
    """Where `local` may lie on the map, by the keyframes together, best first; and s of CPU that it takes, about.

    guesses: map_from_local, tried too.  near: a given map_from_local; it is looked for around that alone.
    about: a map_from_local to look around on a map that is too wide to search the whole of it.
    """
    submap, pyramid = surface.made(config.search)
    newest = keyframes[-1].local_from_base
    backs = [newest.inverse() @ keyframe.local_from_base for keyframe in keyframes]
    surfaces = [keyframe.surface() for keyframe in keyframes]
    points = np.concatenate([back @ p for back, (p, _) in zip(backs, surfaces)])
    normals = np.concatenate([Pose2(0, 0, back.yaw) @ n for back, (_, n) in zip(backs, surfaces)])
    if len(points) < LEAST_POINTS or submap.registrar.map.n < LEAST_POINTS:
        return [], 0.0
    stride = -(-len(points) // MOST_POINTS)
    some, some_normals = np.ascontiguousarray(points[::stride]), np.ascontiguousarray(normals[::stride])
    height, width = pyramid.levels[0].shape
    across = Pose2(width * pyramid.resolution / 2 + pyramid.x0, height * pyramid.resolution / 2 + pyramid.y0)
    reach, turn = max(width, height) * pyramid.resolution / 2, pi
    if near is not None:
        across, reach, turn = near @ newest, config.near, config.near_turn
    starts = [guess @ newest for guess in guesses]
    cost = search_cost(points, pyramid, reach, turn, config.search)
    budget = config.search.budget if about is None else PART_BUDGET
    if about is not None and cost > MAX_LOOKUPS:
        across, reach, cost = about @ newest, reach * sqrt(MAX_LOOKUPS / cost), round(MAX_LOOKUPS)
    seconds = 0.0
    for apart in (config.search.apart, config.wide):
        found, n_windows = search_counted(
            points,
            pyramid,
            across,
            reach,
            turn,
            config.score,
            config.search.model_copy(update={"apart": apart, "budget": budget}),
        )
        seconds += cost / LOOKUPS + n_windows / WINDOWS
        starts += [candidate.pose for candidate in found if candidate.pose not in starts]
        if len(found) < 2:  # no rival near the best, so none farther off
            break
    places: list[Place] = []
    for start in starts:
        match = submap.registrar.register(some, some_normals, start, Prior(start, 0.5, 0.2))
        place = _place(match, submap, keyframes, backs, surfaces, newest, config)
        if not any(one(place.map_from_local, other.map_from_local, newest) for other in places):
            places.append(place)
    return sorted(places, key=lambda place: -place.balance), seconds


def _place(
    match: Match,
    submap: Submap,
    keyframes: Sequence[Keyframe],
    backs: Sequence[Pose2],
    surfaces: Sequence[tuple[Float64s, Float64s]],
    newest: Pose2,
    config: FindingConfig,
) -> Place:
    """The place of a match of all keyframes, and what each of them says to it."""
    balances, shares = [], []
    for keyframe, back, (points, normals) in zip(keyframes, backs, surfaces):
        if len(points) < LEAST_POINTS:
            continue
        measured = submap.registrar.measured(points, normals, match.map_from_base @ back)
        balances.append(submap.balance(measured, keyframe.origin, points))
        shares.append(measured.share)
    map_from_local = match.map_from_base @ newest.inverse()
    if not balances:
        return Place(map_from_local, 0.0, False)
    told = np.linalg.eigvalsh(match.information[:2, :2])
    balance = float(np.mean(balances))
    sure = (
        balance >= config.balance
        and float(np.mean(shares)) >= config.share
        and min(balances) >= config.worst
        and float(told[0]) >= config.sureness * float(told[1])
    )
    return Place(map_from_local, balance, bool(sure))


def one(a: Pose2, b: Pose2, local_from_base: Pose2) -> bool:
    """Whether two map_from_local put the robot at the same place."""
    here, there = a @ local_from_base, b @ local_from_base
    return here.distance(there) <= SAME and abs(wrapped(here.yaw - there.yaw)) <= SAME_TURN


class Finder:
    """Keeps the keyframes that wait for their place on the map, and says when it is known."""

    def __init__(
        self, config: FindingConfig, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float
    ) -> None:
        self.config = config
        self._settings = registration, occupancy, range_max
        self.epoch = 0
        self.rests_until: int | None = None  # ns, of a keyframe's stamp
        self.load(None)

    def load(self, saved: SavedMap | None, rest: float = REST) -> None:
        """Looks for the robot on this map from now on; without one, on none.

        rest: s between two looks for each second of CPU that a look takes.
        """
        self.surface, self.rest = Surface(saved, *self._settings) if saved is not None else None, rest
        self.start()

    def start(self, near: Pose2 | None = None) -> None:
        """The robot may be anywhere on the map; or near a given map_from_local, where one good look is enough."""
        self.epoch += 1
        self.searching = self.surface is not None
        self.looking = False
        self.waiting: list[tuple[Keyframe, Match, float]] = []
        self.driven = 0.0  # m
        self.looked_at = -inf  # m driven, at the last look
        self.guesses: tuple[Pose2, ...] = ()
        self.near, self.n_near = near, 0  # and looks there in vain
        self.about: Pose2 | None = None  # map_from_local to look around, on a map too wide to be searched
        self.stood: list[tuple[Pose2, float, int]] = []  # places, m driven when first found, looks that found them
        self.n_alone = 0  # looks in a row that found one of them alone

    def keep(self, keyframe: Keyframe, match: Match, doubt: float) -> Out:
        """A new keyframe, as `BackEnd.add` takes it; now and then, all that is known is looked for on the map."""
        if self.waiting:
            step = self.waiting[-1][0].local_from_base.inverse() @ keyframe.local_from_base
            self.driven += hypot(step.x, step.y)
        self.waiting.append((keyframe, match, doubt))
        del self.waiting[: -self.config.kept]
        due = self.driven - self.looked_at >= self.config.every and not self._rests(keyframe.stamp)
        if self.surface is not None and not self.looking and due:
            self.looked_at, self.looking = self.driven, True
            newest = tuple(kept for kept, _, _ in self.waiting[-self.config.keyframes :])
            order = self.epoch, self.surface, newest, self.guesses, self.config, self.near, self.about
            yield Job(_looked, order, "found", 0.5)

    def _rests(self, stamp: int) -> bool:
        """Whether the last look took so long that the next one waits; not where the clock was set back."""
        until = self.rests_until
        return until is not None and until - MAX_REST <= stamp < until

    def take(self, result: tuple[int, list[Place], float]) -> Pose2 | None:
        """What a look found; map_from_local where the robot's place is sure now."""
        epoch, places, seconds = result
        if epoch != self.epoch:
            return None
        self.looking = False
        self.rests_until = self.waiting[-1][0].stamp + min(round(self.rest * seconds * 1e9), MAX_REST)
        self.guesses = tuple(place.map_from_local for place in places[:4])
        here, before, self.stood = self.waiting[-1][0].local_from_base, self.stood, []
        for found in (place.map_from_local for place in places if place.sure):
            new = found, self.looked_at, 0
            _, since, looks = next((old for old in before if one(found, old[0], here)), new)
            self.stood.append((found, since, looks + 1))
        if not places or not places[0].sure or not self._unlike(places):
            self.n_alone = 0
            self.n_near += 1
            if self.n_near >= self.config.near_looks:
                self.near = None
            return None
        found, since, looks = self.stood[0]
        self.n_alone = min(self.n_alone + 1, looks)
        enough = looks >= self.config.looks and self.looked_at - since >= self.config.way
        if self.near is None and (self.n_alone < self.config.alone or not enough):
            return None
        self.searching = False
        return found

    def _unlike(self, places: Sequence[Place]) -> bool:
        """Whether more speaks against every other place than what was moved about in a room explains.

        In a row of rooms that look alike the right one, where a box was moved, may fit worse than its neighbour: what
        speaks against the best place must be little beside what speaks against the next, not only less.
        """
        best, rival = places[0].balance, places[1].balance if len(places) > 1 else 0.0
        return 1 - best + ALWAYS <= self.config.unlike * (1 - rival)


def _looked(
    epoch: int,
    surface: Surface,
    keyframes: Sequence[Keyframe],
    guesses: Sequence[Pose2],
    config: FindingConfig,
    near: Pose2 | None,
    about: Pose2 | None,
) -> tuple[int, list[Place], float]:
    return epoch, *places_of(surface, keyframes, guesses, config, near, about)
