# SPDX-License-Identifier: Apache-2.0
"""From scan to pose: prior, registration, the search where that fails, keyframes, and how sure all this is."""

from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.correlative_match import SearchConfig, candidates
from services.mapper.occupancy import Occupancy
from services.mapper.registration import REGISTRARS, Match, Prior, RegistrationConfig, step_prior
from services.mapper.surface import grid_surface, sweep_normals
from shared.config import Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import Localization

Float64s = NDArray[np.float64]

LEAST_BEAMS = 15  # that must agree with the map or contradict it, to tell anything


class FrontEndConfig(Section):
    """Keyframes, and when the pose is called poor or lost."""

    keyframe_distance: float = Field(0.15, ge=0.01, le=5, description="m driven until a scan joins the map")
    keyframe_turn: float = Field(0.15, ge=0.01, le=3, description="rad turned until a scan joins the map")
    good: float = Field(0.6, ge=0, le=1, description="quality from which the pose is good")
    lost: float = Field(0.3, ge=0, le=1, description="quality under which the pose may be lost")
    clear_cells: int = Field(2, ge=0, le=20, description="free cells to each side that make an echo a moving thing's")
    most_moving: float = Field(0.4, ge=0, le=1, description="share of beams on moving things that is still believed")
    lost_after: int = Field(5, ge=1, le=1000, description="scans in a row under `lost` until the pose is lost")


@dataclass(frozen=True, slots=True)
class Tracked:
    """A scan's place: the pose, its covariance (3, 3) in `map`, the share of beams that agree, and the state."""

    map_from_base: Pose2
    covariance: Float64s
    quality: float
    state: Localization
    match: Match


class FrontEnd:
    """Follows the robot through the map that it extends. The map's frame is the robot's first pose."""

    def __init__(
        self, config: FrontEndConfig, registration: RegistrationConfig, search: SearchConfig, range_max: float
    ) -> None:
        self.config, self.registration, self.search = config, registration, search
        self.registrar = REGISTRARS[registration.registrar](registration, range_max)
        self.start(Pose2())

    def start(self, map_from_base: Pose2) -> None:
        """Forgets the map; the next scan is taken at this pose."""
        self.registrar.clear()
        self.map_from_base = map_from_base
        self.keyframe: Pose2 | None = None  # of the last scan that joined the map
        self.covariance: Float64s = np.zeros((3, 3))
        self.state = Localization.STARTING
        self.motion = Pose2()  # between the last two sweeps
        self.n_bad = 0
        self.searches_next = False

    def load(self, grid: OccupancyGrid, map_from_base: Pose2) -> None:
        """Starts on a saved map, near a pose."""
        self.start(map_from_base)
        self.registrar.extend(*grid_surface(grid.occupied, grid.free, grid.x0, grid.y0, grid.resolution))
        self.searches_next = True

    def track(self, origins: Float64s, ends: Float64s, step: Pose2, doubt: float, grid: Occupancy) -> Tracked:
        """Places a sweep, and extends the map where the robot has moved on.

        origins, ends: (n, 2) m in `base`, NaN without an echo.  step: odometry's motion since the last sweep; doubt
        widens its standard deviation.  grid: what is known to be free.
        """
        normals = sweep_normals(origins, ends)
        valid = ~np.isnan(ends[:, 0])
        points, normals = np.ascontiguousarray(ends[valid]), np.ascontiguousarray(normals[valid])
        match = self._matched(points, normals, step, doubt)
        moving = grid.clear_at(match.map_from_base @ points, self.config.clear_cells)
        if 0 < moving.sum() < self.config.most_moving * len(points):
            # who walks through known free space would pull the robot along, most of all in a bare corridor
            points, normals = points[~moving], normals[~moving]
            match = self._matched(points, normals, step, doubt)
        self._believe(match, step, doubt)
        self.motion = self.map_from_base.inverse() @ match.map_from_base
        self.map_from_base = match.map_from_base
        quality, told = self._judged(match, points, grid, int(moving.sum()))
        self._grade(quality, told, len(points))
        if self.state is not Localization.LOST and self._moved_on() and len(points):
            self._extend(points, normals)
        return Tracked(self.map_from_base, self.covariance, quality, self.state, match)

    def _matched(self, points: Float64s, normals: Float64s, step: Pose2, doubt: float) -> Match:
        prior = step_prior(self.registration, self.map_from_base, step, doubt)
        if self.registrar.map.n == 0 or not len(points):
            return self.registrar.measured(points, normals, prior.map_from_base)
        match = self.registrar.register(points, normals, prior.map_from_base, prior)
        if match.share >= self.search.below and not self.searches_next:
            return match
        # odometry may lie: a slipping wheel, a stall, a wrong direction. The motion before this step is another guess
        unsure = step_prior(self.registration, self.map_from_base, step, 10 * doubt)
        match = self._better(match, points, normals, [self.map_from_base @ self.motion], unsure)
        if match.share < self.search.below or self.searches_next:
            self.searches_next = False
            guesses = candidates(points, self.registrar.map, prior.map_from_base, self.search)
            match = self._better(match, points, normals, guesses, unsure)
        return match

    def _better(self, match: Match, points: Float64s, normals: Float64s, guesses: list[Pose2], prior: Prior) -> Match:
        """The match, or one from another guess that clearly more beams agree with."""
        for guess in guesses:
            other = self.registrar.register(points, normals, guess, prior)
            if other.share > match.share + self.search.gain:
                match = other
        return match

    def _believe(self, match: Match, step: Pose2, doubt: float) -> None:
        """The covariance: grown by the step's uncertainty, shrunk by what the beams tell (information filter)."""
        prior = step_prior(self.registration, self.map_from_base, step, doubt)
        dx, dy = prior.map_from_base.x - self.map_from_base.x, prior.map_from_base.y - self.map_from_base.y
        turned = np.array(((1, 0, -dy), (0, 1, dx), (0, 0, 1)))
        grown = turned @ self.covariance @ turned.T + np.diag((prior.sigma**2, prior.sigma**2, prior.sigma_turn**2))
        covariance = np.linalg.inv(np.linalg.inv(grown) + match.information)
        self.covariance = (covariance + covariance.T) / 2

    def _judged(self, match: Match, points: Float64s, grid: Occupancy, n_moving: int) -> tuple[float, bool]:
        """The share that agrees of the beams that tell anything; a beam into the unknown tells nothing."""
        n_agree = int(match.agree.sum())
        n_against = int(grid.clear_at(match.map_from_base @ points[~match.agree], 1).sum()) + n_moving
        return n_agree / max(n_agree + n_against, LEAST_BEAMS), n_agree + n_against >= LEAST_BEAMS

    def _grade(self, quality: float, told: bool, n: int) -> None:
        if self.state is Localization.STARTING and (n == 0 or self.registrar.map.n == 0):
            return
        if told and quality < self.config.lost:
            self.n_bad += 1
        elif quality >= self.config.good or self.state is not Localization.LOST:
            self.n_bad = 0
        if self.n_bad >= self.config.lost_after:
            self.state = Localization.LOST
        else:
            self.state = Localization.GOOD if quality >= self.config.good else Localization.POOR

    def _moved_on(self) -> bool:
        if self.keyframe is None:
            return True
        moved = self.keyframe.inverse() @ self.map_from_base
        return hypot(moved.x, moved.y) >= self.config.keyframe_distance or abs(moved.yaw) >= self.config.keyframe_turn

    def _extend(self, points: Float64s, normals: Float64s) -> None:
        pose = self.map_from_base
        self.registrar.extend(pose @ points, Pose2(0, 0, pose.yaw) @ normals)
        self.keyframe = pose
