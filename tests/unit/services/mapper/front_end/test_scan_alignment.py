# SPDX-License-Identifier: Apache-2.0
"""Which of several poses of a scan is chosen, where odometry's own fits badly."""

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
FITS = {ODOMETRY: (60, 30), MOTION: (85, 10), NEAR: (97, 1)}  # agreeing beams, and contradicting ones


class AlignerOfThree(ScanAligner):
    """A registration that ends at one of three poses, the nearest to where it begins."""

    def match(self, submap, sweep, guess, prior):
        pose = min(FITS, key=guess.distance)
        n_inliers, n_contradictions = FITS[pose]
        return ScoredMatch(
            Match(pose, np.eye(3), np.arange(N_BEAMS) < n_inliers, n_inliers / N_BEAMS), n_contradictions
        )


@pytest.mark.parametrize("found", [NEAR, None])
def test_a_good_pose_far_from_odometry_is_compared_with_those_near_it(monkeypatch, found):
    """The motion before leads to a similar place. The search about odometry finds the true one."""
    monkeypatch.setattr(scan_alignment, "candidate_poses", lambda *_: [found] if found else [])
    submap = Submap(RegistrationConfig(), OccupancyConfig(), 8.0)
    submap.add_points(Pose2(), np.ones((1, 2)), np.ones((1, 2)))
    sweep = Sweep(*np.zeros((3, N_BEAMS, 2)), np.zeros(N_BEAMS))
    prediction = Prediction(
        local_from_base=Pose2(), motion=MOTION, smoothed=Pose2(), step=ODOMETRY, seconds=2.0, sigma_factor=1.0,
        skew=0.0, unmatched=UnmatchedMotion(),
    )  # fmt: skip
    aligner = AlignerOfThree(SearchConfig(), RegistrationConfig(), ROBOT.drive, 0.6, OdometryError())
    assert aligner.align(submap, sweep, prediction).match.map_from_base == (found or MOTION)
