# SPDX-License-Identifier: Apache-2.0
"""The stop conditions: the newest inputs, and a table of reasons over them, highest first.

The table and its order are our own. The e-stop is latched, and its release starts no motion, as ISO 13850 demands.
"""

from collections.abc import Callable, Iterable

from pydantic import Field

from services.guard.arbitration import ArbitrationConfig, CommandSource, active_source
from services.guard.contact_stop import ContactStop
from services.guard.laser_input import LaserInput
from shared import reasons, topics
from shared.config import Section
from shared.messages import BaseStatus, Contacts, EmergencyStop, GuardState, Localization, PoseEstimate
from shared.reasons import Reason
from shared.rejections import Rejections
from shared.stamps import fresh, precedes, supersedes
from shared.stop_button import latched_press


class StopConditionsConfig(Section):
    """Maximum ages of the inputs."""

    odom_age: float = Field(0.2, gt=0, le=1, description="s at which odometry is too old")
    scan_age: float = Field(0.27, gt=0, le=2, description="s after its last beam at which a scan is too old")
    base_age: float = Field(2.0, gt=0, le=10, description="s at which the base driver is silent")
    pose_age: float = Field(1.0, gt=0, le=10, description="s at which the pose is too old; for navigation only")
    lost_after: float = Field(2.0, ge=0, le=60, description="s for which navigation may drive with a lost pose")
    pose_jump: float = Field(0.5, gt=0, le=10, description="m that the pose may jump before navigation must plan again")
    replan: float = Field(0.5, ge=0, le=10, description="s after a jump from which navigation's commands count again")


