# SPDX-License-Identifier: Apache-2.0
"""One drive to one pose: does it go on, does it need a recovery, is it hopeless. Every answer has a clock."""

from dataclasses import dataclass
from enum import StrEnum
from math import ceil, inf

from pydantic import Field

from shared import reasons
from shared.config import Section
from shared.geometry import Pose2
from shared.messages import FollowState, FollowStatus, Path
from shared.reasons import REASONS, Reason


class LegConfig(Section):
    """How long the navigator waits for what."""

    progress: float = Field(0.1, gt=0, le=5, description="m closer to the goal that count as progress")
    progress_time: float = Field(10.0, gt=0, le=300, description="s without progress until a recovery")
    blocked_time: float = Field(4.0, gt=0, le=300, description="s that local control is blocked until a recovery")
    refused_time: float = Field(
        1.0, ge=0, le=60, description="s that the planner refuses the goal itself until the task fails"
    )
    unreachable_time: float = Field(
        3.0, ge=0, le=300, description="s without a way to the goal until a recovery, or failure if there never was one"
    )
    start_time: float = Field(20.0, gt=0, le=600, description="s without a map or a pose until the task fails")
    hold_time: float = Field(
        30.0, gt=0, le=3600, description="s that the guard holds for a missing input until the task fails"
    )
    detours: int = Field(
        4,
        ge=1,
        le=100,
        description="times that the way turns out longer, as by a gap that comes and goes",
    )
    base_time: float = Field(60.0, gt=0, le=3600, description="s that any drive may take at least")
    least_speed: float = Field(
        0.1, gt=0, le=5, description="m/s: a drive may take base_time and its longest plan at this speed"
    )

    def hurried(self, share: float) -> "LegConfig":
        """The same with that share of the times which a hopeless goal costs."""
        shortened = ("progress_time", "blocked_time", "unreachable_time")
        times = {name: share * getattr(self, name) for name in shortened}
        return self.model_copy(update={**times, "detours": ceil(share * self.detours)})


class Verdict(StrEnum):
    """What a leg needs."""

    GO_ON = "go_on"
    RECOVER = "recover"
    FAIL = "fail"


_REFUSED = {reasons.GOAL_OUTSIDE.code, reasons.GOAL_BLOCKED.code, reasons.GOAL_UNKNOWN.code}
_FORBIDDEN = {reasons.GOAL_KEEP_OUT.code}
"""Of a goal that no recovery makes a goal again."""
_STARTING = {reasons.NO_MAP.code, reasons.POSE_OLD.code, reasons.POSE_LOST.code}


@dataclass(slots=True)
class Leg:
    """The clocks count seconds in which the robot could have driven: not while it is paused, stopped or held."""

    target: Pose2
    any_heading: bool
    best: float = inf  # m left at best
    gained: float = 0.0  # m closer since the last recovery
    idle: float = 0.0  # s without progress
    blocked: float = 0.0  # s
    refused: float = 0.0  # s
    held: float = 0.0  # s
    holding: Reason = reasons.NO_PROGRESS  # why it was held
    age: float = 0.0  # s
    longest: float = 0.0  # m, plan
    n_detours: int = 0  # since the last recovery
    planned: bool = False
    moving: bool = False  # came closer since the last recovery
    n_recoveries: int = 0

    def restarted(self) -> None:
        """A recovery was made: its clocks start anew, what was learnt of the goal stays."""
        self.idle = self.blocked = self.refused = self.held = self.gained = 0.0
        self.best, self.moving, self.n_detours = inf, False, 0

    def waited(self, seconds: float, reason: Reason) -> None:
        """Time passed in which something else than the way held the robot."""
        self.held += seconds
        self.holding = reason

    def passed(self, seconds: float, left: float, plan: Path | None, follow: FollowStatus | None, step: float) -> None:
        """Time passed; left: m to the goal; plan, follow: the latest about it, if any; step: m that are progress."""
        self.age += seconds
        self.held = 0.0
        refused = plan is not None and bool(plan.reason)
        self.idle += 0.0 if refused else seconds
        self.refused = self.refused + seconds if refused else 0.0
        if plan is not None and not plan.reason:
            self.planned = True
            self.longest = max(self.longest, plan.length)
        self.blocked = self.blocked + seconds if follow and follow.state is FollowState.BLOCKED else 0.0
        if refused or plan is None:
            return
        if left < self.best - step:
            if self.best < inf:
                self.gained += self.best - left
                self.moving = True
            self.best, self.idle = left, 0.0
        elif left > self.best + 1.0:  # another, longer way: measured from here on
            self.best = left
            self.n_detours += 1

    def verdict(self, plan: Path | None, follow: FollowStatus | None, config: LegConfig) -> tuple[Verdict, Reason]:
        """What is needed now, and why."""
        if self.held > config.hold_time:
            return Verdict.FAIL, self.holding
        if self.age > config.base_time + self.longest / config.least_speed:
            return Verdict.FAIL, reasons.NO_PROGRESS
        if plan is not None and plan.reason:
            return self._on_refusal(REASONS.get(plan.reason, reasons.NO_PLAN), config)
        if follow is not None and follow.state is FollowState.FAILED:
            return Verdict.RECOVER, REASONS.get(follow.reason, reasons.BLOCKED)
        if follow is not None and self.blocked >= config.blocked_time:
            return Verdict.RECOVER, REASONS.get(follow.reason, reasons.BLOCKED)
        if self.n_detours >= config.detours:
            return Verdict.RECOVER, reasons.NO_WAY_THROUGH
        if self.idle >= config.progress_time:
            return Verdict.RECOVER, reasons.NO_PROGRESS if plan is not None else reasons.NO_PLAN
        return Verdict.GO_ON, reasons.NO_PROGRESS

    def _on_refusal(self, reason: Reason, config: LegConfig) -> tuple[Verdict, Reason]:
        if reason.code in _STARTING:
            return (Verdict.FAIL if self.refused >= config.start_time else Verdict.GO_ON), reason
        if reason.code in _FORBIDDEN or (reason.code in _REFUSED and not self.planned):
            return (Verdict.FAIL if self.refused >= config.refused_time else Verdict.GO_ON), reason
        if self.refused < config.unreachable_time:
            return Verdict.GO_ON, reason
        stuck = reason in (reasons.START_BLOCKED, reasons.NO_ROOM_TO_TURN)  # from elsewhere there may be a way
        return (Verdict.RECOVER if self.planned or stuck else Verdict.FAIL), reason
