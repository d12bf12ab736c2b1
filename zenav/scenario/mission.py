# SPDX-License-Identifier: Apache-2.0
"""Explores, then drives to goals one after the other: the scenario of demo and benchmark, over any transport."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from shared import reasons, requests
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus
from shared.requests import Explore, Navigate, Reply
from shared.task_state import FINAL_STATES
from zenav.render.floor_plan import GoalMark

Ask = Callable[[requests.Request[Any, Reply], Any], Reply]
"""(row, request) -> reply; UserError where no service answers."""

RETRY_REASONS = {
    reason.code
    for reason in (
        reasons.BUSY, reasons.STARTING, reasons.NO_MAP, reasons.NO_PLAN, reasons.SCAN_OLD, reasons.POSE_OLD,
        reasons.ODOM_OLD, reasons.BASE_SILENT, reasons.BOARD_SILENT, reasons.NOT_RUNNING,
    )
}  # fmt: skip
MAX_REFUSED_S = 30.0  # s that a leg is asked for again while the stack is not ready
MAX_RESTARTS = 3  # times that a leg is given again to a navigator that was restarted
RETRY_PERIOD_S = 1.0  # s between two requests for the same leg
TIME_PER_GOAL_S = 30.0  # s that are kept for each goal when the time for all is bounded


class LegState(StrEnum):
    """How far a leg is."""

    WAITING = "waiting"
    UNDER_WAY = "under way"
    REACHED = "reached"
    FAILED = "failed"
    CUT = "ended for time"  # exploring, so that the goals have theirs


@dataclass(slots=True)
class Leg:
    """One task: exploring (`pose` is None), or a goal in `map`."""

    name: str
    pose: Pose2 | None = None
    state: LegState = LegState.WAITING
    reason: str = ""
    seconds: float = 0.0
    n_recoveries: int = 0


class Mission:
    """`step` is called a few times a second of the stack's time, with the newest status."""

    def __init__(
        self, goals: list[tuple[str, Pose2]], ask: Ask, explores: bool = True, seconds: float = float("inf")
    ) -> None:
        """seconds: for all legs; exploring ends in time for the goals, unless that would take half of it."""
        left = seconds - TIME_PER_GOAL_S * len(goals)
        self._explores_for = left if left > seconds / 2 else float("inf")
        self.legs = [Leg("explore")] if explores else []
        self.legs += [Leg(name, pose) for name, pose in goals]
        self._ask = ask
        self._task_id = -1
        self._begun = 0.0  # s, when the present leg was accepted
        self._first_asked: float | None = None
        self._last_asked = float("-inf")
        self._n_forgotten = 0

    @property
    def leg(self) -> Leg | None:
        """The present leg; None when all are over."""
        return next((leg for leg in self.legs if leg.state in (LegState.WAITING, LegState.UNDER_WAY)), None)

    @property
    def n_reached(self) -> int:
        """Goals that were reached; exploring is none."""
        return sum(leg.state is LegState.REACHED for leg in self.legs if leg.pose is not None)

    @property
    def n_goals(self) -> int:
        return sum(leg.pose is not None for leg in self.legs)

    @property
    def explored(self) -> bool:
        """Exploring, where it was asked for, ended because nothing reachable was left, or nothing of its time."""
        return all(leg.state in (LegState.REACHED, LegState.CUT) for leg in self.legs if leg.pose is None)

    @property
    def goal_marks(self) -> list[GoalMark]:
        """The goals for the picture of the run."""
        return [
            GoalMark(leg.name, leg.pose, leg.state is LegState.REACHED) for leg in self.legs if leg.pose is not None
        ]

    def step(self, now: float, nav: NavStatus | None) -> None:
        """now: s on the stack's clock."""
        leg = self.leg
        if leg is None:
            return
        if leg.state is LegState.WAITING:
            if now - self._last_asked >= RETRY_PERIOD_S:
                self._request(leg, now)
            return
        if nav is None or nav.stamp / 1e9 < self._begun:
            return
        leg.seconds = now - self._begun
        leg.n_recoveries = nav.n_recoveries
        if nav.task_id < self._task_id:
            self._forgotten(leg)
        elif nav.task_id > self._task_id:
            self._over(leg, LegState.FAILED, "another task took its place")
        elif nav.state in FINAL_STATES or nav.state is NavState.IDLE:
            reached = nav.state is NavState.REACHED
            detail = nav.reason + (f": {nav.detail}" if nav.detail else "")
            self._over(leg, LegState.REACHED if reached else LegState.FAILED, detail)
        elif leg.pose is None and leg.seconds > self._explores_for:
            self._over(leg, LegState.CUT, "")  # the next leg's request takes its place

    def _request(self, leg: Leg, now: float) -> None:
        stamp = round(now * 1e9)
        self._last_asked = now
        self._first_asked = now if self._first_asked is None else self._first_asked
        try:
            if leg.pose is None:
                reply = self._ask(requests.EXPLORE, Explore(stamp))
            else:
                reply = self._ask(requests.NAVIGATE, Navigate(stamp, (leg.pose,), 0.0, 1, False))
        except UserError as error:
            reply = Reply(stamp, False, reasons.NOT_RUNNING.code, error.what)
        if reply.accepted:
            leg.state, self._task_id, self._begun, self._first_asked = LegState.UNDER_WAY, reply.task_id, now, None
        elif reply.reason not in RETRY_REASONS or now - self._first_asked > MAX_REFUSED_S:
            self._over(leg, LegState.FAILED, reply.reason + (f": {reply.detail}" if reply.detail else ""))

    def _forgotten(self, leg: Leg) -> None:
        """The navigator was restarted and knows nothing of the task."""
        self._n_forgotten += 1
        if self._n_forgotten > MAX_RESTARTS:
            self._over(leg, LegState.FAILED, reasons.SERVICE_DIED.code)
        else:
            leg.state = LegState.WAITING

    def _over(self, leg: Leg, state: LegState, reason: str) -> None:
        leg.state, leg.reason = state, reason
        self._first_asked, self._n_forgotten = None, 0
