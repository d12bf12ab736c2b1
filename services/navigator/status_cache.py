# SPDX-License-Identifier: Apache-2.0
"""What the others say, as far as it is about the present goal and not too old to count."""

from shared import reasons
from shared.messages import FollowState, FollowStatus, Goal, GuardState, GuardStatus, Path
from shared.reasons import REASONS, Reason

_MAX_GUARD_AGE_NS = 1_500_000_000
_MAX_FOLLOW_AGE_NS = 2_000_000_000
_MAX_ANSWER_NS = 1_000_000_000  # that planner and local control have to answer a new goal
_MAX_PLAN_AGE_NS = 2_000_000_000  # local control lets go of a plan at this age

_WAIT_FOR_END = {
    reason.code
    for reason in (
        reasons.SCAN_OLD,
        reasons.SCAN_UNLIKE,
        reasons.SCAN_FROZEN,
        reasons.SCAN_BLIND,
        reasons.ODOM_OLD,
        reasons.POSE_OLD,
        reasons.POSE_LOST,
        reasons.BASE_SILENT,
        reasons.BOARD_SILENT,
        reasons.BAD_STAMPS,
        reasons.ENCODERS_JUMP,
        reasons.STARTING,
        reasons.SERVICE_DIED,
    )
}
"""Reasons of the guard that no driving mends: recoveries wait for their end."""


class StatusCache:
    """The last word of planner, local control and guard, with the time when it was heard, ns.

    What was heard in the future is as old as what was heard in the past: the clock was set back.
    """

    def __init__(self) -> None:
        self._plan: tuple[Path, int] | None = None
        self._follow: tuple[FollowStatus, int] | None = None
        self._guard: tuple[GuardStatus, int] | None = None

    def add_plan(self, plan: Path, now: int) -> None:
        self._plan = plan, now

    def add_follow(self, follow: FollowStatus, now: int) -> None:
        self._follow = follow, now

    def add_guard(self, guard: GuardStatus, now: int) -> None:
        self._guard = guard, now

    def plan_for(self, goal: Goal, now: int) -> Path | None:
        """The planner's word about this goal."""
        if self._plan is None or self._plan[0].goal_id != goal.id or abs(now - self._plan[1]) > _MAX_PLAN_AGE_NS:
            return None
        return self._plan[0]

    def follow_for(self, goal: Goal, now: int) -> FollowStatus | None:
        """Local control's word about this goal."""
        if (
            self._follow is None
            or self._follow[0].goal_id != goal.id
            or abs(now - self._follow[1]) > _MAX_FOLLOW_AGE_NS
        ):
            return None
        return self._follow[0]

    def stop_reason(self, now: int) -> Reason | None:
        """Why nothing may move until a person agrees."""
        guard = self.recent_guard(now)
        if guard is None or guard.state not in (GuardState.STOPPED, GuardState.FAULT):
            return None
        return REASONS.get(guard.reason, reasons.ESTOP if guard.state is GuardState.STOPPED else reasons.FAULT)

    def recent_guard(self, now: int) -> GuardStatus | None:
        """The guard's last word, where it was heard lately."""
        if self._guard is None or abs(now - self._guard[1]) > _MAX_GUARD_AGE_NS:
            return None
        return self._guard[0]

    def hold_reason(self, now: int) -> Reason | None:
        """Why the robot stands, where neither the way nor local control is the cause."""
        guard = self.recent_guard(now)
        if guard is None:
            return None
        if guard.source == "teleop":
            return reasons.BY_HAND
        return REASONS[guard.reason] if guard.state is GuardState.HOLD and guard.reason in _WAIT_FOR_END else None

    def blocking_reason(self, goal: Goal | None, now: int) -> str:
        """The code of what keeps the robot from its goal, the gravest first; empty where nothing does."""
        guard = self.recent_guard(now)
        if guard is not None and guard.state in (GuardState.STOPPED, GuardState.FAULT):
            return guard.reason
        if goal is None:
            return ""
        if guard is not None and guard.source == "teleop":
            return reasons.BY_HAND.code
        if guard is not None and guard.state is GuardState.HOLD and guard.reason != reasons.NO_COMMAND.code:
            return guard.reason
        plan, follow = self.plan_for(goal, now), self.follow_for(goal, now)
        if plan is None and now - goal.stamp < _MAX_ANSWER_NS:
            return ""
        if plan is None:
            stale = self._plan is not None and self._plan[0].goal_id == goal.id
            return reasons.PLAN_OLD.code if stale else reasons.NO_PLAN.code
        if plan.reason:
            return plan.reason
        if follow is None and now - goal.stamp >= _MAX_ANSWER_NS:
            return reasons.COMMAND_OLD.code
        if follow is not None and follow.state in (FollowState.BLOCKED, FollowState.FAILED):
            return follow.reason or reasons.BLOCKED.code
        return guard.reason if guard is not None and guard.state is GuardState.ACTIVE else ""
