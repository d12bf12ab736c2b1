# SPDX-License-Identifier: Apache-2.0
"""One attempt to drive to a pose: progress, the need of a recovery, and failure, each with a clock."""

from dataclasses import dataclass
from enum import StrEnum
from math import ceil, inf
from typing import ClassVar

from pydantic import Field

from shared import reasons
from shared.config import Section
from shared.geometry import Pose2
from shared.messages import FollowState, FollowStatus, Path
from shared.reasons import REASONS, Reason


class GoalAttemptConfig(Section):
    """Time limits of an attempt."""

    RENAMED: ClassVar[dict[str, str]] = {"least_speed": "min_speed"}

    progress: float = Field(0.1, gt=0, le=5, description="m of approach that count as progress")
    progress_time: float = Field(10.0, gt=0, le=300, description="s without progress until a recovery")
    blocked_time: float = Field(4.0, gt=0, le=300, description="s that local control is blocked until a recovery")
    refused_time: float = Field(
        1.0, ge=0, le=60, description="s that the planner refuses the goal itself until the task fails"
    )
    unreachable_time: float = Field(
        3.0,
        ge=0,
        le=300,
        description="s without a path to the goal until a recovery, or failure if there never was one",
    )
    start_time: float = Field(20.0, gt=0, le=600, description="s without a map or a pose on it until the task fails")
    hold_time: float = Field(
        30.0, gt=0, le=3600, description="s that the robot waits for a missing input until the task fails"
    )
    right_of_way_time: float = Field(
        180.0, gt=0, le=3600, description="s that the robot waits for other robots until the task fails"
    )
    detours: int = Field(
        4,
        ge=1,
        le=100,
        description="times that the path gets longer, as by a gap that opens and closes",
    )
    base_time: float = Field(60.0, gt=0, le=3600, description="minimum of the s that any drive may take")
    min_speed: float = Field(
        0.1, gt=0, le=5, description="m/s: a drive may take base_time and the time of its longest plan at this speed"
    )

    def with_time_share(self, share: float) -> "GoalAttemptConfig":
        """The same limits with a share of the times that an unreachable goal costs."""
        shortened = ("progress_time", "blocked_time", "unreachable_time")
        times = {name: share * getattr(self, name) for name in shortened}
        return self.model_copy(update={**times, "detours": ceil(share * self.detours)})


class AttemptAction(StrEnum):
    """What an attempt needs next."""

    GO_ON = "go_on"
    RECOVER = "recover"
    FAIL = "fail"


_GOAL_REFUSED = {reasons.GOAL_OUTSIDE.code, reasons.GOAL_BLOCKED.code, reasons.GOAL_UNKNOWN.code}
_GOAL_FORBIDDEN = {reasons.GOAL_KEEP_OUT.code}
"""Refusals of a goal that no recovery changes."""
_WAITS = {reasons.RIGHT_OF_WAY, reasons.GIVING_WAY}
_NOT_READY = {reason.code for reason in (reasons.NO_MAP, reasons.POSE_OLD, reasons.POSE_LOST, reasons.START_OUTSIDE)}


