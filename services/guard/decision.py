# SPDX-License-Identifier: Apache-2.0
"""Which velocity goes to the base: the command within the drive's limits, the protective field and the laser's view.

The guard has the place of Nav2's collision monitor, between command and base. The order of the limits is our own.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from services.guard.arbitration import CommandSource
from services.guard.limits import ramped_velocity
from services.guard.obstacles import Obstacles
from services.guard.protective_field import NO_LIMIT, FieldConfig, SafeSpeed, safe_speed
from services.guard.stop_conditions import StopInputs, view_detail
from shared import reasons
from shared.config import Robot
from shared.geometry import wrapped
from shared.messages import GuardState, GuardStatus, Velocity
from shared.odometry_buffer import OdometryBuffer
from shared.reasons import Reason
from shared.stamps import fresh

MAX_RAMP_S = 0.1  # acceleration time that one command may use, also after a pause
MAX_RANGES_AGE_S = 1.0  # beyond it the range sensors do not count as a view

Twist = tuple[float, float]
"""v m/s, w rad/s."""


@dataclass(frozen=True, slots=True)
class GuardDecision:
    """Velocity to the base (m/s, rad/s), with the state, reason and detail of `guard/status`.

    speed_limit: m/s that the field allows in the direction of the command.
    """

    state: GuardState
    reason: str
    source: str = ""
    v: float = 0.0
    w: float = 0.0
    speed_limit: float = 0.0
    detail: str = ""

    @property
    def moves(self) -> bool:
        """Whether the velocity is not zero."""
        return self.v != 0 or self.w != 0

    def status(self, now: int, stopped_at: int) -> GuardStatus:
        """`guard/status` of this decision. now, stopped_at: ns, the latter of the last e-stop or fault."""
        return GuardStatus(
            stamp=now,
            state=self.state,
            source=self.source,
            reason=self.reason,
            detail=self.detail,
            speed_limit=self.speed_limit,
            stopped=stopped_at,
        )


class VelocityLimiter:
    """Limits commands by acceleration, protective field and view, from the velocity that was sent last. now: ns."""

    def __init__(
        self,
        robot: Robot,
        config: FieldConfig,
        inputs: StopInputs,
        odometry: OdometryBuffer,
        obstacles: Obstacles,
    ) -> None:
        self.robot, self.config, self.inputs = robot, config, inputs
        self.odometry, self.obstacles = odometry, obstacles
        self.corners = robot.corners
        self.ranges_stamp: int | None = None  # ns, of the newest range readings
        self.sent: Twist = (0.0, 0.0)
        self.sent_at = 0  # ns

    def limited(self, command: Velocity, source: str, now: int) -> GuardDecision:
        """The decision for a command while no stop condition holds."""
        drive, field = self.robot.drive, self.config
        here = self.odometry.odom_from_base
        clamped = drive.clamped(command.v, command.w)
        leaves = self.inputs.contacts.touches
        wanted, view_reason = self._limited_by_view(*(self._crept(*clamped) if leaves else clamped), now)
        hidden = [laser.visibility.points(here) for laser in self.inputs.lasers]
        points = np.concatenate([self.obstacles.points(here, now), *hidden])
        wanted_limit = safe_speed(points, self.corners, *wanted, drive, field)
        target = wanted[0] * wanted_limit.share, wanted[1] * wanted_limit.share
        v, w = self._ramped(target, now)
        if view_reason is reasons.SCAN_BLIND:  # slower at once, as a stop would be
            v, w = (min(pair, key=abs) for pair in zip((v, w), target, strict=True))
        w = drive.bent(v, w)
        # the ramp bends the arc, so the resulting velocity is tested too
        ramped = (v, w)
        ramped_limit = NO_LIMIT if ramped == target else safe_speed(points, self.corners, v, w, drive, field)
        v, w = v * ramped_limit.share, w * ramped_limit.share
        tighter = wanted_limit if wanted_limit.share < ramped_limit.share else ramped_limit
        speed_limit = abs(wanted[0]) * tighter.share if tighter.share < 1 else drive.max_speed
        detail = f"contact after {tighter.travel:.2f} m" if tighter.share < 1 else ""
        state, reason = _state_and_reason(command, wanted, (v, w), wanted_limit, tighter)
        if view_reason is not None and state is GuardState.ACTIVE and tighter.share == 1:
            blind = [laser for laser in self.inputs.lasers if laser.is_blind or view_reason is reasons.SCAN_EMPTY]
            detail = "" if view_reason is reasons.NO_SENSOR else view_detail(blind)
            reason, speed_limit = view_reason.code, field.blind_speed
        if leaves and state is GuardState.ACTIVE and not reason:
            reason, speed_limit = reasons.LEAVING_CONTACT.code, field.creep_speed
            detail = self.inputs.contacts.detail()
        return GuardDecision(
            state=state, reason=reason, source=source, v=v, w=w, speed_limit=speed_limit, detail=detail
        )

    def overridden(self, command: Velocity, source: str, now: int) -> GuardDecision:
        """The decision for a command of teleoperation while the field is overridden: slow, without the field."""
        field = self.config
        detail = "nothing keeps the robot from what is in its way"
        v, w = self._ramped(self._crept(*self.robot.drive.clamped(command.v, command.w)), now)
        w = self.robot.drive.bent(v, w)
        return GuardDecision(
            state=GuardState.ACTIVE,
            reason=reasons.OVERRIDE.code,
            source=source,
            v=v,
            w=w,
            speed_limit=field.creep_speed,
            detail=detail,
        )

    def _crept(self, v: float, w: float) -> Twist:
        """The velocity (m/s, rad/s) scaled down to creep speed."""
        limits = (v, self.config.creep_speed), (w, self.config.creep_turn_rate)
        share = min((1.0, *(limit / abs(x) for x, limit in limits if x)))
        return v * share, w * share

    def _ramped(self, target: Twist, now: int) -> Twist:
        """The velocity at `now` on the ramp from the last sent velocity to the target."""
        elapsed = (now - self.sent_at) * 1e-9
        elapsed = elapsed if 0 <= elapsed <= MAX_RAMP_S else MAX_RAMP_S
        return ramped_velocity(self.sent, target, elapsed, self.robot.drive)

    def _limited_by_view(self, v: float, w: float, now: int) -> tuple[Twist, Reason | None]:
        """The velocity with at most `blind_speed` in a direction without a view, and the reason of the limit.

        One laser with a view of the direction is enough.
        """
        blind_speed = self.config.blind_speed
        if self.inputs.is_blind:
            rim_speed = max(abs(v), abs(w) * self.robot.circumscribed_radius)
            share = min(1.0, blind_speed / rim_speed) if rim_speed else 1.0
            return (v * share, w * share), reasons.SCAN_BLIND
        if abs(v) <= blind_speed:
            return (v, w), None
        direction = 0.0 if v > 0 else pi
        has_ranges = self.ranges_stamp is not None and fresh(self.ranges_stamp, now, MAX_RANGES_AGE_S)
        if has_ranges and any(abs(wrapped(s.mount.yaw - direction)) <= pi / 4 for s in self.robot.ranges):
            return (v, w), None
        in_sweep = [laser for laser in self.inputs.lasers if laser.covers(direction)]
        if any(not laser.visibility.is_empty(direction, now) for laser in in_sweep):
            return (v, w), None
        share = blind_speed / abs(v)
        return (v * share, w * share), reasons.SCAN_EMPTY if in_sweep else reasons.NO_SENSOR


def _state_and_reason(
    command: Velocity, wanted: Twist, output: Twist, wanted_limit: SafeSpeed, tighter: SafeSpeed
) -> tuple[GuardState, str]:
    """State and reason code without a stop condition. wanted: the command within the drive's limits."""
    stands = output == (0.0, 0.0)
    if CommandSource.is_zero(command):
        if stands:
            return GuardState.IDLE, command.reason or reasons.NO_COMMAND.code
        return GuardState.ACTIVE, command.reason
    if wanted == (0.0, 0.0):
        return GuardState.HOLD, (reasons.NO_REVERSE if command.v else reasons.NO_TURN_IN_PLACE).code
    if wanted_limit.share == 0 or (stands and tighter.share == 0):
        return GuardState.HOLD, reasons.OBSTACLE.code
    if tighter.share < 1:
        return GuardState.ACTIVE, reasons.OBSTACLE_SLOW.code
    # the speed zone is the one reason of a slow command that guard/status repeats
    return GuardState.ACTIVE, command.reason if command.reason == reasons.SPEED_ZONE.code else ""
