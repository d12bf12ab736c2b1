# SPDX-License-Identifier: Apache-2.0
"""The front end: from a scan to the pose of the robot in `local`, and to the submap that later scans are aligned with.

`FrontEnd.track` is the pipeline, one method a phase:

1. predict: the motion by odometry, at its estimated scale.
2. align: reject dynamic points, align the others with the submap, search if that fails. A second laser that
   contradicts the first one is left out. Where wheels slipped along a corridor, the scan is aligned again.
3. undistort: remove what de-skewing by odometry left.
4. update the uncertainty, and then the pose, the errors of odometry and the crowd.
5. classify: good, poor or lost; may the scan be drawn?
6. extend the submap, with a keyframe where the robot has moved on.

Phases 1, 2 and 6 follow KISS-ICP (Vizzo et al., RA-L 2023, section III) with a submap as in Cartographer's local SLAM.
Phases 3 to 5 are our own.
"""

from dataclasses import replace
from math import hypot, sqrt
from typing import ClassVar

import numpy as np
from pydantic import Field

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.beams import Beams
from services.mapper.front_end.correlative_match import SearchConfig
from services.mapper.front_end.corridor_slip import SLIP_SIGMA_M, CorridorSlip
from services.mapper.front_end.dynamic_points import DynamicPointFilter
from services.mapper.front_end.laser_agreement import LaserAgreement
from services.mapper.front_end.odometry_error import COMPARISON_S, MAX_JITTER_S, OdometryError
from services.mapper.front_end.pose_covariance import PoseCovariance, mean_covariance
from services.mapper.front_end.registration import Match, Prior, RegistrationConfig
from services.mapper.front_end.scan_alignment import (
    WRONG_ODOMETRY_FACTOR,
    Prediction,
    ScanAligner,
    UnmatchedMotion,
)
from services.mapper.front_end.submap import Submap
from services.mapper.front_end.tracking_result import MIN_BEAMS, AlignedSweep, ScoredMatch, TrackingResult
from services.mapper.front_end.tracking_state import TrackingState
from services.mapper.grid.occupancy import OccupancyConfig
from shared.config import Drive, Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapUpdate

MAX_SKEW_ERROR_M, MAX_SKEW_ERROR_RAD = 0.02, 0.01  # of the first beam of a sweep against the last
MAX_DISPLACEMENT_M = 0.3  # from odometry to a first good match after bad ones, or while standing: rooms look alike
MAX_DISPLACEMENT_RAD = 0.35  # the same for the heading: with a narrow view, each wall looks like the last one
MAX_JITTER_SIGMAS = 3.0  # a larger step of a match is followed at once
MAX_STANDING_M = 0.02  # between two sweeps of a robot that stands, by odometry and by matches
DISAGREEMENT_SIGMA_M, DISAGREEMENT_SIGMA_RAD = 0.2, 0.1  # of odometry's pose after matches and odometry disagreed


class FrontEndConfig(Section):
    """Keyframes, dynamic points, and the limits of a good and a lost pose."""

    keyframe_distance: float = Field(0.3, ge=0.01, le=5, description="m between two keyframes")
    keyframe_turn: float = Field(0.3, ge=0.01, le=3, description="rad between two keyframes")
    good_quality: float = Field(0.6, ge=0, le=1, description="minimum quality of a good pose")
    good_sigma: float = Field(0.25, ge=0.01, le=100, description="m, maximum standard deviation of a good pose")
    lost_quality: float = Field(0.3, ge=0, le=1, description="quality under which the pose may be lost")
    free_margin: int = Field(2, ge=0, le=20, description="free cells to each side of a point that make it dynamic")
    max_dynamic_share: float = Field(
        0.4, ge=0, le=1, description="maximum share of dynamic beams; with more, none of them is rejected"
    )
    lost_after_scans: int = Field(
        5, ge=1, le=1000, description="scans until the pose is lost, from the first under `lost_quality`"
    )

    RENAMED: ClassVar[dict[str, str]] = {
        "good": "good_quality",
        "sure": "good_sigma",
        "lost": "lost_quality",
        "clear_cells": "free_margin",
        "most_moving": "max_dynamic_share",
        "lost_after": "lost_after_scans",
    }


