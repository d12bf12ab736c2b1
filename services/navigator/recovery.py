# SPDX-License-Identifier: Apache-2.0
"""The sequence of recoveries of a robot without progress, and when it starts again."""

from dataclasses import dataclass
from math import inf

from pydantic import Field

from shared import reasons
from shared.config import Drive, Section
from shared.geometry import Pose2
from shared.messages import RecoveryKind
from shared.reasons import Reason


class RecoveryConfig(Section):
    """The recoveries, each tried once: replan, clear the costmap, back up, turn left, turn right, wait."""

    back_up: float = Field(0.3, ge=0, le=2, description="m straight back; 0 leaves it out")
    turn: float = Field(1.57, ge=0, le=6.28, description="rad in place, left and then right; 0 leaves it out")
    wait: float = Field(5.0, ge=0, le=120, description="s of standing still; 0 leaves it out")
    deadline: float = Field(8.0, gt=0, le=60, description="s that backing up or turning may take")
    earned_by: float = Field(
        0.7, gt=0, le=20, description="m that the robot must move and approach the goal for the sequence to start again"
    )


@dataclass(frozen=True, slots=True)
class RecoveryStep:
    """One recovery. kind: None when the robot drives on at once. takes: s after which any other one ends."""

    name: str
    kind: RecoveryKind | None = None
    amount: float = 0.0
    clear_costmap: bool = False
    takes: float = 0.0

    @property
    def moves(self) -> bool:
        return self.kind in (RecoveryKind.BACK_UP, RecoveryKind.TURN)


def recovery_steps(config: RecoveryConfig, drive: Drive) -> tuple[RecoveryStep, ...]:
    """The recoveries in order, without those that the drive cannot do."""
    every = (
        RecoveryStep("replan"),
        RecoveryStep("clear_costmap", clear_costmap=True),
        RecoveryStep("back_up", RecoveryKind.BACK_UP, config.back_up, takes=config.deadline),
        RecoveryStep("turn_left", RecoveryKind.TURN, config.turn, takes=config.deadline),
        RecoveryStep("turn_right", RecoveryKind.TURN, -config.turn, takes=config.deadline),
        RecoveryStep("wait", RecoveryKind.WAIT, config.wait, takes=config.wait + 1),
    )
    cannot = {RecoveryKind.BACK_UP} if drive.max_reverse_speed == 0 else set()
    cannot |= set() if drive.turns_in_place else {RecoveryKind.TURN}
    return tuple(s for s in every if s.kind is None or (s.amount and s.kind not in cannot))


class RecoverySequence:
    """The next recovery. It starts again only after real progress."""

    def __init__(self, config: RecoveryConfig, drive: Drive) -> None:
        self.configure(config, drive)
        self.n_used = 0  # of the task
        self.last: Reason = reasons.NO_PROGRESS  # why the last one was needed
        self._next = 0
        self._from: Pose2 | None = None

    def configure(self, config: RecoveryConfig, drive: Drive) -> None:
        """Takes settings. How many steps were tried stays."""
        self.config = config
        self.recovery_steps = recovery_steps(config, drive)

    @property
    def used_up(self) -> bool:
        """Whether all were tried since the last real progress."""
        return self._next >= len(self.recovery_steps)

    @property
    def n_tried(self) -> int:
        """Number of steps since the last real progress, with those that were skipped."""
        return self._next

    def next(self, reason: Reason, pose: Pose2 | None) -> RecoveryStep | None:
        """The next recovery for a reason, or None where all were tried."""
        self.last = reason
        while not self.used_up and _is_useless(self.recovery_steps[self._next], reason):
            self._next += 1
        if self.used_up:
            return None
        step = self.recovery_steps[self._next]
        self._next += 1
        self.n_used += 1
        self._from = pose
        return step

    def progressed(self, pose: Pose2, gained: float) -> None:
        """Starts the sequence again where the robot has moved and come closer by `earned_by` m since the last
        recovery.
        """
        away = self._from.distance(pose) if self._from else inf
        if self._next and min(away, gained) >= self.config.earned_by:
            self._next = 0


def _is_useless(step: RecoveryStep, reason: Reason) -> bool:
    """Whether a step does not help: a robot that touches something must move, and no motion makes a path."""
    if reason in (reasons.BUMPER, reasons.CLIFF):
        return not step.moves
    return step.moves and reason in (reasons.UNREACHABLE, reasons.NO_PLAN)