class StopInputs:
    """The newest inputs of the guard, and each condition of the table STOPS over them. Times are ns."""

    def __init__(
        self,
        config: StopConditionsConfig,
        arbitration: ArbitrationConfig,
        rejections: Rejections,
        contacts: ContactStop,
        lasers: tuple[LaserInput, ...],
    ) -> None:
        self.config, self.arbitration, self.rejections, self.contacts = config, arbitration, rejections, contacts
        self.lasers = lasers
        self.teleop, self.nav = CommandSource("teleop", arbitration), CommandSource("nav", arbitration)
        self.estop: EmergencyStop | None = None  # while it is pressed
        self.base: BaseStatus | None = None
        self.odom_stamp: int | None = None
        self.odom_valid_from: int | None = None  # start of its age: the stamp, or the arrival where the stamp is ahead
        self.pose: PoseEstimate | None = None
        self.lost_since: int | None = None
        self.jumped_at: int | None = None
        self.override: tuple[int, int] | None = None  # begin and end of the time without protective field

    def set_odometry(self, stamp: int, now: int) -> None:
        """Registers odometry with this stamp."""
        self.odom_stamp, self.odom_valid_from = stamp, min(stamp, now)

    def set_override(self, seconds: float, now: int) -> Reason | None:
        """Overrides the protective field for `seconds`; 0 ends the override. Returns the reason of a refusal."""
        if seconds and (self.estop is not None or self.base_in_estop(now) or self.contacts.is_estop_pressed):
            return reasons.ESTOP
        self.override = (now, now + round(seconds * 1e9)) if seconds else None
        return None

    def is_overridden(self, now: int) -> bool:
        """Whether teleoperation drives with the protective field overridden."""
        return self.override is not None and self.override[0] <= now < self.override[1] and not self.navigates(now)

    def set_estop(self, stop: EmergencyStop, now: int) -> None:
        """Latches a pressed e-stop, or releases it. After a release both sources must send zero first."""
        if stop.pressed:
            self.estop, self.override = latched_press(stop, self.estop, now), None
            return
        if self.estop is not None and precedes(stop.stamp, self.estop.stamp, now):
            return  # an older release than this press
        if self.estop is not None or self.fault:
            self.disarm(now)
        self.estop = None

    def set_contacts(self, contacts: Contacts, now: int) -> None:
        """Takes contacts. The hardware e-stop latches as STOP does, and ends an override."""
        self.contacts.set(contacts, now)
        if contacts.estop and self.estop is None:
            self.set_estop(EmergencyStop(contacts.stamp, True, "the robot's button"), now)

    def is_bumped(self, now: int) -> bool:
        """Whether a bumper is pressed and the active source's command does not lead away."""
        return self.contacts.holds(self.source(now).command, cliffs=False)

    def set_base(self, status: BaseStatus, now: int) -> None:
        """Registers the base driver's status. The end of its e-stop is a release, also where none was received."""
        if self.fault == reasons.ESTOP.code != status.fault:
            self.disarm(now)
        if status.fault == reasons.ESTOP.code:
            self.override = None
        self.base = status

    def disarm(self, now: int) -> None:
        """Both sources must send zero, or be silent, before they move the robot again."""
        self.nav.disarm(now)
        self.teleop.disarm(now)

    def set_pose(self, pose: PoseEstimate, now: int) -> None:
        """Registers a pose estimate, with the beginning of a loss and the time of a jump of `map_from_odom`."""
        last = self.pose
        if not supersedes(pose.stamp, self.pose_stamp, now):
            return
        if last is None or last.stamp >= pose.stamp:  # the first, or the first after the clock was set back
            self.jumped_at = self.lost_since = None
        else:
            by_old_correction = last.map_from_odom @ pose.map_from_odom.inverse() @ pose.map_from_base
            if by_old_correction.distance(pose.map_from_base) > self.config.pose_jump:
                self.jumped_at = now
        if pose.state is not Localization.LOST:
            self.lost_since = None
        elif self.lost_since is None:
            self.lost_since = now
        self.pose = pose

    def source(self, now: int) -> CommandSource:
        """The active command source."""
        return active_source(self.teleop, self.nav, now)

    def has_command(self, now: int) -> bool:
        """Whether the active source's last command is recent enough."""
        return self.source(now).is_newer_than(self.arbitration.command_age, now)

    def navigates(self, now: int) -> bool:
        """Whether navigation is the active source: its commands need a pose."""
        return self.source(now) is self.nav

    @property
    def fault(self) -> str:
        """The base's fault; empty without one."""
        return self.base.fault if self.base else ""

    def base_in_estop(self, now: int) -> bool:
        """Whether the base reports an e-stop, perhaps one that this guard did not receive."""
        return self.fault == reasons.ESTOP.code and not self.is_base_old(now)

    def is_lost(self, now: int) -> bool:
        """Whether the pose has been lost for longer than `lost_after`."""
        return self.lost_since is not None and now - self.lost_since > self.config.lost_after * 1e9

    @property
    def awaits_new_plan(self) -> bool:
        """Whether the pose jumped and the last command of navigation still follows the plan from before."""
        command = self.nav.command
        if self.jumped_at is None or command is None:
            return False
        return command.stamp - self.jumped_at <= self.config.replan * 1e9

    def old_lasers(self, now: int) -> list[LaserInput]:
        """The lasers whose last valid scan is missing or too old to drive on."""
        if self.is_overridden(now):
            return []
        return [laser for laser in self.lasers if self.is_old(laser.valid_from, self.config.scan_age, now)]

    def frozen_lasers(self, now: int) -> list[LaserInput]:
        """The lasers that repeat one scan."""
        return [] if self.is_overridden(now) else [laser for laser in self.lasers if laser.is_frozen]

    def scan_mismatch(self, now: int) -> str:
        """Difference between the received scans and the configured beams, in words; empty without one."""
        if self.is_overridden(now):
            return ""
        found = ((laser, self.rejections.content_problem(laser.topic.key, now)) for laser in self.lasers)
        return next((laser.about(problem) for laser, problem in found if problem), "")

    def update_views(self, now: int) -> None:
        """Finds the lasers without a view in the direction of the command."""
        command = self.source(now).command
        for laser in self.lasers:
            laser.is_blind = command is not None and laser.visibility.is_blind(command.v, command.w, now)

    @property
    def is_blind(self) -> bool:
        """Whether a laser has no view in the direction of the command."""
        return any(laser.is_blind for laser in self.lasers)

    def is_odom_old(self, now: int) -> bool:
        """Whether odometry is missing or too old to drive on."""
        return self.is_old(self.odom_valid_from, self.config.odom_age, now)

    def stamp_fault(self, now: int) -> str:
        """Fault of the stamps of an input that is old although its messages arrive, in words; empty without one.

        The base driver's words about its board come first: the other faults follow from the board's stamps.
        """
        if self.base is not None and self.fault == reasons.BAD_STAMPS.code:
            return self.base.detail or reasons.BAD_STAMPS.text
        if self.is_odom_old(now):
            return self.rejections.late_cause(topics.ODOM.key, now)
        found = ((laser, self.rejections.late_cause(laser.topic.key, now)) for laser in self.old_lasers(now))
        return next((laser.about(cause) for laser, cause in found if cause), "")

    def detail(self, reason: Reason, state: GuardState, now: int) -> str:
        """Detail of a stop reason: the base's words for its faults, the causes of rejection for an input."""
        if reason is reasons.BAD_STAMPS:
            return self.stamp_fault(now)
        if reason is reasons.SCAN_UNLIKE:
            return self.scan_mismatch(now)
        if reason is reasons.SCAN_OLD:
            return self.old_lasers(now)[0].about("")
        if reason is reasons.SCAN_FROZEN:
            laser = self.frozen_lasers(now)[0]
            return laser.about(f"{laser.repeats.n_repeats} times the same ranges with new stamps")
        if reason is reasons.SCAN_BLIND:
            return view_detail(laser for laser in self.lasers if laser.is_blind)
        if reason in (reasons.BUMPER, reasons.CLIFF):
            return self.contacts.detail()
        if self.base is not None and (state is GuardState.FAULT or reason.code == self.fault != reasons.ESTOP.code):
            return self.base.detail
        if reason in (reasons.COMMAND_OLD, reasons.NO_COMMAND):
            causes = (self.rejections.late_cause(topic.key, now) for topic in (topics.TELEOP, topics.CMD_NAV))
            return next(filter(None, causes), "")
        return ""

    @property
    def base_stamp(self) -> int | None:
        """ns"""
        return self.base.stamp if self.base else None

    @property
    def pose_stamp(self) -> int | None:
        """ns"""
        return self.pose.stamp if self.pose else None

    def is_base_old(self, now: int) -> bool:
        """Whether the base driver's status is missing or too old."""
        return self.is_old(self.base_stamp, self.config.base_age, now)

    def is_pose_old(self, now: int) -> bool:
        """Whether the pose estimate is missing or too old."""
        return self.is_old(self.pose_stamp, self.config.pose_age, now)

    @staticmethod
    def is_old(stamp: int | None, max_age: float, now: int) -> bool:
        """Whether a stamp is missing, over `max_age` s old, or in the future."""
        return stamp is None or not fresh(stamp, now, max_age)

    def stop_reason(self, now: int) -> tuple[Reason, GuardState] | None:
        """The first condition of STOPS that holds, or None."""
        stops = STOPS if self.fault else STOPS_WITHOUT_FAULT
        return next(((reason, state) for reason, state, holds in stops if holds(self, now)), None)


