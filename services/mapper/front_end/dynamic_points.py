# SPDX-License-Identifier: Apache-2.0
"""Which points of a scan lie on moving people or things, and must not be aligned?

A point in known free space is dynamic. A person walking ahead of the robot overlaps the newest points of the map, which
no later beam crosses. So a point on a free-standing object is aligned only if the map has shown the object for some
time, or from another position.

The rules are our own. They are derived from the distance filter of Fox, Burgard and Thrun, "Markov localization for
mobile robots in dynamic environments", JAIR 1999. That filter rejects beams which are shorter than the map explains.
"""

from math import exp

import numpy as np

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.submap import Submap
from shared.geometry import Pose2
from shared.types import NS_PER_S, Bools

MIN_STATIC_NS = 3 * NS_PER_S  # age of the map's points at which a free-standing object counts as static
MIN_CROWD_STATIC_NS = NS_PER_S  # the same for an object that is seen from another position, in a crowd
MIN_VIEW_CHANGE_M = 0.25  # distance from the position where the map saw the object, at which it counts as static
MIN_CROWD_BEAMS = 4.0  # mean free-standing beams of a sweep on known free space; noise gives fewer
CROWD_AVERAGE_S = 1.0  # time constant of that mean
WALKING_SPEED = 1.5  # m/s, brisk
MAX_CROWD_SHARE = 0.9  # of a sweep that is rejected in a crowd: the rest and odometry still determine the pose


class DynamicPointFilter:
    """Rejects points that may be dynamic.

    crowd_beams: mean number of free-standing beams of a sweep on known free space, over CROWD_AVERAGE_S.
    """

    def __init__(self, max_dynamic_share: float, inlier_distance: float) -> None:
        """max_dynamic_share: of the beams, 0..1; if more seem dynamic, none is rejected.  inlier_distance: m."""
        self.max_dynamic_share, self.inlier_distance = max_dynamic_share, inlier_distance
        self.reset()

    def reset(self) -> None:
        """Forgets the crowd."""
        self.crowd_beams = 0.0

    def is_crowded(self, seconds: float) -> bool:
        """Whether many people move around the robot. seconds: between the last two sweeps.

        A walking person takes 0.07 s over the distance of an inlier. After a longer time the motion of the robot is
        less certain and puts beams on free space, too. So the threshold grows in proportion.
        """
        inlier_s = self.inlier_distance / WALKING_SPEED
        return self.crowd_beams > MIN_CROWD_BEAMS * max(1.0, seconds / inlier_s)

    def suspects(
        self, submap: Submap, sweep: Sweep, free_standing: Bools, guess: Pose2, stamp: int, seconds: float
    ) -> Bools:
        """(n,) bool: beams on free-standing objects that the submap has not shown for long; none if they are too many.

        free_standing: (n,) bool, of the sweep's beams.  guess: pose in the submap's frame.  stamp: ns, of the sweep.
        seconds: since the last sweep.
        """
        registrar, crowded = submap.registrar, self.is_crowded(seconds)
        suspect = np.zeros_like(free_standing)
        if free_standing.any() and registrar.map.n > 0:
            points, normals = sweep.points[free_standing], sweep.normals[free_standing]
            match = registrar.evaluate(points, normals, guess)
            is_static = match.inliers.copy()
            indices = registrar.correspondences(points, normals, match)
            age = stamp - registrar.map.stamps[indices]
            view_change = np.hypot(*(registrar.map.positions[indices] - (guess.x, guess.y)).T)
            seen_elsewhere = view_change >= MIN_VIEW_CHANGE_M
            if crowded:
                seen_elsewhere &= age >= MIN_CROWD_STATIC_NS
            is_static[match.inliers] = (age >= MIN_STATIC_NS) | seen_elsewhere
            suspect[free_standing] = ~is_static
        max_share = MAX_CROWD_SHARE if crowded else self.max_dynamic_share
        return suspect if suspect.sum() < max_share * len(free_standing) else np.zeros_like(free_standing)

    def update_crowd(self, n_free_standing: int, seconds: float, is_good: bool) -> None:
        """Updates the mean by a sweep. n_free_standing: its free-standing beams on known free space.

        seconds: since the last sweep.  is_good: whether the match is; under a wrong pose static beams fall on free
        space, too.
        """
        self.crowd_beams *= exp(-seconds / CROWD_AVERAGE_S)
        if is_good:
            self.crowd_beams += (1 - exp(-seconds / CROWD_AVERAGE_S)) * n_free_standing
