# SPDX-License-Identifier: Apache-2.0
"""Alignment of a scan with the submap: registration from odometry, and from other guesses where that is doubtful.

Odometry can be wrong: a slipping wheel, a stall, a wrong sign. After a long step a good match far from odometry can be,
too, as places look alike. Then the motion before is a guess, and the poses of a correlative search. Another pose
replaces the first only if clearly more beams support it. The margin grows with the offset from odometry that slip must
explain.

The guesses are those of KISS-ICP (constant velocity: Vizzo et al., RA-L 2023, section III-A) and of Olson, ICRA 2009.
The choice between them is our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, inf

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.correlative_match import SearchConfig, candidate_poses
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import Match, Prior, RegistrationConfig
from services.mapper.front_end.slip import SlipBound
from services.mapper.front_end.submap import Submap
from services.mapper.front_end.tracking_result import MIN_BEAMS, ScoredMatch
from shared.config import Drive
from shared.geometry import Pose2

WRONG_ODOMETRY_FACTOR = 10.0  # of the prior's standard deviations where odometry was wrong
SLIP_PENALTY = 0.1  # share of the beams that must support a pose as far off odometry as slip reaches
ODOMETRY_PENALTY = 0.4  # share of the beams that must support a pose far outside of odometry's errors
ODOMETRY_PENALTY_SCALE = 20.0  # squared sigmas at which half of it counts
MAX_PRIOR_SIGMAS = 3.0  # from odometry to a pose that fits badly
ODOMETRY_TOLERANCE = 0.15  # m, rad: lag and steps of odometry, beyond what the drive can do


@dataclass(frozen=True, slots=True)
class UnmatchedMotion:
    """Path m, turn rad and time s since the last scan with a good match."""

    path: float = 0.0
    turn: float = 0.0
    seconds: float = 0.0

    def extended(self, step: Pose2, seconds: float) -> "UnmatchedMotion":
        """With a further motion, in `base`, that took `seconds`."""
        return UnmatchedMotion(self.path + hypot(step.x, step.y), self.turn + abs(step.yaw), self.seconds + seconds)


@dataclass(frozen=True, slots=True)
class Prediction:
    """What is known of a scan's pose before it is aligned. Poses are in `local`.

    local_from_base, motion: pose of the last scan, and the motion that led there, by matches.
    smoothed: pose of the last scan without the jitter of odometry; the prior begins there.
    step, seconds: motion by odometry since the last scan, scaled, and its time.
    sigma_factor: of the prior's standard deviations; over 1 there is no odometry.
    skew: share of the step that the sweep took, if registration shall estimate the twist, else 0.
    has_slipped: whether the poses were moved, as the wheels slipped along a corridor.
    """

    local_from_base: Pose2
    motion: Pose2
    smoothed: Pose2
    step: Pose2
    seconds: float
    sigma_factor: float
    skew: float
    unmatched: UnmatchedMotion
    has_slipped: bool = False

    @property
    def has_odometry(self) -> bool:
        """Whether the step is odometry's, not an assumption of constant velocity."""
        return self.sigma_factor <= 1

    def slipped_to(self, local_from_base: Pose2) -> "Prediction":
        """With its poses moved, so that the step ends at the given pose."""
        shift = local_from_base @ (self.smoothed @ self.step).inverse()
        before, smoothed = shift @ self.local_from_base, shift @ self.smoothed
        return replace(self, local_from_base=before, smoothed=smoothed, has_slipped=True)


