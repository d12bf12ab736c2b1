# SPDX-License-Identifier: Apache-2.0
"""Kidnap detection: whether the robot was carried away, on a map that does not change.

The front end takes an unknown place for new ground. From the second scan on, it agrees with what it drew there itself.
The saved map does not agree: there, beams end in free space, or pass through walls.

It is derived from augmented MCL (Thrun et al., "Probabilistic Robotics", 2005, table 8.3), which averages how well
measurements fit. There a short average is compared with a long one; here one average has a threshold.
"""

from typing import ClassVar

import numpy as np
from pydantic import Field

from services.mapper.grid.occupancy import Occupancy
from shared.config import Section
from shared.types import Float64s

MIN_BEAMS = 15  # that end or pass in known space; fewer say nothing about the pose
FREE_END_WEIGHT = 0.5  # of a beam that ends in free space, relative to one through a wall: it may be a person


class KidnapConfig(Section):
    """Kidnap detection."""

    RENAMED: ClassVar[dict[str, str]] = {"share": "min_agreement", "scans": "n_averaged_scans"}

    min_agreement: float = Field(
        0.75, ge=0, le=1, description="agreement of the scans with the saved map under which the robot is lost"
    )
    n_averaged_scans: float = Field(10.0, ge=1, le=1000, description="scans over which the agreement is averaged")


class KidnapDetector:
    """Averages how well scans agree with a saved map: at the right pose 0.95 to 1, elsewhere 0.2 to 0.7."""

    def __init__(self, config: KidnapConfig) -> None:
        self.config = config
        self.reset()

    def reset(self) -> None:
        """Begins again, after the robot was localized."""
        self.agreement = 1.0

    def is_kidnapped(self, grid: Occupancy, origins: Float64s, ends: Float64s) -> bool:
        """Adds a scan, and returns whether the robot was carried away.

        origins, ends: (n, 2) m in `map`, ends NaN without an echo.
        """
        agreement = map_agreement(grid, origins, ends)
        if agreement is not None:
            self.agreement += (agreement - self.agreement) / self.config.n_averaged_scans
        return self.agreement < self.config.min_agreement


def map_agreement(grid: Occupancy, origins: Float64s, ends: Float64s) -> float | None:
    """Returns the share of the beams in known space that agree with a grid; None below MIN_BEAMS of them.

    origins, ends: (n, 2) m in the grid's frame, ends NaN without an echo.
    """
    has_echo = ~np.isnan(ends[:, 0])
    origins, ends = origins[has_echo], ends[has_echo]
    agrees = grid.is_near_occupied(ends)
    origins, ends = origins[~agrees], ends[~agrees]
    through = grid.crosses_occupied(origins, ends)
    free = grid.is_free(ends, 1) & ~through
    if agrees.sum() + through.sum() + free.sum() < MIN_BEAMS:
        return None
    return float(agrees.sum() / (agrees.sum() + through.sum() + FREE_END_WEIGHT * free.sum()))
