# SPDX-License-Identifier: Apache-2.0
"""The status message of the navigator: remaining distance and time, and the reason why the robot stands."""

from services.navigator.motion import SingleMotion
from services.navigator.navigation import Navigation
from services.navigator.route import Route
from shared import reasons
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus
from shared.reasons import REASONS

_SPEED_TIME_S = 10.0  # time constant of the mean speed
_STANDING_SPEED = 0.02  # m/s
_MIN_SPEED = 0.05  # m/s, for the remaining time


class Speedometer:
    """The mean speed while driving, m/s."""

    def __init__(self, guess: float) -> None:
        self.speed = guess

    def passed(self, seconds: float, velocity: float) -> None:
        """Takes a velocity (m/s) that lasted `seconds`."""
        if abs(velocity) > _STANDING_SPEED:
            self.speed += (abs(velocity) - self.speed) * min(seconds / _SPEED_TIME_S, 1.0)

    def time_for(self, metres: float) -> float:
        """s to drive so far."""
        return min(metres / max(self.speed, _MIN_SPEED), 1e7)


def status(navigation: Navigation, speedometer: Speedometer, now: int) -> NavStatus:
    """The message `nav/status`."""
    task, attempt = navigation.task, navigation.attempt
    route = task if isinstance(task, Route) else None
    motion = task if isinstance(task, SingleMotion) else None
    left = (navigation.left(attempt, now) if attempt else 0.0) + (route.beyond() if route else 0.0)
    left = motion.left if motion else min(left, 1e6)
    stays = route.stays_beyond() + (route.dwell if attempt else navigation.dwell) if route else 0.0
    code = _reason_code(navigation, now)
    reason = REASONS.get(code)
    reason_detail = f"{reason.text}: {reason.hint}" if reason else ""
    if reason in (reasons.RIGHT_OF_WAY, reasons.GIVING_WAY) and (robots := navigation.statuses.waited_for(now)):
        reason_detail = f"{'waits' if reason is reasons.RIGHT_OF_WAY else 'makes way'} for {', '.join(robots)}"
    return NavStatus(
        stamp=now,
        task_id=navigation.task_id,
        state=_state(navigation),
        recovery=navigation.recovery,
        reason=code,
        detail=navigation.detail or (_recovery_text(navigation) if navigation.recovery else reason_detail),
        goal=attempt.target if attempt else route.target if route else Pose2(),
        distance_left=left,
        time_left=min(speedometer.time_for(left) + max(stays, 0.0), 1e7),
        waypoint=route.index if route else 0,
        n_waypoints=len(route.poses) if route else 0,
        n_recoveries=navigation.recoveries.n_used,
        round=route.round if route else 0,
        n_rounds=route.loops if route else 0,
    )


def _recovery_text(navigation: Navigation) -> str:
    """The present recovery, its number, and its cause."""
    recoveries = navigation.recoveries
    return f"{navigation.recovery}, {recoveries.n_tried} of {len(recoveries.recovery_steps)}: {recoveries.last.text}"


def _state(navigation: Navigation) -> NavState:
    if navigation.task is None:
        return navigation.state
    if navigation.paused:
        return NavState.PAUSED
    return NavState.RECOVERING if navigation.recovery else navigation.state


def _reason_code(navigation: Navigation, now: int) -> str:
    """The code of the reason that blocks the task, or that ended the last one."""
    if navigation.task is None:
        return navigation.reason.code if navigation.reason else ""
    if navigation.paused:
        return reasons.PAUSED.code
    if isinstance(navigation.task, SingleMotion):
        return navigation.task.reason.code if navigation.task.reason else ""
    if navigation.suspended:
        return reasons.POSE_LOST.code
    if navigation.jumped:
        return reasons.POSE_JUMPED.code
    if isinstance(navigation.task, Route) and navigation.attempt is None:
        return reasons.DWELLING.code
    driving = navigation.order if navigation.attempt and not navigation.action else None
    recovering_from = navigation.recoveries.last.code if navigation.recovery else ""
    return navigation.statuses.blocking_reason(driving, now) or recovering_from
