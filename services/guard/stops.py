# SPDX-License-Identifier: Apache-2.0
"""Why must the robot stand, whatever is commanded? What each input last said, and a table of reasons over it."""

from collections.abc import Callable
from dataclasses import replace

from pydantic import Field

from services.guard.arbitration import ArbitrationConfig, Source, in_charge
from shared import reasons, topics
from shared.config import Section
from shared.messages import BaseStatus, EmergencyStop, GuardState, LaserScan, Localization, PoseEstimate
from shared.reasons import Reason
from shared.rejections import Rejections
from shared.stamps import fresh, precedes, supersedes


class StopsConfig(Section):
    """When an input is too old to drive on."""

    odom_age: float = Field(0.2, gt=0, le=1, description="s after which odometry is old")
    scan_age: float = Field(0.27, gt=0, le=2, description="s after its last beam that a scan is old")
    base_age: float = Field(2.0, gt=0, le=10, description="s after which the base driver is silent")
    pose_age: float = Field(1.0, gt=0, le=10, description="s after which the pose is old; nav only")
    lost_after: float = Field(2.0, ge=0, le=60, description="s of a lost pose that nav may still drive")
    pose_jump: float = Field(0.5, gt=0, le=10, description="m that the pose may jump before nav must plan anew")
    replan: float = Field(0.5, ge=0, le=10, description="s after a jump from which nav's commands count again")