class ScanAligner:
    """Aligns scans with a submap.

    searches_next: the next scan is searched for, whatever its match.  other_starts: further centres of that search, in
    `local`.  good_quality: minimum quality of a good match, 0..1.
    """

    def __init__(
        self,
        search: SearchConfig,
        registration: RegistrationConfig,
        drive: Drive,
        good_quality: float,
        odometry_error: OdometryError,
    ) -> None:
        self.search, self.registration, self.drive = search, registration, drive
        self.good_quality, self.odometry_error = good_quality, odometry_error
        self.reset()

    def reset(self) -> None:
        """Another submap: no search is due."""
        self.searches_next = False
        self.other_starts: list[Pose2] = []

    def align(self, submap: Submap, sweep: Sweep, prediction: Prediction, guesses: Sequence[Pose2] = ()) -> ScoredMatch:
        """The match from odometry's guess, or a better one from another guess. guesses: further ones, in `local`."""
        p, error = prediction, self.odometry_error
        prior = error.prior(self.registration, p.smoothed, p.step, p.sigma_factor, p.skew, p.seconds)
        if submap.registrar.map.n == 0 or len(sweep.points) < MIN_BEAMS:  # a few beams fit at any pose
            return ScoredMatch(submap.registrar.evaluate(sweep.points, sweep.normals, prior.map_from_base), 0)
        wide_prior = error.prior(self.registration, p.smoothed, p.step, WRONG_ODOMETRY_FACTOR * p.sigma_factor, p.skew)
        best = self.match(submap, sweep, prior.map_from_base, wide_prior if self.searches_next else prior)
        odometry = wide_prior if p.has_odometry and not self.searches_next else None
        # a scan of unknown space fits known ground at wrong poses only, and one of plants fits anywhere
        is_new_ground = not best.is_informative or error.match_error.exceeds(error.position.recent, error.turn.recent)
        if not self.searches_next and (not self._is_doubtful(best, odometry, p) or (p.has_odometry and is_new_ground)):
            return best
        starts = [p.local_from_base @ p.motion, *guesses]
        best = self._best(best, submap, sweep, starts, wide_prior, odometry, prediction)
        if self._is_doubtful(best, odometry, p) or self.searches_next:
            centres = [prior.map_from_base, *self.other_starts]
            self.searches_next, self.other_starts = False, []
            starts = [
                start for c in centres for start in candidate_poses(sweep.points, submap.registrar.map, c, self.search)
            ]
            best = self._best(best, submap, sweep, starts, wide_prior, odometry, prediction)
        return best

    def _is_doubtful(self, scored: ScoredMatch, odometry: Prior | None, prediction: Prediction) -> bool:
        """Whether to compare a match with others: few beams agree, or it is far from odometry after a long step.

        odometry: its wide prior, if any.
        """
        step = prediction.step
        is_far = odometry is not None and not _is_near_prior(odometry, scored)
        return scored.quality < self.search.below or (is_far and hypot(step.x, step.y) > self.search.reach)

    def match(self, submap: Submap, sweep: Sweep, guess: Pose2, prior: Prior) -> ScoredMatch:
        """The match from one guess, with the number of beams that contradict the submap there."""
        return self.scored(
            submap, sweep, submap.registrar.register(sweep.points, sweep.normals, guess, prior, sweep.remaining)
        )

    def scored(self, submap: Submap, sweep: Sweep, match: Match) -> ScoredMatch:
        """A match of a sweep, with the number of beams that contradict the submap there."""
        others, pose = sweep.only(~match.inliers).without_twist(match.twist), match.map_from_base
        contradictions = submap.grid.contradicts(pose @ others.origins, pose @ others.points)
        return ScoredMatch(match, int(contradictions.sum()))

    def _best(
        self,
        best: ScoredMatch,
        submap: Submap,
        sweep: Sweep,
        guesses: list[Pose2],
        prior: Prior,
        odometry: Prior | None,
        prediction: Prediction,
    ) -> ScoredMatch:
        """The match, or one from another guess that clearly more beams support. odometry: its wide prior, if any."""
        best_penalty = self._slip_penalty(best, odometry, prediction)
        for guess in guesses:
            other = self.match(submap, sweep, guess, prior)
            if not other.is_informative:  # in unknown space no beam contradicts a pose
                continue
            if odometry is not None and other.quality < self.good_quality and not _is_near_prior(odometry, other):
                continue  # the pose never jumps to one that fits badly
            penalty = self._slip_penalty(other, odometry, prediction)
            if penalty < inf and other.inlier_margin - penalty > best.inlier_margin - best_penalty + self.search.gain:
                best, best_penalty = other, penalty
        return best

    def _slip_penalty(self, scored: ScoredMatch, odometry: Prior | None, prediction: Prediction) -> float:
        """Share of the beams that must support a match, by its offset from odometry and from the last pose.

        0 without odometry; inf where the drive cannot have gone so far since the last good match. The usual errors of
        odometry count with a kernel of Geman and McClure, so a slip is not excluded.
        """
        if odometry is None:
            return 0.0
        p = prediction
        seconds = p.unmatched.seconds + p.seconds
        max_path, max_turn = self.drive.max_speed * seconds, self.drive.max_turn_rate * seconds
        path = p.unmatched.path + hypot(p.step.x, p.step.y) + hypot(p.motion.x, p.motion.y)
        bound = SlipBound(path, p.unmatched.turn + abs(p.step.yaw) + abs(p.motion.yaw))
        squared_ratio = inf
        for reference in (odometry.map_from_base, p.local_from_base):
            off = reference.inverse() @ scored.match.map_from_base
            is_near = hypot(off.x, off.y) <= ODOMETRY_TOLERANCE + 1.5 * max_path
            if is_near and abs(off.yaw) <= ODOMETRY_TOLERANCE + 1.5 * max_turn:
                squared_ratio = min(squared_ratio, bound.squared_ratio(off, max_path, max_turn))
        squared = _squared_sigmas(odometry, scored)
        return SLIP_PENALTY * squared_ratio + ODOMETRY_PENALTY * squared / (squared + ODOMETRY_PENALTY_SCALE)


def _is_near_prior(wide_prior: Prior, scored: ScoredMatch) -> bool:
    return _squared_sigmas(wide_prior, scored) <= MAX_PRIOR_SIGMAS**2


def _squared_sigmas(wide_prior: Prior, scored: ScoredMatch) -> float:
    """Squared distance of a match from a prior that is WRONG_ODOMETRY_FACTOR times too wide, in its proper sigmas."""
    return WRONG_ODOMETRY_FACTOR**2 * wide_prior.squared_sigmas(scored.match.map_from_base)
