# SPDX-License-Identifier: Apache-2.0
"""The messages between robots that explore together: those of the others taken, the own ones published when due."""

from services.navigator.exploration import Exploration
from services.navigator.navigation import Navigation
from services.navigator.others_map import no_map
from services.navigator.shared_exploration import SharedExploration
from shared import topics
from shared.messages import ExplorationShare
from shared.service import Out


class SharePublisher:
    """The exchange of the present task, if it explores with others."""

    def __init__(self, navigation: Navigation) -> None:
        self.navigation = navigation
        self.is_shown = False  # planner and traffic may know a map of the others
        self._before: SharedExploration | None = None  # at the last call of `publish`

    def take(self, share: ExplorationShare, now: int) -> None:
        """Takes the message of another robot."""
        task = self.navigation.task
        if isinstance(task, Exploration) and task.sharing is not None:
            task.sharing.take(share, now)

    def publish(self, now: int) -> Out:
        """Publishes for the other robots what this one explores, and once that it does no more.

        For the own planner and traffic it publishes what the others know, and nothing once the exploration has ended.
        """
        navigation, task = self.navigation, self.navigation.task
        pose = navigation.pose_tracker.map_from_base
        exploration = task if isinstance(task, Exploration) else None
        present = exploration.sharing if exploration is not None else None
        former, self._before = self._before, present
        if present is not None and not navigation.grid.empty:
            update = present.map_update(navigation.grid.resolution, now)
            if update is not None:
                self.is_shown = True
                yield topics.OTHERS_MAP(update)
        elif present is None and self.is_shown:
            self.is_shown = False
            yield topics.OTHERS_MAP(no_map(now))
        if pose is None:
            return
        for sharing in (former, present) if former is not present else (present,):
            if sharing is None:
                continue
            target = exploration.target if exploration is not None and sharing is present else None
            place = (target.frontier.x, target.frontier.y) if target is not None else None
            explores = sharing is present and not (navigation.paused or navigation.suspended)
            message = sharing.message(pose, place, navigation.grid, explores, navigation.task_id, now)
            if message is not None:
                yield topics.SHARE(message)