class Situation:
    """What speaks for or against driving now. `now` is set before each question."""

    def __init__(self, config: StopsConfig, arbitration: ArbitrationConfig, rejections: Rejections) -> None:
        self.config, self.arbitration, self.rejections = config, arbitration, rejections
        self.now = 0
        self.teleop, self.nav = Source("teleop", arbitration), Source("nav", arbitration)
        self.pressed: EmergencyStop | None = None
        self.base: BaseStatus | None = None
        self.odom_stamp: int | None = None
        self.odom_at: int | None = None  # ns from when on it ages: its stamp, or when it came if that was ahead
        self.scan: LaserScan | None = None
        self.scan_at: int | None = None  # as odom_at, of its last beam
        self.frozen = False  # the laser repeats one scan
        self.blind = False  # the laser does not see where the command leads
        self.pose: PoseEstimate | None = None
        self.lost_since: int | None = None
        self.jumped_at: int | None = None
        self.override: tuple[int, int] | None = None  # ns, from and until when a person answers for what is in the way

    def take_odometry(self, stamp: int) -> None:
        """The robot's motion was told as of this stamp."""
        self.odom_stamp, self.odom_at = stamp, min(stamp, self.now)

    def take_scan(self, scan: LaserScan | None) -> None:
        """What the laser saw last; None: that tells nothing any more."""
        self.scan, self.scan_at = scan, min(scan_end(scan), self.now) if scan else None

    def take_override(self, seconds: float) -> Reason | None:
        """Overrides the field for so long, or ends that; the reason where it is refused."""
        if seconds and (self.pressed is not None or self.base_in_stop):
            return reasons.ESTOP
        self.override = (self.now, self.now + round(seconds * 1e9)) if seconds else None
        return None

    @property
    def overridden(self) -> bool:
        """Whether the command is a hand's that answers for what is in the way."""
        return self.override is not None and self.override[0] <= self.now < self.override[1] and not self.navigating

    def take_stop(self, stop: EmergencyStop) -> None:
        """STOP latches. A release (also of the base's fault) moves nothing: both sources must ask for zero first."""
        if stop.pressed:  # its clock may be ahead: nothing from before it came releases it
            self.pressed, self.override = replace(stop, stamp=min(stop.stamp, self.now)), None
            return
        if self.pressed is not None and precedes(stop.stamp, self.pressed.stamp, self.now):
            return  # an older release than this press
        if self.pressed is not None or self.fault:
            self._disarm()
        self.pressed = None

    def take_base(self, status: BaseStatus) -> None:
        """What the base says; that it is out of STOP is a release, whoever heard of that."""
        if self.fault == reasons.ESTOP.code != status.fault:
            self._disarm()
        if status.fault == reasons.ESTOP.code:
            self.override = None
        self.base = status

    def _disarm(self) -> None:
        self.nav.disarm(self.now)
        self.teleop.disarm(self.now)

    def take_pose(self, pose: PoseEstimate) -> None:
        """Notices a lost pose, and a jump: the robot's place on the map by the old map_from_odom and by the new one."""
        last = self.pose
        if not supersedes(pose.stamp, self.pose_stamp, self.now):
            return
        if last is None or last.stamp >= pose.stamp:  # the first, or the first after the clock was set back
            self.jumped_at = self.lost_since = None
        else:
            stayed = last.map_from_odom @ pose.map_from_odom.inverse() @ pose.map_from_base
            if stayed.distance(pose.map_from_base) > self.config.pose_jump:
                self.jumped_at = self.now
        if pose.state is not Localization.LOST:
            self.lost_since = None
        elif self.lost_since is None:
            self.lost_since = self.now
        self.pose = pose

    @property
    def source(self) -> Source:
        """Whose commands count."""
        return in_charge(self.teleop, self.nav, self.now)

    @property
    def heard(self) -> bool:
        """Whether the source's last command still counts."""
        return self.source.younger_than(self.arbitration.command_age, self.now)

    @property
    def navigating(self) -> bool:
        """Whether the command needs to know where the robot is."""
        return self.source is self.nav

    @property
    def fault(self) -> str:
        """The base's fault, empty when it has none."""
        return self.base.fault if self.base else ""

    @property
    def base_in_stop(self) -> bool:
        """Whether the base says that STOP is pressed: it heard of it when this guard did not."""
        return self.fault == reasons.ESTOP.code and not self.old(self.base_stamp, self.config.base_age)

    @property
    def lost(self) -> bool:
        """Whether the pose has been lost for too long."""
        return self.lost_since is not None and self.now - self.lost_since > self.config.lost_after * 1e9

    @property
    def replanning(self) -> bool:
        """Whether the pose jumped and nav still commands what it planned before."""
        command = self.nav.command
        if self.jumped_at is None or command is None:
            return False
        return command.stamp - self.jumped_at <= self.config.replan * 1e9

    @property
    def scan_is_old(self) -> bool:
        """Whether the last scan that counts is missing or too old to drive on."""
        return not self.overridden and self.old(self.scan_at, self.config.scan_age)

    @property
    def unlike(self) -> str:
        """How the scans that come differ from the configured beams, in words."""
        return self.rejections.unfit(topics.SCAN.key, self.now)

    @property
    def odom_is_old(self) -> bool:
        return self.old(self.odom_at, self.config.odom_age)

    @property
    def bad_stamps(self) -> str:
        """What is wrong with the stamps of an input that is old although its messages come, in words.

        The base's words on its board come first: what follows from the board's stamps is no cause.
        """
        if self.base is not None and self.fault == reasons.BAD_STAMPS.code:
            return self.base.detail or reasons.BAD_STAMPS.text
        if self.odom_is_old:
            return self.rejections.told(topics.ODOM.key, self.now)
        return self.rejections.told(topics.SCAN.key, self.now) if self.scan_is_old else ""

    def told(self, reason: Reason, state: GuardState) -> str:
        """The detail of a reason to stand: the base's words for its faults, the input's for what is rejected of it."""
        if reason is reasons.BAD_STAMPS:
            return self.bad_stamps
        if reason is reasons.SCAN_UNLIKE:
            return self.unlike
        if self.base is not None and (state is GuardState.FAULT or reason.code == self.fault != reasons.ESTOP.code):
            return self.base.detail
        if reason in (reasons.COMMAND_OLD, reasons.NO_COMMAND):
            return self.rejections.told(topics.TELEOP.key, self.now) or self.rejections.told(
                topics.CMD_NAV.key, self.now
            )
        return ""

    @property
    def base_stamp(self) -> int | None:
        return self.base.stamp if self.base else None

    @property
    def scan_stamp(self) -> int | None:
        return self.scan.stamp if self.scan else None

    @property
    def pose_stamp(self) -> int | None:
        return self.pose.stamp if self.pose else None

    def old(self, stamp: int | None, age: float) -> bool:
        """Whether what was true at `stamp` is missing, over `age` s old, or from the future."""
        return stamp is None or not fresh(stamp, self.now, age)

    def stop(self) -> tuple[Reason, GuardState] | None:
        """The highest reason to stand, or None."""
        return next(((reason, state) for reason, state, holds in STOPS if holds(self)), None)