class FrontEnd:
    """Tracks the robot in a submap that it extends. Frame `local`: that of the submap, continuous.

    from_keyframes: whether the submap holds keyframes only, so that a newer one may replace it. A loaded map has none.
    by_odometry: the pose by odometry alone since the first scan, in a frame of its own.
    keyframe_off: motion by matches between the last two keyframes less that by odometry, in axes of the last one.
    dead_reckoned: the pose by odometry alone since the last trusted scan.
    motion: in `base` of the scan before, between the last two scans, by matches.
    range_max: m, the largest of its lasers.
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
        self.config, self.registration, self.search = config, registration, search
        self.odometry_error = OdometryError()
        self.aligner = ScanAligner(search, registration, drive, config.good_quality, self.odometry_error)
        self.dynamic_points = DynamicPointFilter(config.max_dynamic_share, registration.inlier_distance)
        self.tracking = TrackingState(
            config.good_quality, config.good_sigma, config.lost_quality, config.lost_after_scans
        )
        self.uncertainty = PoseCovariance()
        self.by_odometry = Pose2()
        self.corridor_slip = CorridorSlip()
        self.agreement = LaserAgreement(config.good_quality)
        self._submap_settings = registration, occupancy, range_max
        self.start(Pose2())

    def start(self, local_from_base: Pose2) -> None:
        """Begins an empty submap. The next scan defines it, at this pose."""
        self.submap, self.from_keyframes = Submap(*self._submap_settings), True
        self.local_from_base = self.dead_reckoned = local_from_base
        self.smoothed = local_from_base  # the pose without the jitter of odometry, where the next prior begins
        self.motion = Pose2()
        self.keyframe: Pose2 | None = None  # pose of the last scan that joined the submap
        self.keyframe_by_odometry, self.keyframe_off = self.by_odometry, Pose2()
        self.unmatched = UnmatchedMotion()
        self.uncertainty.reset()
        self.aligner.reset()
        self.dynamic_points.reset()
        self.corridor_slip.reset()
        self.tracking.reset()

    def start_after_misfits(self) -> None:
        """Begins an empty submap where odometry leads: the scans fit nothing, so their matches are doubtful."""
        self.start(self.dead_reckoned)
        self.odometry_error.match_error.doubt()

    def load(self, grid: OccupancyGrid, update: MapUpdate, map_from_base: Pose2) -> None:
        """Begins on a saved map without keyframes, near a pose: `local` is its frame. grid: the cells of the update."""
        self.start(map_from_base)
        self.submap.load(grid, update)
        self.from_keyframes = False
        self.submap.set_uncertainty(self.local_from_base, self.uncertainty.map_covariance, 0)
        self.aligner.searches_next = True

    def reset_uncertainty(self) -> None:
        """Sets the uncertainty to zero: the optimized graph holds that of the keyframes so far."""
        self.uncertainty.reset()
        self.submap.registrar.map.covariances[:] = 0

    def set_guess(self, local_from_base: Pose2, other_starts: list[Pose2]) -> None:
        """Sets the last pose, and further centres of the search for the next scan, if it is searched for."""
        self.local_from_base, self.aligner.other_starts = local_from_base, other_starts

    @property
    def motions_disagree(self) -> bool:
        """Whether matches and odometry have measured different motions for so long that one of them is wrong."""
        return self.tracking.motions_disagree

    def track(
        self,
        beams: Beams,
        step: Pose2,
        sigma_factor: float,
        skew: float = 0.0,
        stamp: int = 0,
        seconds: float = COMPARISON_S,
    ) -> TrackingResult:
        """The pose of a sweep, which also extends the submap where the robot has moved on.

        step: motion by odometry since the last sweep, in `base` then.  sigma_factor: of its standard deviations; over 1
        the step is no odometry but an assumption.  skew: share of the step by which the beams were de-skewed.
        stamp: ns, end of the sweep.  seconds: since the last one; not positive if a clock was set back.
        """
        prediction = self._predict(step, sigma_factor, skew, seconds if seconds > 0 else COMPARISON_S)
        beams, sweep = self._align_lasers(beams, prediction, stamp)
        beams, sweep, prediction = self._correct_slip(beams, sweep, prediction, stamp)
        beams, sweep = self._undistort(beams, sweep, prediction, skew, stamp)
        self._update_uncertainty(sweep, prediction)
        is_standing = self._update_motion(sweep.scored, step, prediction)
        self._update_crowd(sweep, prediction.seconds)
        quality = self._classify(sweep, prediction, len(beams.ends), is_standing)
        trusted = self._update_unmatched(prediction)
        is_keyframe = self.tracking.trusts_scan and self._extend_submap(beams, sweep.static, prediction, stamp)
        return TrackingResult(
            local_from_base=self.local_from_base,
            covariance=self.uncertainty.covariance,
            quality=quality,
            state=self.tracking.state,
            match=sweep.scored.match,
            trusted=trusted,
            keyframe=sweep.static if is_keyframe else None,
            beams=beams,
        )

    def _predict(self, step: Pose2, sigma_factor: float, skew: float, seconds: float) -> Prediction:
        """Corrects the scale of odometry's step, and collects what is known of the pose before the match."""
        self.odometry_error.add_step(step, seconds)
        step = self.odometry_error.scaled_step(step)
        self.by_odometry = self.by_odometry @ step
        return Prediction(
            local_from_base=self.local_from_base, motion=self.motion, smoothed=self.smoothed, step=step,
            seconds=seconds, sigma_factor=sigma_factor, skew=skew if sigma_factor <= 1 else 0.0,
            unmatched=self.unmatched,
        )  # fmt: skip

    def _align_lasers(self, beams: Beams, prediction: Prediction, stamp: int) -> tuple[Beams, AlignedSweep]:
        """Aligns the beams of all lasers; the first laser's alone while the second one contradicts it.

        Returns the beams that were aligned.
        """
        if not beams.has_second:
            return beams, self._align(beams, prediction, stamp)
        both = self._align(beams, prediction, stamp) if self.agreement.is_trusted else None
        if both is not None and self.agreement.fits(
            *(self._score(part, both.scored.match) for part in (beams.first, beams.second))
        ):
            return beams, both
        alone = self._align(beams.first, prediction, stamp)
        contradicts = self.agreement.contradicts(alone.scored, self._score(beams.second, alone.scored.match))
        return (beams.first, alone) if both is None or contradicts else (beams, both)

    def _score(self, beams: Beams, match: Match) -> ScoredMatch:
        """The match of one laser's beams at the pose of a match."""
        sweep = beams.sweep()[0].without_twist(match.twist)
        at_pose = self.submap.registrar.evaluate(sweep.points, sweep.normals, match.map_from_base)
        return self.aligner.scored(self.submap, sweep, at_pose)

    def _align(self, beams: Beams, prediction: Prediction, stamp: int) -> AlignedSweep:
        """Rejects dynamic points, and aligns the others with the submap."""
        sweep, valid = beams.sweep()
        suspect = np.zeros(len(sweep.points), np.bool_)
        crowded = self.dynamic_points.is_crowded(prediction.seconds)
        crowd_free_standing = beams.free_standing(True)[valid]
        if prediction.has_odometry:  # else the scan needs all its beams
            guess = prediction.smoothed @ prediction.step
            free_standing = crowd_free_standing if crowded else beams.free_standing(False)[valid]
            suspect = self.dynamic_points.suspects(self.submap, sweep, free_standing, guess, stamp, prediction.seconds)
        scored = self.aligner.align(self.submap, sweep.only(~suspect), prediction)
        dynamic = self.submap.grid.is_free(scored.match.map_from_base @ sweep.points, self.config.free_margin)
        n_dynamic, n_free_standing = int(dynamic.sum()), int((dynamic & crowd_free_standing).sum())
        if 0 < n_dynamic < self.config.max_dynamic_share * len(dynamic):
            # a person walking through known free space would bias the match, most of all in a bare corridor
            aligned_dynamic = bool((dynamic & ~suspect).any())
            sweep, suspect = sweep.only(~dynamic), suspect[~dynamic]
            if aligned_dynamic:
                guesses = [scored.match.map_from_base]
                scored = self.aligner.align(self.submap, sweep.only(~suspect), prediction, guesses)
        return AlignedSweep(sweep, sweep.only(~suspect), scored, n_dynamic, n_free_standing)

    def _correct_slip(
        self, beams: Beams, sweep: AlignedSweep, prediction: Prediction, stamp: int
    ) -> tuple[Beams, AlignedSweep, Prediction]:
        """Aligns the beams again where the wheels have slipped along a corridor."""
        if prediction.has_odometry and self.submap.registrar.map.n > 0:
            all_beams, valid = beams.sweep()
            attached = all_beams.only(~beams.free_standing(True)[valid])  # a person ahead shows no slip
            pose = self.corridor_slip.corrected_pose(self.submap, attached, sweep.scored.match, prediction)
            if pose is not None:
                prediction = prediction.slipped_to(pose)
                beams, sweep = self._align_lasers(beams, prediction, stamp)
        return beams, sweep, prediction

    def _undistort(
        self, beams: Beams, sweep: AlignedSweep, prediction: Prediction, skew: float, stamp: int
    ) -> tuple[Beams, AlignedSweep]:
        """Removes the error of de-skewing: with odometry the twist only, without it the whole motion of the match.

        The forward motion stays odometry's: along a corridor the match of each sweep would distort the next one.
        """
        match = sweep.scored.match
        if prediction.has_odometry:
            return beams.without_twist(match.twist), sweep.without_twist()
        step, motion = prediction.step, self.local_from_base.inverse() @ match.map_from_base
        off = step.inverse() @ motion
        is_distorted = skew * hypot(off.x, off.y) > MAX_SKEW_ERROR_M or skew * abs(off.yaw) > MAX_SKEW_ERROR_RAD
        if is_distorted and sweep.scored.quality >= self.config.good_quality:  # else the match is wrong
            beams = beams.redeskewed(step, motion, skew)
            factor = WRONG_ODOMETRY_FACTOR * prediction.sigma_factor
            sweep = self._align(beams, replace(prediction, sigma_factor=factor, skew=0.0), stamp)
        return beams, sweep

    def _update_uncertainty(self, sweep: AlignedSweep, prediction: Prediction) -> None:
        """Adds the step and the match to the covariance. The first scan of a submap defines it without uncertainty."""
        registrar, match = self.submap.registrar, sweep.scored.match
        if registrar.map.n == 0:
            return
        step, factor = prediction.step, prediction.sigma_factor
        prior = self.odometry_error.prior(self.registration, prediction.smoothed, step, factor, smooth=True)
        if prediction.has_slipped:
            prior = replace(prior, sigma=max(prior.sigma, SLIP_SIGMA_M))
        # an assumed velocity may be wrong for long, so its error adds up like that of a scale
        scale_sigma = self.odometry_error.forward_scale.sigma * hypot(step.x, step.y)
        scale_sigma = scale_sigma if prediction.has_odometry else prior.sigma
        indices = registrar.correspondences(sweep.aligned.points, sweep.aligned.normals, match)
        pose, points = match.map_from_base, registrar.map
        matched = mean_covariance(points.covariances[indices], points.positions[indices], pose.x, pose.y)
        self.uncertainty.update(self.local_from_base, prior, scale_sigma, match.information, matched)

    def _update_motion(self, scored: ScoredMatch, odometry_step: Pose2, prediction: Prediction) -> bool:
        """Takes the pose of the match, and learns the errors of odometry from it. Returns whether the robot stands.

        odometry_step: the step as published, unscaled.
        """
        step, seconds, match = prediction.step, prediction.seconds, scored.match
        path = max(hypot(step.x, step.y), hypot(self.motion.x, self.motion.y))
        is_standing = prediction.has_odometry and self.tracking.fits and path <= MAX_STANDING_M
        self.motion = self.local_from_base.inverse() @ match.map_from_base
        if prediction.has_odometry:
            if not prediction.has_slipped:
                self.odometry_error.add_match(odometry_step, self.motion, match.information, seconds)
            self.tracking.check.add(step, self.motion, seconds)
        self.smoothed = self._smoothed_pose(match.map_from_base, prediction)
        self.local_from_base = match.map_from_base
        self.dead_reckoned = self.dead_reckoned @ step if prediction.has_odometry else self.local_from_base
        return is_standing

    def _smoothed_pose(self, matched: Pose2, prediction: Prediction) -> Pose2:
        """The pose without the jitter of odometry: uneven or late odometry must not move the prior to and fro."""
        expected, error = prediction.smoothed @ prediction.step, self.odometry_error
        gain, turn_gain = error.jitter.gain, error.turn_jitter.gain
        off = expected.inverse() @ matched
        follows = not prediction.has_odometry or prediction.seconds > MAX_JITTER_S
        if follows or hypot(off.x, off.y) > MAX_JITTER_SIGMAS * sqrt(error.jitter.variance):
            gain = 1.0
        if follows or abs(off.yaw) > MAX_JITTER_SIGMAS * sqrt(error.turn_jitter.variance):
            turn_gain = 1.0
        if gain == turn_gain == 1.0:
            return matched
        return expected @ Pose2(gain * off.x, gain * off.y, turn_gain * off.yaw)

    def _update_crowd(self, sweep: AlignedSweep, seconds: float) -> None:
        is_good = sweep.scored.quality >= self.config.good_quality
        self.dynamic_points.update_crowd(sweep.n_free_standing, seconds, is_good)

    def _classify(self, sweep: AlignedSweep, prediction: Prediction, n_beams: int, is_standing: bool) -> float:
        """Updates the tracking state, and returns the quality 0..1 of the match, with dynamic beams against it."""
        scored, tracking = sweep.scored, self.tracking
        n_informative = scored.n_inliers + scored.n_contradictions + sweep.n_dynamic
        quality = scored.n_inliers / max(n_informative, MIN_BEAMS)
        if tracking.state is not Localization.STARTING or (n_beams > 0 and self.submap.registrar.map.n > 0):
            # a robot that was carried, while it stood, into a similar room fits at once. Only a graph can find it then
            off = self.dead_reckoned.inverse() @ self.local_from_base
            is_far = hypot(off.x, off.y) > MAX_DISPLACEMENT_M or abs(off.yaw) > MAX_DISPLACEMENT_RAD
            is_off = self.from_keyframes and not tracking.motions_disagree and is_far
            is_displaced = is_off and (tracking.n_bad > 0 or is_standing)
            tracking.grade(quality, n_informative >= MIN_BEAMS, is_displaced, self.uncertainty)
        if tracking.compare_motions():
            self._choose_pose(sweep.static)
        if prediction.has_odometry and tracking.n_bad > 0 and quality < self.config.lost_quality:
            self.local_from_base = self.smoothed = self.dead_reckoned  # a scan that fits nowhere measures no pose
        return quality

    def _choose_pose(self, sweep: Sweep) -> None:
        """After matches and odometry disagreed: the scan decides between their poses."""
        odometry = Prior(self.dead_reckoned, DISAGREEMENT_SIGMA_M, DISAGREEMENT_SIGMA_RAD)
        matches = replace(odometry, map_from_base=self.local_from_base)
        at_matches = self.aligner.match(self.submap, sweep, self.local_from_base, matches)
        at_odometry = self.aligner.match(self.submap, sweep, self.dead_reckoned, odometry)
        if at_odometry.inlier_margin > at_matches.inlier_margin + self.search.gain:
            self.local_from_base = self.smoothed = at_odometry.match.map_from_base
        elif at_matches.quality >= self.config.good_quality:
            self.dead_reckoned = self.local_from_base
        else:
            self.tracking.n_bad = 1

    def _update_unmatched(self, prediction: Prediction) -> bool:
        """Updates the motion since the last good match. Returns whether the scan is trusted."""
        self.unmatched = self.unmatched.extended(prediction.step, prediction.seconds)
        trusted = self.tracking.trusts_scan and not self.tracking.motions_disagree
        if trusted:
            self.dead_reckoned = self.local_from_base
            self.unmatched = UnmatchedMotion()
        return trusted

    def _extend_submap(self, beams: Beams, sweep: Sweep, prediction: Prediction, stamp: int) -> bool:
        """Inserts the beams into the submap, and the surface points of a keyframe. Returns whether it is a keyframe."""
        pose, is_keyframe = self.local_from_base, self._has_moved_on() and len(sweep.points) > 0
        if is_keyframe:
            moved = (pose if self.keyframe is None else self.keyframe).inverse() @ pose
            step = self.keyframe_by_odometry.inverse() @ self.by_odometry
            self.keyframe_off = step.inverse() @ moved if prediction.has_odometry else Pose2()
            self.keyframe, self.keyframe_by_odometry = pose, self.by_odometry
            self.submap.remove_crossed_points()
            self.submap.add_points(pose, sweep.points, sweep.normals)
            self.submap.set_uncertainty(pose, self.uncertainty.map_covariance, stamp)
        self.submap.insert_beams(pose @ beams.origins, pose @ beams.ends)
        return is_keyframe

    def _has_moved_on(self) -> bool:
        """Whether the robot is a keyframe's distance or turn away from the last keyframe."""
        if self.keyframe is None:
            return True
        moved = self.keyframe.inverse() @ self.local_from_base
        return hypot(moved.x, moved.y) >= self.config.keyframe_distance or abs(moved.yaw) >= self.config.keyframe_turn