def view_detail(lasers: Iterable[LaserInput]) -> str:
    """What the last scans of these lasers contain, in words."""
    return "; ".join(laser.about(laser.visibility.detail) for laser in lasers if laser.visibility.detail)


NO_FAULTS = ("", reasons.ESTOP.code, reasons.BAD_STAMPS.code)
"""Faults of the base that are not of its hardware."""

Stop = tuple[Reason, GuardState, Callable[[StopInputs, int], bool]]

# fmt: off
_ESTOPS: tuple[Stop, ...] = (
    (reasons.ESTOP_INPUT,    GuardState.STOPPED, lambda s, t: s.contacts.is_estop_pressed),
    (reasons.ESTOP,          GuardState.STOPPED, lambda s, t: s.estop is not None or s.base_in_estop(t)),
)
_BASE_FAULTS: tuple[Stop, ...] = (  # none holds while the base reports no fault
    (reasons.WHEEL_STUCK,    GuardState.FAULT,   lambda s, t: s.fault == reasons.WHEEL_STUCK.code),
    (reasons.WHEEL_ASTRAY,   GuardState.FAULT,   lambda s, t: s.fault == reasons.WHEEL_ASTRAY.code),
    (reasons.ENCODERS_BROKEN, GuardState.FAULT,  lambda s, t: s.fault == reasons.ENCODERS_BROKEN.code),
    (reasons.ENCODERS_JUMP,  GuardState.HOLD,    lambda s, t: s.fault == reasons.ENCODERS_JUMP.code),
    (reasons.NOT_OBEYED,     GuardState.HOLD,    lambda s, t: s.fault == reasons.NOT_OBEYED.code),
    (reasons.PORT_CLOSED,    GuardState.FAULT,   lambda s, t: s.fault == reasons.PORT_CLOSED.code),
    (reasons.BOARD_SILENT,   GuardState.FAULT,   lambda s, t: s.fault == reasons.BOARD_SILENT.code),
    (reasons.BATTERY_EMPTY,  GuardState.FAULT,   lambda s, t: s.fault == reasons.BATTERY_EMPTY.code),
    (reasons.WRONG_RANGES,   GuardState.FAULT,   lambda s, t: s.fault == reasons.WRONG_RANGES.code),
    (reasons.SENSOR_DEAD,    GuardState.FAULT,   lambda s, t: s.fault == reasons.SENSOR_DEAD.code),
    (reasons.FAULT,          GuardState.FAULT,   lambda s, t: s.fault not in NO_FAULTS),
)
_OTHERS: tuple[Stop, ...] = (
    (reasons.BASE_SILENT,    GuardState.HOLD,    lambda s, t: s.is_base_old(t)),
    (reasons.BAD_STAMPS,     GuardState.HOLD,    lambda s, t: bool(s.stamp_fault(t))),
    (reasons.ODOM_OLD,       GuardState.HOLD,    lambda s, t: s.is_odom_old(t)),
    (reasons.SCAN_UNLIKE,    GuardState.HOLD,    lambda s, t: bool(s.scan_mismatch(t))),
    (reasons.SCAN_OLD,       GuardState.HOLD,    lambda s, t: bool(s.old_lasers(t))),
    (reasons.SCAN_FROZEN,    GuardState.HOLD,    lambda s, t: bool(s.frozen_lasers(t))),
    (reasons.CONTACTS_OLD,   GuardState.HOLD,    lambda s, t: not s.is_overridden(t) and s.contacts.is_old(t)),
    (reasons.CLIFF,          GuardState.HOLD,    lambda s, t: s.contacts.holds(s.source(t).command, cliffs=True)),
    (reasons.BUMPER,         GuardState.HOLD,    lambda s, t: not s.is_overridden(t) and s.is_bumped(t)),
    (reasons.COMMAND_OLD,    GuardState.HOLD,    lambda s, t: not s.has_command(t) and s.source(t).wants_motion),
    (reasons.NO_COMMAND,     GuardState.IDLE,    lambda s, t: not s.has_command(t)),
    (reasons.ESTOP_RELEASED, GuardState.HOLD,    lambda s, t: not s.source(t).is_armed),
    (reasons.SCAN_BLIND,     GuardState.HOLD,    lambda s, t: s.navigates(t) and s.is_blind),
    (reasons.POSE_LOST,      GuardState.HOLD,    lambda s, t: s.navigates(t) and s.is_lost(t)),
    (reasons.POSE_JUMPED,    GuardState.HOLD,    lambda s, t: s.navigates(t) and s.awaits_new_plan),
    (reasons.POSE_OLD,       GuardState.HOLD,    lambda s, t: s.navigates(t) and s.is_pose_old(t)),
)
# fmt: on
STOPS = (*_ESTOPS, *_BASE_FAULTS, *_OTHERS)
"""Every stop condition, highest rank first."""
STOPS_WITHOUT_FAULT = (*_ESTOPS, *_OTHERS)