def scan_end(scan: LaserScan) -> int:
    """ns of the last beam."""
    return scan.stamp + round(scan.scan_time * 1e9)


NO_FAULTS = ("", reasons.ESTOP.code, reasons.BAD_STAMPS.code)
"""What the base may say without that its hardware is broken."""

# fmt: off
STOPS: tuple[tuple[Reason, GuardState, Callable[[Situation], bool]], ...] = (  # highest rank first
    (reasons.ESTOP,          GuardState.STOPPED, lambda s: s.pressed is not None or s.base_in_stop),
    (reasons.WHEEL_STUCK,    GuardState.FAULT,   lambda s: s.fault == reasons.WHEEL_STUCK.code),
    (reasons.WHEEL_ASTRAY,   GuardState.FAULT,   lambda s: s.fault == reasons.WHEEL_ASTRAY.code),
    (reasons.ENCODERS_BROKEN, GuardState.FAULT,  lambda s: s.fault == reasons.ENCODERS_BROKEN.code),
    (reasons.ENCODERS_JUMP,  GuardState.HOLD,    lambda s: s.fault == reasons.ENCODERS_JUMP.code),
    (reasons.NOT_OBEYED,     GuardState.HOLD,    lambda s: s.fault == reasons.NOT_OBEYED.code),
    (reasons.PORT_CLOSED,    GuardState.FAULT,   lambda s: s.fault == reasons.PORT_CLOSED.code),
    (reasons.BOARD_SILENT,   GuardState.FAULT,   lambda s: s.fault == reasons.BOARD_SILENT.code),
    (reasons.BATTERY_EMPTY,  GuardState.FAULT,   lambda s: s.fault == reasons.BATTERY_EMPTY.code),
    (reasons.WRONG_RANGES,   GuardState.FAULT,   lambda s: s.fault == reasons.WRONG_RANGES.code),
    (reasons.SENSOR_DEAD,    GuardState.FAULT,   lambda s: s.fault == reasons.SENSOR_DEAD.code),
    (reasons.FAULT,          GuardState.FAULT,   lambda s: s.fault not in NO_FAULTS),
    (reasons.BASE_SILENT,    GuardState.HOLD,    lambda s: s.old(s.base_stamp, s.config.base_age)),
    (reasons.BAD_STAMPS,     GuardState.HOLD,    lambda s: bool(s.bad_stamps)),
    (reasons.ODOM_OLD,       GuardState.HOLD,    lambda s: s.odom_is_old),
    (reasons.SCAN_UNLIKE,    GuardState.HOLD,    lambda s: not s.overridden and bool(s.unlike)),
    (reasons.SCAN_OLD,       GuardState.HOLD,    lambda s: s.scan_is_old),
    (reasons.SCAN_FROZEN,    GuardState.HOLD,    lambda s: not s.overridden and s.frozen),
    (reasons.COMMAND_OLD,    GuardState.HOLD,    lambda s: not s.heard and s.source.moving),
    (reasons.NO_COMMAND,     GuardState.IDLE,    lambda s: not s.heard),
    (reasons.ESTOP_RELEASED, GuardState.HOLD,    lambda s: not s.source.armed),
    (reasons.SCAN_BLIND,     GuardState.HOLD,    lambda s: s.navigating and s.blind),
    (reasons.POSE_LOST,      GuardState.HOLD,    lambda s: s.navigating and s.lost),
    (reasons.POSE_JUMPED,    GuardState.HOLD,    lambda s: s.navigating and s.replanning),
    (reasons.POSE_OLD,       GuardState.HOLD,    lambda s: s.navigating and s.old(s.pose_stamp, s.config.pose_age)),
)
# fmt: on
