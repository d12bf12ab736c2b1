# SPDX-License-Identifier: Apache-2.0
"""The navigator's recoveries and motions: straight or turning in place by an amount, with a test of the space for it.

A negative amount of BACK_UP is straight ahead.

After Nav2's behaviors BackUp, Spin and Wait. Spin has the same profile, sqrt(2 a s), of the rate over the angle s to
go. Here driving has it too, with a reserve for delay. That a robot too near an obstacle may leave it is our own.
"""

from math import copysign, cos, inf, sin, sqrt
from typing import NamedTuple

from numba import njit
from pydantic import Field

from services.local_ctrl.footprint import Footprint, clearance, collides
from services.local_ctrl.local_costmap import LocalCostmap
from services.local_ctrl.rollout import DT, Limits, Motion, speed_after, turn_rate_after
from shared import reasons
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.messages import FollowState, Recovery, RecoveryKind
from shared.types import Bools, Float32s

BRAKING_SHARE = 0.6  # of the drive's braking that the speed profile uses: the rest is reserve for delay
CHECK_STEP_M = 0.02  # along the rim between tested poses
TURN_LOOKAHEAD_RAD = 0.5  # that must be free while turning
MAX_CLEARANCE_LOSS_M = 0.005  # of a robot that starts too near an obstacle, on its way out: the effect of the grid
BACK_UP_LOOKAHEAD_M = 0.1  # that must be free beyond the braking distance while backing up


class ManoeuvreConfig(Section):
    """The navigator's recoveries."""

    back_up_speed: float = Field(0.12, ge=0.02, le=2, description="m/s")
    turn_rate: float = Field(1.0, ge=0.1, le=10, description="rad/s")


class ControlOutcome(NamedTuple):
    """The command, m/s and rad/s, and the state of the goal. `reason`: a code of reasons.py, or empty. `left`: m or
    rad.
    """

    v: float
    w: float
    state: FollowState
    reason: str = ""
    left: float = 0.0


def braking(motion: Motion, limits: Limits, state: FollowState, reason: str = "", left: float = 0.0) -> ControlOutcome:
    """The command that stops as fast as the limits allow. left: m or rad to go, of the outcome."""
    v, w = speed_after(motion.v, 0.0, limits, DT), turn_rate_after(motion.w, 0.0, limits, DT)
    return ControlOutcome(v, w, state, reason, left)


class Manoeuvre:
    """One BACK_UP, TURN or WAIT, from the pose `start` in `odom` at `now` (ns). After its end it returns ARRIVED."""

    def __init__(self, recovery: Recovery, start: Pose2, now: int, config: ManoeuvreConfig) -> None:
        self.recovery, self.start, self.since, self.config = recovery, start, now, config
        self.turned, self.last_yaw = 0.0, start.yaw
        self.done = False

    def step(self, costmap: LocalCostmap, motion: Motion, limits: Limits, shape: Footprint, now: int) -> ControlOutcome:
        """The command of one tick. motion: in `odom`, when the command acts. now: ns."""
        self.turned += wrapped(motion.pose.yaw - self.last_yaw)
        self.last_yaw = motion.pose.yaw
        if self.done:
            return braking(motion, limits, FollowState.ARRIVED)
        if self.recovery.kind is RecoveryKind.TURN and not limits.spins:
            return braking(motion, limits, FollowState.FAILED, reasons.NO_TURN_IN_PLACE.code)
        if self.recovery.kind is RecoveryKind.BACK_UP and self.recovery.amount > 0 and limits.v_min >= 0:
            return braking(motion, limits, FollowState.FAILED, reasons.NO_REVERSE.code)
        x, y, yaw = motion.pose.x - costmap.x0, motion.pose.y - costmap.y0, motion.pose.yaw
        scene = costmap.field, costmap.occupied, costmap.resolution, x, y, yaw
        if self.recovery.kind is RecoveryKind.BACK_UP:
            there = self.start.inverse() @ motion.pose
            left = -self.recovery.amount - there.x
            look = copysign(
                min(abs(left), BACK_UP_LOOKAHEAD_M + motion.v**2 / (2 * BRAKING_SHARE * limits.braking)), left
            )
            free = abs(free_distance(*scene, look, shape)) >= 0.5 * abs(look) and (left > 0 or limits.v_min < 0)
            speed = min(self.config.back_up_speed, -limits.v_min if left < 0 else limits.v_max)
            v, w = straight_command(left, motion.v, limits, DT, speed), turn_rate_after(motion.w, 0.0, limits, DT)
            self.done = abs(left) < 0.01
        elif self.recovery.kind is RecoveryKind.TURN:
            left = self.recovery.amount - self.turned
            look = copysign(min(abs(left), TURN_LOOKAHEAD_RAD), left)
            free = abs(free_angle(*scene, look, shape)) >= 0.5 * abs(look)
            v = speed_after(motion.v, 0.0, limits, DT)
            w = turn_command(left, motion.w, limits, DT, min(self.config.turn_rate, limits.w_max))
            self.done = abs(left) < 0.02
        else:
            left = self.recovery.amount - (now - self.since) / 1e9
            self.done = left <= 0.0
            return braking(motion, limits, FollowState.ARRIVED if self.done else FollowState.FOLLOWING)
        if self.done:
            return braking(motion, limits, FollowState.ARRIVED)
        if not free:
            return braking(motion, limits, FollowState.BLOCKED, reasons.BLOCKED.code, abs(left))
        return ControlOutcome(v, w, FollowState.FOLLOWING, "", abs(left))


