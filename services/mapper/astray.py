# SPDX-License-Identifier: Apache-2.0
"""Whether the robot is where it believes to be, on a map that does not change.

Somebody who carries the robot away sets it down in a place that the front end takes for new: from the second scan on it
agrees with what it has drawn there itself. The saved map does not: there, beams end in the free, or go through walls.
"""

import numpy as np
from pydantic import Field

from services.mapper.occupancy import Occupancy
from shared.config import Section
from shared.geometry import Float64s

LEAST_BEAMS = 15  # of a scan that tells anything
IN_THE_FREE = 0.5  # what a beam that ends in the free counts, beside one that goes through a wall: it may be a person


class AstrayConfig(Section):
    """Noticing that the robot was carried away."""

    share: float = Field(
        0.75, ge=0, le=1, description="of the beams that tell anything, that agree with the saved map; lost under it"
    )
    scans: float = Field(10.0, ge=1, le=1000, description="over which that share is averaged, about")


class Astray:
    """Averages how well scans agree with a saved map: at the right place 0.95 to 1, elsewhere 0.2 to 0.7."""

    def __init__(self, config: AstrayConfig) -> None:
        self.config = config
        self.start()

    def start(self) -> None:
        """The robot was just found."""
        self.share = 1.0

    def weigh(self, grid: Occupancy, origins: Float64s, ends: Float64s) -> bool:
        """Takes a scan, beams from origins (n, 2) to ends (n, 2) m in `map`; says whether the robot is lost by now."""
        agreed = agreement(grid, origins, ends)
        if agreed is not None:
            self.share += (agreed - self.share) / self.config.scans
        return self.share < self.config.share


def agreement(grid: Occupancy, origins: Float64s, ends: Float64s) -> float | None:
    """Share of the beams that agree with a grid, of those that it knows anything about; None where they are too few.

    origins, ends: (n, 2) m in the grid's frame, ends NaN without an echo.
    """
    hit = ~np.isnan(ends[:, 0])
    origins, ends = origins[hit], ends[hit]
    agree = grid.occupied_near(ends)
    origins, ends = origins[~agree], ends[~agree]
    through = grid.crosses(origins, ends)
    free = grid.clear_at(ends, 1) & ~through
    if agree.sum() + through.sum() + free.sum() < LEAST_BEAMS:
        return None
    return float(agree.sum() / (agree.sum() + through.sum() + IN_THE_FREE * free.sum()))
