# SPDX-License-Identifier: Apache-2.0
"""The newest messages of planner, local control, guard and traffic: the recent ones about the present goal."""

from math import inf

from shared import reasons
from shared.messages import FollowState, FollowStatus, GuardState, GuardStatus, Path, RightOfWay
from shared.orders import Order
from shared.reasons import REASONS, Reason

_MAX_GUARD_AGE_NS = 1_500_000_000
_MAX_FOLLOW_AGE_NS = 2_000_000_000
_MAX_ANSWER_NS = 1_000_000_000  # until planner and local control answer a new goal
_MAX_PLAN_AGE_NS = 2_000_000_000  # as local control's limit

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
        reasons.CONTACTS_OLD,
        reasons.ENCODERS_JUMP,
        reasons.STARTING,
        reasons.SERVICE_DIED,
    )
}
"""Reasons of the guard that no recovery ends: the navigator waits."""

_FOR_ROBOTS = {reasons.RIGHT_OF_WAY.code, reasons.GIVING_WAY.code}
_CONTACTS = {reasons.BUMPER.code, reasons.CLIFF.code}


class StatusCache:
    """The newest messages with the times of their arrival, ns.

    An arrival in the future counts by its distance as well: the clock was set back.
    """

    def __init__(self) -> None:
        self._plan: tuple[Path, int] | None = None
        self._follow: tuple[FollowStatus, int] | None = None
        self._guard: tuple[GuardStatus, int] | None = None
        self._right_of_way: tuple[RightOfWay, int] | None = None

    def add_plan(self, plan: Path, now: int) -> None:
        self._plan = plan, now

    def add_follow(self, follow: FollowStatus, now: int) -> None:
        self._follow = follow, now

    def add_guard(self, guard: GuardStatus, now: int) -> None:
        self._guard = guard, now

    def add_right_of_way(self, told: RightOfWay, now: int) -> None:
        self._right_of_way = told, now

    def plan_for(self, goal: Order, now: int) -> Path | None:
        """The plan for this goal, or None."""
        if self._plan is None or self._plan[0].goal_id != goal.id or abs(now - self._plan[1]) > _MAX_PLAN_AGE_NS:
            return None
        return self._plan[0]

    def left_by_plan(self, goal: Order, max_speed: float, now: int) -> float:
        """m that are left at least of the plan for this goal, since it was made; inf without one. max_speed: m/s."""
        plan = self.plan_for(goal, now)
        return inf if plan is None or plan.reason else plan.length - max_speed * abs(now - plan.stamp) * 1e-9

    def follow_for(self, goal: Order, now: int) -> FollowStatus | None:
        """Local control's status for this goal, or None."""
        if (
            self._follow is None
            or self._follow[0].goal_id != goal.id
            or abs(now - self._follow[1]) > _MAX_FOLLOW_AGE_NS
        ):
            return None
        return self._follow[0]

    def stop_reason(self, now: int) -> Reason | None:
        """The reason of a stop that only the user ends, or None."""
        guard = self.recent_guard(now)
        if guard is None or guard.state not in (GuardState.STOPPED, GuardState.FAULT):
            return None
        return REASONS.get(guard.reason, reasons.ESTOP if guard.state is GuardState.STOPPED else reasons.FAULT)

    def recent_guard(self, now: int) -> GuardStatus | None:
        """The guard's status, where it is recent."""
        if self._guard is None or abs(now - self._guard[1]) > _MAX_GUARD_AGE_NS:
            return None
        return self._guard[0]

    def hold_reason(self, now: int) -> Reason | None:
        """The reason why the robot stands, where neither the path nor local control is the cause; else None."""
        guard = self.recent_guard(now)
        if guard is not None and guard.source == "teleop":
            return reasons.BY_HAND
        if guard is not None and guard.state is GuardState.HOLD and guard.reason in _WAIT_FOR_END:
            return REASONS[guard.reason]
        return self._waiting_reason(now)

    def waited_for(self, now: int) -> tuple[str, ...]:
        """The robots for which this one waits or makes way."""
        told = self._right_of_way
        if told is None or abs(now - told[1]) > _MAX_FOLLOW_AGE_NS or not told[0].active:
            return ()
        return told[0].waits_for

    def _waiting_reason(self, now: int) -> Reason | None:
        """Whether the robot waits for other robots, makes way for them, or does not hear of them."""
        follow = self._follow
        if follow is None or abs(now - follow[1]) > _MAX_FOLLOW_AGE_NS:
            return None
        if follow[0].reason == reasons.TRAFFIC_OLD.code:
            return reasons.TRAFFIC_OLD
        return REASONS[follow[0].reason] if follow[0].reason in _FOR_ROBOTS and self.waited_for(now) else None

    def contact_reason(self, order: Order, now: int) -> Reason | None:
        """The reason of a contact that holds the robot, which backing up ends; None without one.

        None just after the order, too: its way may lead away from the contact, as soon as local control has it.
        """
        if abs(now - order.stamp) < _MAX_ANSWER_NS:
            return None
        guard = self.recent_guard(now)
        held = guard is not None and guard.state is GuardState.HOLD and guard.source != "teleop"
        return REASONS[guard.reason] if guard is not None and held and guard.reason in _CONTACTS else None

    def blocking_reason(self, goal: Order | None, now: int) -> str:
        """The code of the reason that keeps the robot from its goal, the gravest first; empty without one."""
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
