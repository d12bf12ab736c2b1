# SPDX-License-Identifier: Apache-2.0
"""From scan to pose: prior, registration, the search where that fails, keyframes, and how sure all this is."""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, hypot, inf, sqrt

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.belief import Belief, mean_doubt
from services.mapper.correlative_match import SearchConfig, candidates
from services.mapper.deskew import straightened, turned_back
from services.mapper.keyframe import Sweep
from services.mapper.motion_check import MotionCheck
from services.mapper.occupancy import OccupancyConfig
from services.mapper.odometry_error import MAX_JITTER_S, SPAN, OdometryError
from services.mapper.registration import Match, Prior, RegistrationConfig
from services.mapper.slip import Slip
from services.mapper.submap import Submap
from services.mapper.surface import sweep_lone, sweep_normals, sweep_usable
from services.mapper.tracking_result import MIN_BEAMS, Placed, Tracked
from shared.config import Drive, Section
from shared.geometry import Bools, Pose2
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapUpdate

Float64s = NDArray[np.float64]

BENT, BENT_TURN = 0.02, 0.01  # m, rad, by which the first beam of a sweep may be off, to the last
LIED = 10.0  # how much wider the prior is where odometry was wrong
STOOD = 3_000_000_000  # ns that a thing stands free until it is none that walks; or until the robot
BESIDE = 0.25  # m is elsewhere, and sees it there still
STAYED = 1_000_000_000  # ns later: who drives fast is soon elsewhere, and what is slow still where it was
BUSY = 4.0  # beams of a sweep on what stands free where all was free, more than noise makes: from there on much walks
LATELY = 1.0  # s over which that is averaged
WALKING_SPEED = 1.5  # m/s: a person who walks briskly
MOST_WALKING = 0.9  # share of a sweep that may be left out: the rest, and odometry, still tell the place
PATIENCE = 10  # scans that fit, but not well, until they are drawn all the same
STRAYED = 0.3  # m that one who did not fit, or stood, may be off odometry where he fits again: rooms look alike
DOUBT = 0.1  # share of the beams that must speak for a place as far off odometry as the robot moved meanwhile
NEAR = 3.0  # standard deviations of odometry within which a place is followed that fits badly
BEYOND = 0.15  # m, rad: lag and steps of odometry, beyond what the drive can do
REACH, REACH_TURN = 0.2, 0.1  # m, rad, standard deviations of where odometry led while scans told another motion
JUMP = 3.0  # standard deviations of a step from which a match is followed at once: no jitter is so large
STANDS = 0.02  # m between two sweeps, by odometry and by what was matched before


class FrontEndConfig(Section):
    """Keyframes, and when the pose is called poor or lost."""

    keyframe_distance: float = Field(0.3, ge=0.01, le=5, description="m driven until a scan joins the map")
    keyframe_turn: float = Field(0.3, ge=0.01, le=3, description="rad turned until a scan joins the map")
    good: float = Field(0.6, ge=0, le=1, description="quality from which the pose is good")
    sure: float = Field(0.25, ge=0.01, le=100, description="m, standard deviation up to which the pose is good")
    lost: float = Field(0.3, ge=0, le=1, description="quality under which the pose may be lost")
    clear_cells: int = Field(2, ge=0, le=20, description="free cells to each side that make an echo a moving thing's")
    most_moving: float = Field(0.4, ge=0, le=1, description="share of beams on moving things that is still believed")
    lost_after: int = Field(5, ge=1, le=1000, description="scans, from one under `lost`, until the pose is lost")