@dataclass(slots=True)
class GoalAttempt:
    """State of an attempt. The clocks count s in which the robot could drive: not paused, stopped or held."""

    target: Pose2
    any_heading: bool
    min_left: float = inf  # m left at best
    gained: float = 0.0  # m closer since the last recovery
    no_progress_time: float = 0.0  # s without progress
    blocked_for: float = 0.0  # s
    refused_for: float = 0.0  # s
    waited_for: float = 0.0  # s, for other robots
    held_for: float = 0.0  # s, for another reason than the path and other robots
    hold_reason: Reason = reasons.NO_PROGRESS  # why it stood last
    age: float = 0.0  # s
    max_plan_length: float = 0.0  # m, plan
    n_detours: int = 0  # since the last recovery
    was_planned: bool = False
    has_progressed: bool = False  # came closer since the last recovery
    n_recoveries: int = 0

    def reset_clocks(self) -> None:
        """Restarts the clocks after a recovery. What is known of the goal stays."""
        self.no_progress_time = self.blocked_for = self.refused_for = self.gained = 0.0
        self.waited_for = self.held_for = 0.0
        self.min_left, self.has_progressed, self.n_detours = inf, False, 0

    def add_hold_time(self, seconds: float, reason: Reason) -> None:
        """Counts time in which another reason than the path held the robot. A wait for robots has its own clock."""
        self.hold_reason = reason
        if reason in _WAITS:
            self.waited_for += seconds
        else:
            self.held_for += seconds

    def update(self, seconds: float, left: float, plan: Path | None, follow: FollowStatus | None, step: float) -> None:
        """Counts driving time.

        left: m to the goal. plan, follow: the latest ones for it, if any. step: m that are progress.
        """
        self.age += seconds
        self.waited_for = self.held_for = 0.0
        refused_for = plan is not None and bool(plan.reason)
        self.no_progress_time += 0.0 if refused_for else seconds
        self.refused_for = self.refused_for + seconds if refused_for else 0.0
        if plan is not None and not plan.reason:
            self.was_planned = True
            self.max_plan_length = max(self.max_plan_length, plan.length)
        self.blocked_for = self.blocked_for + seconds if follow and follow.state is FollowState.BLOCKED else 0.0
        if refused_for or plan is None:
            return
        if left < self.min_left - step:
            if self.min_left < inf:
                self.gained += self.min_left - left
                self.has_progressed = True
            self.min_left, self.no_progress_time = left, 0.0
        elif left > self.min_left + 1.0:  # another, longer path: progress counts from here on
            self.min_left = left
            self.n_detours += 1

    def next_action(
        self, plan: Path | None, follow: FollowStatus | None, config: GoalAttemptConfig
    ) -> tuple[AttemptAction, Reason]:
        """The next action and its reason."""
        if self.waited_for > config.right_of_way_time or self.held_for > config.hold_time:
            return AttemptAction.FAIL, self.hold_reason
        if self.age > config.base_time + self.max_plan_length / config.min_speed:
            return AttemptAction.FAIL, reasons.NO_PROGRESS
        if plan is not None and plan.reason:
            return self._on_refusal(REASONS.get(plan.reason, reasons.NO_PLAN), config)
        if follow is not None and follow.state is FollowState.FAILED:
            return AttemptAction.RECOVER, REASONS.get(follow.reason, reasons.BLOCKED)
        if follow is not None and self.blocked_for >= config.blocked_time:
            return AttemptAction.RECOVER, REASONS.get(follow.reason, reasons.BLOCKED)
        if self.n_detours >= config.detours:
            return AttemptAction.RECOVER, reasons.NO_WAY_THROUGH
        if self.no_progress_time >= config.progress_time:
            return AttemptAction.RECOVER, reasons.NO_PROGRESS if plan is not None else reasons.NO_PLAN
        return AttemptAction.GO_ON, reasons.NO_PROGRESS

    def _on_refusal(self, reason: Reason, config: GoalAttemptConfig) -> tuple[AttemptAction, Reason]:
        if reason.code in _NOT_READY:
            return (AttemptAction.FAIL if self.refused_for >= config.start_time else AttemptAction.GO_ON), reason
        if reason.code in _GOAL_FORBIDDEN or (reason.code in _GOAL_REFUSED and not self.was_planned):
            return (AttemptAction.FAIL if self.refused_for >= config.refused_time else AttemptAction.GO_ON), reason
        if self.refused_for < config.unreachable_time:
            return AttemptAction.GO_ON, reason
        stuck = reason in (reasons.START_BLOCKED, reasons.NO_ROOM_TO_TURN)  # from another place there may be a path
        return (AttemptAction.RECOVER if self.was_planned or stuck else AttemptAction.FAIL), reason
