# SPDX-License-Identifier: Apache-2.0
"""The plan that is followed: the newest message of the planner, and whether it is valid for the present goal."""

from services.local_ctrl.inputs import AgesConfig
from services.local_ctrl.local_plan import LocalPlan
from services.local_ctrl.manoeuvres import ControlOutcome
from shared import reasons
from shared.messages import FollowState, Goal, Path
from shared.types import NS_PER_S


class ReceivedPlan:
    """The planner's last message, and the local plan made of the last one for the present goal. Times are ns."""

    def __init__(self, ages: AgesConfig) -> None:
        self.ages = ages
        self.message: Path | None = None
        self.local_plan: LocalPlan | None = None
        self._goal: Goal | None = None
        self.goal_since = 0  # ns

    def set_goal(self, goal: Goal, now: int, keeps_plan: bool) -> None:
        """Begins a goal. keeps_plan: the plan of the goal before is followed until the new one arrives."""
        self._goal, self.goal_since = goal, now
        if not keeps_plan:
            self.local_plan = None
        self._update()

    def clear_goal(self) -> None:
        """Ends the goal: a recovery begins, and no plan is followed."""
        self._goal = self.local_plan = None

    def set_message(self, path: Path) -> None:
        """Takes a message of the planner, also one for another goal."""
        self.message = path
        self._update()

    def is_for(self, goal: Goal) -> bool:
        """Whether the last message is for this goal. Otherwise the plan of the goal before is followed for a moment."""
        return self.message is not None and self.message.goal_id == goal.id

    def fault(self, goal: Goal, jumped_at: int, now: int) -> str | None:
        """Why no plan can be followed, as a code of reasons.py, or None. jumped_at: ns of the last jump of the pose."""
        reason = self._message_fault(jumped_at, now)
        if self.is_for(goal):
            return reason
        waits = self.local_plan is not None and now - self.goal_since < self.ages.plan_for_new_goal * NS_PER_S
        return None if waits and reason is None else reasons.NO_PLAN.code

    def _message_fault(self, jumped_at: int, now: int) -> str | None:
        """Why the last message cannot be followed, for whichever goal, as a code of reasons.py, or None."""
        path = self.message
        if path is None:
            return reasons.NO_PLAN.code
        if abs(now - path.stamp) > self.ages.plan * NS_PER_S:
            return reasons.PLAN_OLD.code
        if path.stamp < jumped_at:
            return reasons.POSE_JUMPED.code
        return path.reason or (None if len(path.xs) else reasons.NO_PLAN.code)

    def _update(self) -> None:
        path = self.message
        if path is not None and self._goal is not None and path.goal_id == self._goal.id and len(path.xs):
            plan = LocalPlan(path.xs, path.ys, float(path.yaws[-1]))
            if self.local_plan is None or not plan.same_as(self.local_plan):
                self.local_plan = plan


def on_plan_before(outcome: ControlOutcome, plan: LocalPlan, goal: Goal) -> ControlOutcome:
    """The outcome for a goal while the plan of the goal before is followed.

    Its end is not the goal: from there the straight way is added to what is left, m.
    """
    outcome = outcome._replace(left=outcome.left + plan.end.distance(goal.map_from_goal))
    if outcome.state in (FollowState.ARRIVED, FollowState.FAILED):
        return outcome._replace(state=FollowState.FOLLOWING, reason="")
    return outcome