def turn_command(left: float, w: float, limits: Limits, dt: float, max_rate: float) -> float:
    """The turn rate, rad/s, after w, with `left` rad to go, at most `max_rate` rad/s and with room to stop. dt: s."""
    return turn_rate_after(
        w, copysign(_speed_profile(abs(left), BRAKING_SHARE * limits.turn_acceleration, max_rate, dt), left), limits, dt
    )


def straight_command(left: float, v: float, limits: Limits, dt: float, max_rate: float) -> float:
    """The speed, m/s, after v, with `left` m to go, at most `max_rate` m/s; negative drives back. dt: s."""
    return speed_after(
        v, copysign(_speed_profile(abs(left), BRAKING_SHARE * limits.braking, max_rate, dt), left), limits, dt
    )


def _speed_profile(left: float, braking: float, max_rate: float, dt: float) -> float:
    return min(max_rate, sqrt(2.0 * braking * left), left / (2.0 * dt))


@njit(cache=True, nogil=True)
def _min_clearance(
    field: Float32s, occupied: Bools, resolution: float, x: float, y: float, c: float, s: float, shape: Footprint
) -> float:
    """The clearance, m, to keep from here on: a robot that starts too near an obstacle may leave it, but not approach
    it.
    """
    if collides(field, occupied, resolution, x, y, c, s, shape):
        return clearance(field, resolution, x, y, c, s, shape) - MAX_CLEARANCE_LOSS_M
    return inf


@njit(cache=True, nogil=True)
def _is_hit(
    field: Float32s,
    occupied: Bools,
    resolution: float,
    x: float,
    y: float,
    c: float,
    s: float,
    shape: Footprint,
    min_clearance: float,
) -> bool:
    """Whether the footprint touches an occupied cell here with less clearance than `min_clearance`."""
    if clearance(field, resolution, x, y, c, s, shape) >= min_clearance:
        return False
    return collides(field, occupied, resolution, x, y, c, s, shape)


@njit(cache=True, nogil=True)
def free_angle(
    field: Float32s,
    occupied: Bools,
    resolution: float,
    x: float,
    y: float,
    yaw: float,
    angle: float,
    shape: Footprint,
) -> float:
    """The part of `angle`, rad, that the footprint can turn in place from (x, y, yaw) before contact.

    field: (h, w) float32 m to the nearest occupied cell. occupied: (h, w) bool. resolution: m a cell. x, y: m from the
    centre of the lower left cell. yaw: rad.
    """
    min_clearance = _min_clearance(field, occupied, resolution, x, y, cos(yaw), sin(yaw), shape)
    n = int(abs(angle) * shape.circumscribed / CHECK_STEP_M) + 1
    for i in range(1, n + 1):
        turned = yaw + angle * i / n
        if _is_hit(field, occupied, resolution, x, y, cos(turned), sin(turned), shape, min_clearance):
            return angle * (i - 1) / n
    return angle


@njit(cache=True, nogil=True)
def free_distance(
    field: Float32s,
    occupied: Bools,
    resolution: float,
    x: float,
    y: float,
    yaw: float,
    distance: float,
    shape: Footprint,
) -> float:
    """The part of `distance`, m (negative: back), that the footprint can drive before contact. Arguments as
    `free_angle`.
    """
    c, s = cos(yaw), sin(yaw)
    min_clearance = _min_clearance(field, occupied, resolution, x, y, c, s, shape)
    n = int(abs(distance) / CHECK_STEP_M) + 1
    for i in range(1, n + 1):
        along = distance * i / n
        if _is_hit(field, occupied, resolution, x + c * along, y + s * along, c, s, shape, min_clearance):
            return distance * (i - 1) / n
    return distance
