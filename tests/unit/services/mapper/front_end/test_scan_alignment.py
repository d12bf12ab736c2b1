# SPDX-License-Identifier: Apache-2.0
"""Which of several poses of a scan is chosen, where odometry's own fits badly."""

from typing import ClassVar

import numpy as np
import pytest

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end import scan_alignment
from services.mapper.front_end.correlative_match import SearchConfig
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import Match, RegistrationConfig
from services.mapper.front_end.scan_alignment import Prediction, ScanAligner, UnmatchedMotion
from services.mapper.front_end.submap import Submap
from services.mapper.front_end.tracking_result import ScoredMatch
from services.mapper.grid.occupancy import OccupancyConfig
from shared.geometry import Pose2
from tests.unit.services.mapper.rooms import ROBOT

N_BEAMS = 100
ODOMETRY, MOTION, NEAR = Pose2(0.6, 0.0, 0.0), Pose2(2.0, 0.4, 0.0), Pose2(0.7, 0.2, 0.1)
FITS = {ODOMETRY: (30, 45), MOTION: (85, 10), NEAR: (97, 1)}  # agreeing beams, and contradicting ones


class AlignerOfFew(ScanAligner):
    """A registration that ends at one of a few poses, the nearest to where it begins."""

    fits: ClassVar = FITS

    def match(self, submap, sweep, guess, prior):
        pose = min(self.fits, key=guess.distance)
        n_inliers, n_contradictions = self.fits[pose]
        return ScoredMatch(
            Match(pose, np.eye(3), np.arange(N_BEAMS) < n_inliers, n_inliers / N_BEAMS), n_contradictions
        )


def aligned(aligner_type, step, motion):
    """The pose that is chosen after a step by odometry, and the same motion before."""
    submap = Submap(RegistrationConfig(), OccupancyConfig(), 8.0)
    submap.add_points(Pose2(), np.ones((1, 2)), np.ones((1, 2)))
    sweep = Sweep(*np.zeros((3, N_BEAMS, 2)), np.zeros(N_BEAMS))
    prediction = Prediction(
        local_from_base=Pose2(), motion=motion, smoothed=Pose2(), step=step, seconds=2.0, sigma_factor=1.0,
        skew=0.0, unmatched=UnmatchedMotion(),
    )  # fmt: skip
    aligner = aligner_type(SearchConfig(), RegistrationConfig(), ROBOT.drive, 0.6, OdometryError())
    return aligner.align(submap, sweep, prediction).match.map_from_base


@pytest.mark.parametrize("found", [NEAR, None])
def test_a_good_pose_far_from_odometry_is_compared_with_those_near_it(monkeypatch, found):
    """The motion before leads to a similar place. The search about odometry finds the true one."""
    monkeypatch.setattr(scan_alignment, "candidate_poses", lambda *_: [found] if found else [])
    assert aligned(AlignerOfFew, ODOMETRY, MOTION) == (found or MOTION)


@pytest.mark.parametrize("n_inliers", [26, 80])
def test_a_pose_that_odometry_contradicts_needs_more_beams(monkeypatch, n_inliers):
    """In a door most beams see new space. The few others fitted 0.24 m and 0.26 rad off odometry as well as near it."""
    by_odometry, near, far = Pose2(1.0, 0.0, 0.19), Pose2(0.93, 0.06, 0.29), Pose2(1.24, 0.11, 0.45)

    class InADoor(AlignerOfFew):
        fits: ClassVar = {by_odometry: (20, 30), near: (32, 21), far: (n_inliers, 5)}

        def reset(self):
            super().reset()
            self.odometry_error.position.recent = self.odometry_error.turn.recent = 0.05**2

    monkeypatch.setattr(scan_alignment, "candidate_poses", lambda *_: [near, far])
    assert aligned(InADoor, by_odometry, by_odometry) == (near if n_inliers < 50 else far)
