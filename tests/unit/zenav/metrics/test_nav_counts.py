# SPDX-License-Identifier: Apache-2.0
"""Goals and recoveries of a drive of several tasks."""

from dataclasses import replace

from shared.geometry import Pose2
from shared.messages import NavState, NavStatus
from zenav.metrics.nav_counts import NavCounts

STATUS = NavStatus(
    stamp=0, task_id=1, state=NavState.NAVIGATING, recovery="", reason="", detail="", goal=Pose2(0.0, 0.0, 0.0),
    distance_left=0.0, time_left=0.0, waypoint=0, n_waypoints=1, n_recoveries=0,
)  # fmt: skip


def counted(*statuses: tuple[int, NavState, int]) -> NavCounts:
    counts = NavCounts()
    for task, state, n in statuses:
        counts.add(replace(STATUS, task_id=task, state=state, n_recoveries=n))
    return counts


def test_the_recoveries_of_all_tasks_count():
    moving, reached = NavState.NAVIGATING, NavState.REACHED
    counts = counted((1, moving, 0), (1, moving, 2), (1, reached, 2), (1, reached, 2), (2, moving, 1), (2, reached, 3))
    assert (counts.n_reached, counts.n_failed, counts.n_recoveries) == (2, 0, 5)


def test_a_navigator_that_starts_anew_counts_on():
    counts = counted((1, NavState.NAVIGATING, 2), (1, NavState.NAVIGATING, 0), (1, NavState.FAILED, 1))
    assert (counts.n_reached, counts.n_failed, counts.n_recoveries) == (0, 1, 3)
