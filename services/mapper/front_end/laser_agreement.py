# SPDX-License-Identifier: Apache-2.0
"""Does the second laser show the same surroundings as the first one? A laser that does not is not mapped with.

A loose or wrongly configured laser measures well, but at other places. Cartographer has no such check; it is our own.
"""

from services.mapper.front_end.tracking_result import ScoredMatch
from shared.service import Log, Out

MAX_QUALITY_RATIO = 0.5  # of the second laser's quality to the first one's; less is a contradiction
MIN_CONTRADICTING = 5  # scans in a row until the laser is left out: half a second
MIN_FITTING = 20  # scans in a row until it is used again


class LaserAgreement:
    """Whether the second laser is trusted, by its scans at the poses that the first one measured."""

    def __init__(self, good_quality: float) -> None:
        """good_quality: minimum quality of a good match, 0..1."""
        self.good_quality = good_quality
        self.is_trusted = True
        self._n_in_row = 0  # scans that speak against the present state
        self._logs: list[Log] = []

    def fits(self, *parts: ScoredMatch) -> bool:
        """Whether the beams of each laser fit at the pose that those of both have. New ground fits."""
        if any(part.is_informative and part.quality < self.good_quality for part in parts):
            return False
        self._n_in_row = 0
        return True

    def contradicts(self, first: ScoredMatch, second: ScoredMatch) -> bool:
        """Whether the second laser's beams contradict the map at the first one's pose. Both must see known ground."""
        if not (first.is_informative and second.is_informative) or first.quality < self.good_quality:
            return False
        contradicts = second.quality < MAX_QUALITY_RATIO * first.quality
        self._n_in_row = self._n_in_row + 1 if contradicts is self.is_trusted else 0
        if self._n_in_row >= (MIN_CONTRADICTING if self.is_trusted else MIN_FITTING):
            self.is_trusted, self._n_in_row = not self.is_trusted, 0
            self._logs.append(self._log())
        return contradicts

    def state(self) -> str:
        """Words for the health message; empty while the laser is trusted."""
        return "" if self.is_trusted else ", without the second laser: it contradicts the first one"

    def new_logs(self) -> Out:
        """The changes since the last call."""
        logs, self._logs = self._logs, []
        return logs

    def _log(self) -> Log:
        if self.is_trusted:
            return Log("INFO", "the second laser fits again: mapping with both lasers")
        return Log("WARNING", "the second laser contradicts the first one: mapping without it; check its mount")
