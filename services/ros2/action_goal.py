# SPDX-License-Identifier: Apache-2.0
"""A goal of an action: its state, and what its feedback and result need."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from services.ros2.action_topics import Action
from shared import reasons
from shared.messages import NavState, NavStatus


class GoalState(IntEnum):
    """action_msgs/GoalStatus."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


ENDED = (GoalState.SUCCEEDED, GoalState.CANCELED, GoalState.ABORTED)


@dataclass(slots=True)
class ActionGoal:
    """A goal. id: 16 bytes, of its client.  begun, accepted, ended: ns.  waiting: requests for its result.

    error, reason: why it ended, in words and as a code.  amount: rad or m, of a single motion.  poses: of a route, as
    geometry_msgs/PoseStamped; it begins with the one of number `first`.  waypoint: number of the present one.
    recovery_cause: code of the reason of the last recovery.  behind_since: ns, since the navigator's task has a lower
    number.  canceled: ns, when its cancellation was last asked for.
    """

    id: bytes
    action: Action
    begun: int
    state: GoalState = GoalState.ACCEPTED
    task_id: int | None = None
    waiting: list[int] = field(default_factory=list)
    error: str = ""
    reason: str = ""
    amount: float = 0.0
    accepted: int = 0
    ended: int = 0
    poses: tuple[Any, ...] = ()
    first: int = 0
    waypoint: int = 0
    recovery_cause: str = ""
    behind_since: int | None = None
    canceled: int = 0

    def is_before(self, other: "ActionGoal") -> bool:
        """Whether the navigator took the other goal after this one, though its reply came first.

        Two goals that wait at once have their replies in any order. A lower number alone may be that of a navigator
        that was started again.
        """
        if self.task_id is None or other.task_id is None:
            return False
        return self.begun < other.accepted and self.task_id < other.task_id

    def follow(self, status: NavStatus) -> None:
        """Takes the navigator's status while the goal runs. The status of its end has no waypoint."""
        if self.poses:
            self.waypoint = (self.first + status.waypoint) % len(self.poses)
        if status.state is NavState.RECOVERING:
            self.recovery_cause = status.reason

    def fail(self, reason: str) -> None:
        """Takes the reason for which the task failed. Where every recovery was tried it is that of the last one."""
        self.reason = reason
        if reason == reasons.RECOVERIES_USED.code and self.recovery_cause:
            self.reason = self.recovery_cause

    @property
    def missed(self) -> int | None:
        """The number of the pose at which a route failed."""
        return self.waypoint if self.reason and self.poses else None
