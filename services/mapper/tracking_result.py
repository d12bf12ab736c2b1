# SPDX-License-Identifier: Apache-2.0
"""What the front end says of a scan: its place, and what speaks for it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.mapper.keyframe import Sweep
from services.mapper.registration import Match
from shared.geometry import Pose2
from shared.messages import Localization

Float64s = NDArray[np.float64]

MIN_BEAMS = 15  # that must agree with the map or contradict it, to tell anything


@dataclass(frozen=True, slots=True)
class Tracked:
    """A scan's place: the pose, its covariance (3, 3) in `local`, the share of beams that agree, and the state.

    trusted: the map may be drawn from it.  keyframe: what joined the submap, where the robot has moved on.
    origins, ends: (n, 2) m in `base`, the sweep as it is to be drawn.
    """

    local_from_base: Pose2
    covariance: Float64s
    quality: float
    state: Localization
    match: Match
    trusted: bool
    keyframe: Sweep | None
    origins: Float64s
    ends: Float64s


@dataclass(frozen=True, slots=True)
class Placed:
    """A match, and how many of its beams contradict the map. A beam into the unknown says nothing."""

    match: Match
    n_against: int

    @property
    def n_agree(self) -> int:
        return int(self.match.agree.sum())

    @property
    def quality(self) -> float:
        """Of the beams that say anything, the share that agrees."""
        return self.n_agree / max(self.n_agree + self.n_against, MIN_BEAMS)

    @property
    def tells(self) -> bool:
        """Whether enough beams say anything."""
        return self.n_agree + self.n_against >= MIN_BEAMS

    @property
    def balance(self) -> float:
        """Beams for the place less those against it, as a share of all."""
        return (self.n_agree - self.n_against) / max(len(self.match.agree), 1)
