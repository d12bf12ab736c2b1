# SPDX-License-Identifier: Apache-2.0
"""What people are told: how far it is, how long it takes, and why the robot stands when it stands."""

from services.navigator.navigation import Navigation
from services.navigator.route import Route
from shared import reasons
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus
from shared.reasons import REASONS

_SPEED_TIME_S = 10.0  # s over which the recent speed is averaged
_STANDING_SPEED = 0.02  # m/s
_MIN_SPEED = 0.05  # m/s assumed for the time left


class Speedometer:
    """The recent speed while driving, m/s."""

    def __init__(self, guess: float) -> None:
        self.speed = guess

    def passed(self, seconds: float, velocity: float) -> None:
        if abs(velocity) > _STANDING_SPEED:
            self.speed += (abs(velocity) - self.speed) * min(seconds / _SPEED_TIME_S, 1.0)

    def time_for(self, metres: float) -> float:
        """s"""
        return min(metres / max(self.speed, _MIN_SPEED), 1e7)


def status(navigation: Navigation, speedometer: Speedometer, now: int) -> NavStatus:
    """The message that says it all."""
    task, attempt = navigation.task, navigation.attempt
    route = task if isinstance(task, Route) else None
    left = (navigation.left(attempt, now) if attempt else 0.0) + (route.beyond() if route else 0.0)
    left = min(left, 1e6)
    stays = route.stays_beyond() + (route.dwell if attempt else navigation.dwell) if route else 0.0
    code = _reason_code(navigation, now)
    known = REASONS.get(code)
    words = f"{known.text}: {known.mend}" if known else ""
    return NavStatus(
        now,
        navigation.task_id,
        _state(navigation),
        navigation.recovery,
        code,
        navigation.detail or (_recovery_text(navigation) if navigation.recovery else words),
        attempt.target if attempt else route.target if route else Pose2(),
        left,
        min(speedometer.time_for(left) + max(stays, 0.0), 1e7),
        route.index if route else 0,
        len(route.poses) if route else 0,
        navigation.recoveries.n_used,
        route.round if route else 0,
        route.loops if route else 0,
    )


def _recovery_text(navigation: Navigation) -> str:
    """Which recovery it is, which one of how many, and what for."""
    recoveries = navigation.recoveries
    return f"{navigation.recovery}, {recoveries.n_tried} of {len(recoveries.recovery_steps)}: {recoveries.last.text}"


def _state(navigation: Navigation) -> NavState:
    if navigation.task is None:
        return navigation.state
    if navigation.paused:
        return NavState.PAUSED
    return NavState.RECOVERING if navigation.recovery else navigation.state


def _reason_code(navigation: Navigation, now: int) -> str:
    """The code of what keeps the task from going on, or of how the last one ended."""
    if navigation.task is None:
        return navigation.reason.code if navigation.reason else ""
    if navigation.paused:
        return reasons.PAUSED.code
    if navigation.suspended:
        return reasons.POSE_LOST.code
    if navigation.jumped:
        return reasons.POSE_JUMPED.code
    if isinstance(navigation.task, Route) and navigation.attempt is None:
        return reasons.DWELLING.code
    driving = navigation.goal if navigation.attempt and not navigation.action else None
    recovering_from = navigation.recoveries.last.code if navigation.recovery else ""
    return navigation.statuses.blocking_reason(driving, now) or recovering_from