class FrontEnd:
    """Follows the robot through a submap that it extends. `local`: the frame of that, continuous for ever.

    graphed: keyframes tell all that the submap holds, so that a newer one may take its place; a loaded grid has none.
    """

    def __init__(
        self,
        config: FrontEndConfig,
        registration: RegistrationConfig,
        search: SearchConfig,
        occupancy: OccupancyConfig,
        range_max: float,
        drive: Drive,
    ) -> None:
        self.config, self.registration, self.search, self.drive = config, registration, search, drive
        self.odometry_error = OdometryError()
        self._settings = registration, occupancy, range_max
        self.start(Pose2())

    def start(self, local_from_base: Pose2) -> None:
        """Forgets the submap; the next scan is taken at this pose."""
        self.submap, self.graphed = Submap(*self._settings), True
        self.local_from_base = local_from_base
        self.keyframe: Pose2 | None = None  # of the last scan that joined the submap
        self.since_keyframe = self.off = Pose2()  # the motion by odometry since then; what matches differed by
        self.belief = Belief()
        self.state = Localization.STARTING
        self.motion = self.step = Pose2()  # between the last two sweeps, by matches and by odometry
        self.smoothed = local_from_base  # the pose, less what odometry's jitter makes of it: the next prior starts here
        self.n_bad = 0  # scans that did not fit, since one fitted well
        self.n_poor = 0  # scans in a row that did not fit well
        self.fitted = False  # the last scan did, and told something
        self.reckoned = local_from_base  # where it would be by odometry alone since the last scan that fitted
        self.unfit_path = self.unfit_turn = self.unfit_seconds = 0.0  # m, rad driven since then, and s
        self.seconds = SPAN  # between the last two sweeps
        self.busy = 0.0  # beams of a sweep on what stands free where all was free, in the mean, lately: on what moves
        self.check = MotionCheck()
        self.at_odds = False  # scans and odometry tell of different motions
        self.searches_next = False
        self.other_starts: list[Pose2] = []  # that the next search looks around too

    def load(self, grid: OccupancyGrid, update: MapUpdate, map_from_base: Pose2) -> None:
        """Starts on a saved map, near a pose: `local` is its frame."""
        self.start(map_from_base)
        self.submap.load(grid, update)
        self.graphed = False
        self.submap.sign(self.local_from_base, self.belief.carried, 0)
        self.searches_next = True

    def settle(self) -> None:
        """The pose graph knows by now how its keyframes lie: what was in doubt between them is no more."""
        self.belief.start()
        self.submap.registrar.map.doubts[:] = 0

    def track(
        self,
        origins: Float64s,
        ends: Float64s,
        step: Pose2,
        doubt: float,
        skew: float = 0.0,
        stamp: int = 0,
        seconds: float = SPAN,
    ) -> Tracked:
        """Places a sweep, and extends the submap where the robot has moved on.

        origins, ends: (n, 2) m in `base`, NaN without an echo.  step: odometry's motion since the last sweep; doubt
        widens its standard deviation.  skew: share of that motion by which the beams were de-skewed.
        stamp: ns, of the sweep.  seconds: since the last one.
        """
        self.seconds = seconds = seconds if seconds > 0 else SPAN  # else a clock was set back
        self.odometry_error.hear(step, seconds)
        measured, step = step, self.odometry_error.corrected(step)
        measures = doubt <= 1  # else it is no odometry
        self.step, self.since_keyframe = step, self.since_keyframe @ step
        sweep, told, placed, n_moving, n_free = self._matched(
            origins, ends, step, doubt, skew if measures else 0.0, stamp
        )
        if measures:  # how far it drove is odometry's to say: along a corridor each sweep would bend the next
            twist = placed.match.twist
            back = _back(len(ends))
            origins, ends = turned_back(origins, back, twist), turned_back(ends, back, twist)
            sweep, told = sweep.turned_back(twist), told.turned_back(twist)
        else:
            moved = self.local_from_base.inverse() @ placed.match.map_from_base
            off = step.inverse() @ moved
            bent = skew * hypot(off.x, off.y) > BENT or skew * abs(off.yaw) > BENT_TURN
            if bent and placed.quality >= self.config.good:  # else it is the match that is wrong
                origins, ends = straightened(origins, step, moved, skew), straightened(ends, step, moved, skew)
                sweep, told, placed, n_moving, n_free = self._matched(origins, ends, step, LIED * doubt, 0.0, stamp)
        self._believe(told, placed.match, step, doubt)
        stood = measures and self.fitted and max(hypot(step.x, step.y), hypot(self.motion.x, self.motion.y)) <= STANDS
        self.motion = self.local_from_base.inverse() @ placed.match.map_from_base
        if measures:
            self.odometry_error.learn(measured, self.motion, placed.match.information, seconds)
            self.check.take(step, self.motion, seconds)
        self._smooth(step, placed, measures)
        self.local_from_base = placed.match.map_from_base
        self.reckoned = self.reckoned @ step if measures else self.local_from_base
        self.busy *= exp(-seconds / LATELY)
        if placed.quality >= self.config.good:  # else it is the place that is wrong
            self.busy += (1 - exp(-seconds / LATELY)) * n_free
        n_told = placed.n_agree + placed.n_against + n_moving
        quality = placed.n_agree / max(n_told, MIN_BEAMS)
        self._grade(quality, n_told >= MIN_BEAMS, len(origins), stood)
        self._judge_motion(sweep)
        if measures and self.n_bad > 0 and quality < self.config.lost:  # what fits nothing says nothing of the place
            self.local_from_base = self.smoothed = self.reckoned
        # a map drawn from a wrong place soon agrees with it; but where much has changed, nothing fits well for long
        trusted = self.n_bad == 0 and (self.n_poor == 0 or self.n_poor > PATIENCE)
        self.unfit_path += hypot(step.x, step.y)
        self.unfit_turn += abs(step.yaw)
        self.unfit_seconds += seconds
        if trusted and not self.at_odds:
            self.reckoned = self.local_from_base
            self.unfit_path = self.unfit_turn = self.unfit_seconds = 0.0
        joins = trusted and self._moved_on() and len(sweep.points) > 0
        if joins:
            last = self.local_from_base if self.keyframe is None else self.keyframe
            self.off = self.since_keyframe.inverse() @ (last.inverse() @ self.local_from_base) if measures else Pose2()
            self.keyframe, self.since_keyframe = self.local_from_base, Pose2()
            self.submap.forget()
            self.submap.extend(self.local_from_base, sweep.points, sweep.normals)
            self.submap.sign(self.local_from_base, self.belief.carried, stamp)
        if trusted:
            self.submap.draw(self.local_from_base @ origins, self.local_from_base @ ends)
        return Tracked(
            self.local_from_base, self.belief.covariance, quality, self.state, placed.match,
            trusted and not self.at_odds, sweep if joins else None, origins, ends,
        )  # fmt: skip

    def _smooth(self, step: Pose2, placed: Placed, measures: bool) -> None:
        """Where the next step begins: odometry that comes in steps, or late, is not followed from side to side."""
        expected, found = self.smoothed @ step, placed.match.map_from_base
        error = self.odometry_error
        gain, gain_turn = error.jitter.gain, error.jitter_turn.gain
        off = expected.inverse() @ found
        follows = not measures or self.seconds > MAX_JITTER_S
        if follows or hypot(off.x, off.y) > JUMP * sqrt(error.jitter.variance):
            gain = 1.0
        if follows or abs(off.yaw) > JUMP * sqrt(error.jitter_turn.variance):
            gain_turn = 1.0
        if gain == gain_turn == 1.0:
            self.smoothed = found
        else:
            self.smoothed = expected @ Pose2(gain * off.x, gain * off.y, gain_turn * off.yaw)

    def _matched(
        self, origins: Float64s, ends: Float64s, step: Pose2, doubt: float, skew: float, stamp: int
    ) -> tuple[Sweep, Sweep, Placed, int, int]:
        """The sweep without what moves, what of it was matched, its place, the number of beams on moving things, and
        of those that stand free, too.
        """
        normals = sweep_normals(origins, ends)
        valid = sweep_usable(origins, ends) | normals.any(axis=1)
        sweep = Sweep(origins, ends, normals, _back(len(ends))).only(valid)
        walking = np.zeros(len(sweep.points), np.bool_)
        busy, free = self._is_busy, sweep_lone(origins, ends, True)[valid]
        if doubt <= 1:  # who has no odometry has nothing better to hold on to
            lone = free if busy else sweep_lone(origins, ends, False)[valid]
            walking = self._may_walk(sweep, lone, self.smoothed @ step, stamp)
        placed = self._placed(sweep.only(~walking), step, doubt, skew)
        moving = self.submap.grid.clear_at(placed.match.map_from_base @ sweep.points, self.config.clear_cells)
        n_moving, n_free = int(moving.sum()), int((moving & free).sum())
        if 0 < n_moving < self.config.most_moving * len(moving):
            # who walks through known free space would pull the robot along, most of all in a bare corridor
            again = bool((moving & ~walking).any())
            sweep, walking = sweep.only(~moving), walking[~moving]
            if again:
                placed = self._placed(sweep.only(~walking), step, doubt, skew, [placed.match.map_from_base])
        return sweep, sweep.only(~walking), placed, n_moving, n_free

    @property
    def _is_busy(self) -> bool:
        """Whether much walks about the robot.

        In 0.07 s a walker goes as far as a beam may be off that agrees. Over a longer time between two sweeps the
        robot's own motion is less sure, and puts beams on free ground too: BUSY grows in proportion.
        """
        agreeing_s = self.registration.agrees / WALKING_SPEED
        return self.busy > BUSY * max(1.0, self.seconds / agreeing_s)

    def _may_walk(self, sweep: Sweep, lone: Bools, guess: Pose2, stamp: int) -> Bools:
        """(n,) beams on things that stand free, have not stood there for long, and are not much of the sweep.

        Who walks down a corridor before the robot is always where the map was drawn a moment ago, and never seen past.
        """
        registrar = self.submap.registrar
        walking = np.zeros_like(lone)
        if lone.any() and registrar.map.n > 0:
            match = registrar.measured(sweep.points[lone], sweep.normals[lone], guess)
            stands = match.agree.copy()
            found = registrar.found(sweep.points[lone], sweep.normals[lone], match)
            age = stamp - registrar.map.stamps[found]
            away = np.hypot(*(registrar.map.places[found] - (guess.x, guess.y)).T)
            stays = away >= BESIDE
            if self._is_busy:
                stays &= age >= STAYED
            stands[match.agree] = (age >= STOOD) | stays
            walking[lone] = ~stands
        most = MOST_WALKING if self._is_busy else self.config.most_moving
        return walking if walking.sum() < most * len(lone) else np.zeros_like(lone)

    def _placed(self, sweep: Sweep, step: Pose2, doubt: float, skew: float, found: Sequence[Pose2] = ()) -> Placed:
        """The sweep aligned from odometry's guess, or from a better one where too many beams contradict the map.

        found: where more of its beams were placed.
        """
        prior = self.odometry_error.prior(self.registration, self.smoothed, step, doubt, skew, self.seconds)
        if self.submap.registrar.map.n == 0 or len(sweep.points) < MIN_BEAMS:  # a few beams agree anywhere
            return Placed(self.submap.registrar.measured(sweep.points, sweep.normals, prior.map_from_base), 0)
        unsure = self.odometry_error.prior(self.registration, self.smoothed, step, LIED * doubt, skew)
        best = self._aligned(sweep, prior.map_from_base, unsure if self.searches_next else prior)
        new_ground = doubt <= 1 and not best.tells
        if not self.searches_next and (best.quality >= self.search.below or new_ground):
            return best  # where it looks at what is new, another place would fit what is known only too well
        # odometry may lie: a slipping wheel, a stall, a wrong direction. The motion before this step is another guess
        odometry = unsure if doubt <= 1 and not self.searches_next else None
        best = self._better(best, sweep, [self.local_from_base @ self.motion, *found], unsure, odometry)
        if best.quality < self.search.below or self.searches_next:
            starts = [prior.map_from_base, *self.other_starts]
            self.searches_next, self.other_starts = False, []
            guesses = [g for s in starts for g in candidates(sweep.points, self.submap.registrar.map, s, self.search)]
            best = self._better(best, sweep, guesses, unsure, odometry)
        return best

    def _better(self, best: Placed, sweep: Sweep, guesses: list[Pose2], prior: Prior, odometry: Prior | None) -> Placed:
        """The place, or one found from another guess that the beams clearly speak for.

        odometry: where it leads, though it may lie; None where it says nothing.
        """
        best_doubt = self._doubt(best, odometry)
        for guess in guesses:
            other = self._aligned(sweep, guess, prior)
            if not other.tells:  # out in the unknown nothing speaks against a place
                continue
            if odometry is not None and other.quality < self.config.good and not _is_near(odometry, other):
                continue  # the pose never jumps to a place that fits badly
            doubt = self._doubt(other, odometry)
            if doubt < inf and other.balance - doubt > best.balance - best_doubt + self.search.gain:
                best, best_doubt = other, doubt
        return best

    def _doubt(self, placed: Placed, odometry: Prior | None) -> float:
        """Share of the beams that must speak for a place: the more, the farther off it is from all that may be known.

        That is where odometry leads, and where the robot was. inf where the drive cannot have gone so far since the
        last scan that fitted; 0 without odometry.
        """
        if odometry is None:
            return 0.0
        seconds = self.unfit_seconds + self.seconds
        far, turned = self.drive.max_speed * seconds, self.drive.max_turn_rate * seconds
        path = self.unfit_path + hypot(self.step.x, self.step.y) + hypot(self.motion.x, self.motion.y)
        slip = Slip(path, self.unfit_turn + abs(self.step.yaw) + abs(self.motion.yaw))
        least = inf
        for known in (odometry.map_from_base, self.local_from_base):
            off = known.inverse() @ placed.match.map_from_base
            if hypot(off.x, off.y) <= BEYOND + 1.5 * far and abs(off.yaw) <= BEYOND + 1.5 * turned:
                least = min(least, slip.surprise(off, far, turned))
        return DOUBT * least

    def _aligned(self, sweep: Sweep, guess: Pose2, prior: Prior) -> Placed:
        match = self.submap.registrar.register(sweep.points, sweep.normals, guess, prior, sweep.back)
        other, pose = sweep.only(~match.agree).turned_back(match.twist), match.map_from_base
        against = self.submap.grid.contradicts(pose @ other.origins, pose @ other.points)
        return Placed(match, int(against.sum()))

    def _believe(self, sweep: Sweep, match: Match, step: Pose2, doubt: float) -> None:
        prior = self.odometry_error.prior(self.registration, self.smoothed, step, doubt, smooth=True)
        # where speed alone is known, it may be wrong for long
        ahead = self.odometry_error.forward.sigma * hypot(step.x, step.y) if doubt <= 1 else prior.sigma
        registrar = self.submap.registrar
        if registrar.map.n == 0:
            return  # here the map begins
        found = registrar.found(sweep.points, sweep.normals, match)
        at = match.map_from_base
        drawn = mean_doubt(registrar.map.doubts[found], registrar.map.places[found], at.x, at.y)
        self.belief.take(self.local_from_base, prior, ahead, match.information, drawn)

    def _grade(self, quality: float, told: bool, n: int, stood: bool) -> None:
        if self.state is Localization.STARTING and (n == 0 or self.submap.registrar.map.n == 0):
            return
        # carried while it stood, into a room like the last, it fits at once. Without a graph nobody could look for it
        off = self.graphed and not self.at_odds and self.local_from_base.distance(self.reckoned) > STRAYED
        strayed = off and (self.n_bad > 0 or stood)
        self.n_poor = self.n_poor + 1 if told and quality < self.config.good else 0
        self.fitted = told and quality >= self.config.good
        if quality >= self.config.good and not strayed:
            self.n_bad = 0
        elif self.n_bad > 0 or strayed or (told and quality < self.config.lost):
            self.n_bad += 1  # what once did not fit at all is not to be believed until it fits well
        if self.n_bad >= self.config.lost_after:
            self.state = Localization.LOST
        else:
            sure = quality >= self.config.good and self.belief.sigma <= self.config.sure
            self.state = Localization.GOOD if sure else Localization.POOR

    def _judge_motion(self, sweep: Sweep) -> None:
        """While scans and odometry disagree, nothing is sure. When they agree again, the scan says which was right."""
        if self.n_bad > 0:  # what does not fit tells of no motion; how that ends is another matter
            self.check.start()
            self.at_odds = False
        elif self.check.at_odds:
            self.at_odds = True
            self.state = Localization.LOST if self.check.is_lost else Localization.POOR
        elif self.at_odds and self.check.seconds == 0:
            self.at_odds = False
            reckoned = self.reckoned
            prior = Prior(reckoned, REACH, REACH_TURN)
            here = self._aligned(sweep, self.local_from_base, replace(prior, map_from_base=self.local_from_base))
            there = self._aligned(sweep, reckoned, prior)
            if there.balance > here.balance + self.search.gain:
                self.local_from_base = self.smoothed = there.match.map_from_base
            elif here.quality >= self.config.good:
                self.reckoned = self.local_from_base
            else:
                self.n_bad = 1
            self.check.start()

    def _moved_on(self) -> bool:
        if self.keyframe is None:
            return True
        moved = self.keyframe.inverse() @ self.local_from_base
        return hypot(moved.x, moved.y) >= self.config.keyframe_distance or abs(moved.yaw) >= self.config.keyframe_turn


def _is_near(unsure: Prior, placed: Placed) -> bool:
    """Whether a place is where odometry leads. unsure: its prior, LIED times as wide as it is."""
    off = unsure.map_from_base.inverse() @ placed.match.map_from_base
    near, near_turn = NEAR / LIED * unsure.sigma, NEAR / LIED * unsure.sigma_turn
    return hypot(off.x, off.y) <= near and abs(off.yaw) <= near_turn


def _back(n: int) -> Float64s:
    """(n,) share of a sweep from each of its beams to its end."""
    return np.linspace(1, 0, n)
