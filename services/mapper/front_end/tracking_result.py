# SPDX-License-Identifier: Apache-2.0
"""Results of the front end for one scan: the pose with its quality, and a match with the beams that contradict it.

Both measures of a match, quality and margin, are our own. They extend the inlier ratio of ICP by beams that contradict
the map.
"""

from dataclasses import dataclass, replace

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.beams import Beams
from services.mapper.front_end.registration import Match
from shared.geometry import Pose2
from shared.messages import Localization
from shared.types import Float64s

MIN_BEAMS = 15  # inliers and contradictions that make a match informative


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """The pose of a scan, and what follows from it.

    local_from_base: at the end of the sweep.  covariance: (3, 3) of (x, y, yaw) in `local`, m and rad.
    quality: share of the informative beams that are inliers, 0..1.
    trusted: whether the scan may be drawn into maps.  keyframe: the beams that joined the submap, or None.
    beams: all that were aligned, de-skewed.
    """

    local_from_base: Pose2
    covariance: Float64s
    quality: float
    state: Localization
    match: Match
    trusted: bool
    keyframe: Sweep | None
    beams: Beams


@dataclass(frozen=True, slots=True)
class ScoredMatch:
    """A match, and the number of its beams that contradict the submap. A beam into unknown space is not informative."""

    match: Match
    n_contradictions: int

    @property
    def n_inliers(self) -> int:
        """Beams that lie on surfaces of the submap."""
        return int(self.match.inliers.sum())

    @property
    def quality(self) -> float:
        """Share of the informative beams that are inliers, 0..1."""
        return self.n_inliers / max(self.n_inliers + self.n_contradictions, MIN_BEAMS)

    @property
    def is_informative(self) -> bool:
        """Whether enough beams are inliers or contradictions."""
        return self.n_inliers + self.n_contradictions >= MIN_BEAMS

    @property
    def inlier_margin(self) -> float:
        """Inliers less contradictions, as a share of all beams, -1..1."""
        return (self.n_inliers - self.n_contradictions) / max(len(self.match.inliers), 1)


@dataclass(frozen=True, slots=True)
class AlignedSweep:
    """A sweep and its match.

    static: the beams that are not dynamic.  aligned: those of them that registration used; the others may be dynamic.
    n_dynamic: rejected beams in known free space.  n_free_standing: those of them on free-standing objects.
    """

    static: Sweep
    aligned: Sweep
    scored: ScoredMatch
    n_dynamic: int
    n_free_standing: int

    def without_twist(self) -> "AlignedSweep":
        """The beams without the twist that registration estimated."""
        twist = self.scored.match.twist
        return replace(self, static=self.static.without_twist(twist), aligned=self.aligned.without_twist(twist))
