# SPDX-License-Identifier: Apache-2.0
"""A robot that stands lost near a given pose is searched there again, once it knows more of the robots around it.

Robots that start side by side hide the walls from each other. The first search may fail before they have heard each
other. A robot without a pose is not driven, so no new keyframe would come. The rule is our own.
"""

from math import hypot

from services.mapper.slam import Slam
from shared.messages import OtherRobots
from shared.service import Log, Out
from shared.types import NS_PER_S

MIN_REST_NS = NS_PER_S  # between two searches
MOVED_M = 0.2  # of another robot: a search that failed may succeed


class SearchAgain:
    """Remembers the robots that were known at the last search."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[float, float]] = {}  # by name: place, m in `map`
        self._searched_at = 0  # ns

    def on_others(self, slam: Slam, others: OtherRobots, now: int) -> Out:
        """Begins a new search from the next scan on, where one failed and another robot is new or elsewhere.  now: ns.

        A robot that has been moved while lost has more keyframes, and is searched as it moves.
        """
        localizer = slam.localizer
        has_failed = localizer.is_searching and localizer.n_failed and not localizer.has_job
        if not has_failed or localizer.window_about is None or len(localizer.pending) != 1:
            return
        if 0 <= now - self._searched_at < MIN_REST_NS:
            return
        places = dict(zip(others.names, zip(others.xs[:, 0].tolist(), others.ys[:, 0].tolist()), strict=True))
        if any(_is_elsewhere(self._known.get(name), place) for name, place in places.items()):
            if places.keys() - self._known.keys():
                yield Log("INFO", "lost beside other robots: looking near the given pose again, without them")
            self._known, self._searched_at = places, now
            slam.front_end.start(slam.front_end.local_from_base)
            localizer.start(localizer.window_about)


def _is_elsewhere(before: tuple[float, float] | None, now: tuple[float, float]) -> bool:
    return before is None or hypot(before[0] - now[0], before[1] - now[1]) > MOVED_M
