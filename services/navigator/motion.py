# SPDX-License-Identifier: Apache-2.0
"""A single motion as a task: a turn on the spot, or a straight drive, by an amount and without a goal on the map.

As Nav2's behaviors Spin, BackUp and DriveOnHeading, it fails where something is in the way. Local control drives it
and tests the space for it, as one of its recoveries.
"""

from dataclasses import dataclass

from services.navigator.status_cache import StatusCache
from shared import reasons
from shared.config import Drive
from shared.messages import FollowState, GuardState, NavState, RecoveryKind
from shared.orders import Order
from shared.reasons import REASONS, Reason

DEFAULT_S = 30.0  # that a motion may take
MAX_BLOCKED_S = 1.0  # after which it fails
MAX_GROWTH = 0.2  # rad or m that may be left more than before: local control that was restarted begins it again
Ending = tuple[NavState, Reason | None]


@dataclass(slots=True)
class SingleMotion:
    """kind: TURN, or BACK_UP with a negative amount for ahead.  amount: rad or m.  seconds: that are left for it."""

    kind: RecoveryKind
    amount: float
    seconds: float
    left: float  # rad or m, not negative
    blocked_for: float = 0.0  # s
    reason: Reason | None = None  # why it stands

    def ending(self, seconds: float, order: Order | None, statuses: StatusCache, now: int) -> Ending | None:
        """How it ends after further `seconds`, or None while it goes on. order: the one that was published for it."""
        follow = statuses.follow_for(order, now) if order is not None else None
        if follow is not None and follow.distance_left:
            if follow.distance_left > self.left + MAX_GROWTH:
                return NavState.FAILED, reasons.INTERRUPTED
            self.left = follow.distance_left
        if follow is not None and follow.state is FollowState.ARRIVED:
            return NavState.REACHED, None
        if follow is not None and follow.state is FollowState.FAILED:
            return NavState.FAILED, _named(follow.reason)
        guard = statuses.recent_guard(now)
        held = guard is not None and guard.state is GuardState.HOLD and guard.reason != reasons.NO_COMMAND.code
        is_blocked = follow is not None and follow.state is FollowState.BLOCKED
        if guard is not None and held:
            self.reason = _named(guard.reason)
        else:
            self.reason = _named(follow.reason) if follow is not None and is_blocked else None
        self.blocked_for = self.blocked_for + seconds if self.reason is not None else 0.0
        self.seconds -= seconds
        if self.blocked_for >= MAX_BLOCKED_S:
            return NavState.FAILED, self.reason
        return (NavState.FAILED, self.reason or reasons.MOTION_TOO_LONG) if self.seconds <= 0 else None


def turn(angle: float, seconds: float) -> SingleMotion:
    """A turn by `angle` rad. seconds: that it may take; 0: as many as usual."""
    return SingleMotion(RecoveryKind.TURN, angle, seconds or DEFAULT_S, abs(angle))


def straight(distance: float, seconds: float) -> SingleMotion:
    """A drive by `distance` m, negative: backward."""
    return SingleMotion(RecoveryKind.BACK_UP, -distance, seconds or DEFAULT_S, abs(distance))


def refusal(motion: SingleMotion, drive: Drive) -> Reason | None:
    """Why a drive cannot do it; None where it can."""
    if motion.kind is RecoveryKind.TURN:
        return None if drive.turns_in_place else reasons.NO_TURN_IN_PLACE
    return reasons.NO_REVERSE if motion.amount > 0 and drive.max_reverse_speed == 0 else None


def _named(code: str) -> Reason:
    """The reason for the user: "no safe way forward" has the hint of a goal, with recoveries to come."""
    return reasons.MOTION_BLOCKED if code == reasons.BLOCKED.code else REASONS.get(code, reasons.MOTION_BLOCKED)
