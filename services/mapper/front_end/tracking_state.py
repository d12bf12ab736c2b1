# SPDX-License-Identifier: Apache-2.0
"""Is the pose good, poor or lost? By the quality of the matches, the covariance, and the agreement with odometry.

The rules are our own: after a scan that did not fit, only a good match makes the pose good again.
"""

from services.mapper.front_end.motion_check import MotionCheck
from services.mapper.front_end.pose_covariance import PoseCovariance
from shared.messages import Localization

MAX_POOR_SCANS = 10  # in a row; later ones are drawn all the same, as the place may have changed


class TrackingState:
    """The state of localization in `local`, from scan to scan.

    n_bad: scans since the first one under `lost_quality` or displaced, 0 after one with a good match.
    n_poor: informative scans in a row under `good_quality`.  fits: whether the last scan had a good match.
    check, motions_disagree: the comparison of matches with odometry, and whether one of them is wrong now.
    """

    def __init__(self, good_quality: float, good_sigma: float, lost_quality: float, lost_after_scans: int) -> None:
        """Thresholds of the quality 0..1 and of the pose's standard deviation, m; see FrontEndConfig."""
        self.good_quality, self.good_sigma = good_quality, good_sigma
        self.lost_quality, self.lost_after_scans = lost_quality, lost_after_scans
        self.reset()

    def reset(self) -> None:
        """Another submap: the state is STARTING."""
        self.state = Localization.STARTING
        self.n_bad = self.n_poor = 0
        self.fits = self.motions_disagree = False
        self.check = MotionCheck()

    def grade(self, quality: float, is_informative: bool, is_displaced: bool, uncertainty: PoseCovariance) -> None:
        """Sets the state by a scan's match.

        quality: 0..1.  is_displaced: its pose is too far from odometry for a first good match.  uncertainty: of that
        pose.
        """
        self.n_poor = self.n_poor + 1 if is_informative and quality < self.good_quality else 0
        self.fits = is_informative and quality >= self.good_quality
        if quality >= self.good_quality and not is_displaced:
            self.n_bad = 0
        elif self.n_bad > 0 or is_displaced or (is_informative and quality < self.lost_quality):
            self.n_bad += 1  # after a scan that did not fit, only a good match counts
        if self.n_bad >= self.lost_after_scans:
            self.state = Localization.LOST
        else:
            is_good = quality >= self.good_quality and uncertainty.sigma <= self.good_sigma
            self.state = Localization.GOOD if is_good else Localization.POOR

    def compare_motions(self) -> bool:
        """Lowers the state while matches and odometry disagree.

        Returns whether a disagreement has just ended: then the scan decides which of the two poses was right.
        """
        if self.n_bad > 0:  # a scan that does not fit measures no motion
            self.check.reset()
            self.motions_disagree = False
        elif self.check.disagrees:
            self.motions_disagree = True
            self.state = Localization.LOST if self.check.is_lost else Localization.POOR
        elif self.motions_disagree and self.check.seconds == 0:
            self.motions_disagree = False
            self.check.reset()
            return True
        return False

    @property
    def trusts_scan(self) -> bool:
        """Whether the scan may be drawn.

        A map drawn from a wrong pose soon agrees with it. Yet where much has changed, no scan fits well for long.
        """
        return self.n_bad == 0 and (self.n_poor == 0 or self.n_poor > MAX_POOR_SCANS)
