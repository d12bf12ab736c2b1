# SPDX-License-Identifier: Apache-2.0
"""The guard: the only publisher of `cmd/vel`. It selects the command, limits it, and stops the robot."""

from dataclasses import replace

import numpy as np

from services.guard.arbitration import CommandSource
from services.guard.config import GuardConfig
from services.guard.contact_stop import ContactStop
from services.guard.decision import GuardDecision, VelocityLimiter
from services.guard.laser_input import LaserInput, scan_end
from services.guard.obstacles import Obstacles
from services.guard.protective_field import safe_speed
from services.guard.stop_conditions import StopInputs
from shared import reasons, requests, topics
from shared.config import Robot
from shared.contacts import contact_points, new_contacts
from shared.lasers import NO_SECOND_LASER, lasers_by_topic
from shared.messages import (
    BaseStatus,
    Contacts,
    EmergencyStop,
    GuardState,
    GuardStatus,
    LaserScan,
    Odometry,
    PoseEstimate,
    RangeReadings,
    Velocity,
)
from shared.odometry_buffer import OdometryBuffer
from shared.reasons import Reason
from shared.rejections import RejectionCause
from shared.requests import Override, Reply
from shared.scan_faults import mismatch
from shared.service import Answer, Log, Out, Service, answer, every, on
from shared.settings import Configuration
from shared.stamps import supersedes
from shared.topics import Topic

MAX_ODOM_AGE_S = 1.0  # after its stamp; late odometry still gives the pose of earlier beams


class GuardService(Service):
    """Applies arbitration, stop conditions, protective field and acceleration limits; then the field once more."""

    config_type = GuardConfig
    config: GuardConfig

    def __init__(self, config: GuardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        drive = robot.drive
        self.contacts = ContactStop(config.contacts, robot)
        self.lasers = {
            topic.key: LaserInput(topic, laser, config.view, robot) for topic, laser in lasers_by_topic(robot).items()
        }
        self.inputs = StopInputs(
            config.stops, config.arbitration, self.rejections, self.contacts, tuple(self.lasers.values())
        )
        self.odometry_buffer = OdometryBuffer(drive)
        top_speed = max(drive.max_speed, drive.max_reverse_speed)
        stopping_distance = top_speed * (config.field.reaction + top_speed / drive.max_braking)
        beyond = max(0.5, config.field.stop_margin + config.field.side_margin + 0.1)
        self.obstacles = Obstacles(config.obstacles, robot, robot.circumscribed_radius + stopping_distance + beyond)
        self.limiter = VelocityLimiter(robot, config.field, self.inputs, self.odometry_buffer, self.obstacles)
        self.decision = GuardDecision(GuardState.IDLE, reasons.STARTING.code)
        self.published: tuple[GuardState, str, str] | None = None  # state, source and reason of the last status
        self.stopped_at = 0  # ns, the last time with an e-stop or a fault

    def warm_up(self) -> None:
        """Runs the protective field once, on a line and on an arc."""
        far = np.full((2, 2), 0.5 + self.robot.circumscribed_radius)
        for w in (0.0, 0.1):
            safe_speed(far, self.robot.corners, 0.1, w, self.robot.drive, self.config.field)

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        """Takes lower limits. The reach of obstacles stays: it is enough for the limits of the start."""
        self.limiter.robot = new.robot
        for laser in self.lasers.values():
            laser.visibility.robot = new.robot
        return ()

    def state(self) -> str:
        """State and reason for the health message."""
        return f"{self.decision.state} {self.decision.reason}".rstrip()

    @on(topics.CMD_NAV)
    def command_nav(self, command: Velocity) -> Out:
        """Takes a command of navigation."""
        source = self.inputs.nav
        if self._is_usable(topics.CMD_NAV, command, source) and source.accept(command, self.now):
            yield from self.drive()

    @on(topics.TELEOP)
    def command_teleop(self, command: Velocity) -> Out:
        """Takes a command of teleoperation."""
        source = self.inputs.teleop
        if self._is_usable(topics.TELEOP, command, source) and source.accept(command, self.now):
            yield from self.drive()

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        """Latches or releases the e-stop."""
        self.inputs.set_estop(stop, self.now)
        yield from self.drive()

    @on(topics.GUARD)
    def status_before_restart(self, status: GuardStatus) -> Out:
        """Restores the e-stop, which only a later release ends, or the wait for zero after its release."""
        self.stopped_at = max(self.stopped_at, status.stopped)
        if status.reason == reasons.ESTOP_RELEASED.code:
            self.inputs.disarm(self.now)
        if status.state is GuardState.STOPPED:
            self.inputs.set_estop(EmergencyStop(status.stamp, True, "from before a restart"), self.now)
            yield from self.drive()

    @on(topics.BASE_STATUS)
    def base_status(self, status: BaseStatus) -> Out:
        """Takes the base driver's status."""
        if supersedes(status.stamp, self.inputs.base_stamp, self.now):
            self.inputs.set_base(status, self.now)
            yield from self.watch()
            if status.waits:  # for a zero newer than its fault: the last sent one may be older
                self.decision = replace(self.decision, v=0.0, w=0.0)
                self.limiter.sent, self.limiter.sent_at = (0.0, 0.0), self.now
                yield topics.CMD_VEL(Velocity(self.now, 0.0, 0.0, self.decision.reason))

    @on(topics.ODOM, waits=True)
    def odometry(self, odometry: Odometry) -> Out:
        """Takes odometry; where it restarted, all that was seen in its former frame is dropped."""
        last = self.inputs.odom_stamp
        if self.rejections.judge(topics.ODOM.key, odometry.stamp, last, self.now, MAX_ODOM_AGE_S):
            self.inputs.set_odometry(odometry.stamp, self.now)
            if not self.odometry_buffer.add(odometry):
                self.obstacles.clear()
                for laser in self.lasers.values():
                    laser.clear()
        return ()

    @on(topics.SCAN)
    def laser(self, scan: LaserScan) -> Out:
        """Takes a scan of the first laser."""
        yield from self._take_scan(topics.SCAN.key, scan)

    @on(topics.SCAN_2)
    def laser_2(self, scan: LaserScan) -> Out:
        """Takes a scan of the second laser."""
        yield from self._take_scan(topics.SCAN_2.key, scan)

    def _take_scan(self, key: str, scan: LaserScan) -> Out:
        """Takes a scan, and decides again at once where it gives a new reason to slow down or stop."""
        laser, max_age = self.lasers.get(key), self.config.stops.scan_age
        if laser is None:
            self.rejections.reject(key, RejectionCause.CONTENT, NO_SECOND_LASER, self.now)
            return
        fault = mismatch(scan, laser.laser)
        usable = self.rejections.judge(key, scan_end(scan), laser.end, self.now, max_age, unfit=fault)
        if not usable or self.odometry_buffer.latest is None:
            return
        if laser.take(scan, self.odometry_buffer, self.obstacles, self.now):
            yield Log("WARNING", laser.about(f"the laser repeats one scan: {laser.repeats.n_repeats} times"))
        if self.decision.moves and self._evaluate().reason not in ("", self.decision.reason):
            yield from self.drive()

    @on(topics.RANGES, waits=True)
    def range_readings(self, readings: RangeReadings) -> Out:
        """Takes the echoes of the range sensors."""
        last, max_age = self.limiter.ranges_stamp, self.config.stops.scan_age
        usable = self.rejections.judge(topics.RANGES.key, readings.stamp, last, self.now, max_age)
        if usable and self.odometry_buffer.latest is not None:
            self.limiter.ranges_stamp = readings.stamp
            self.obstacles.add_ranges(readings, self.odometry_buffer)
        return ()

    @on(topics.CONTACTS)
    def touch(self, contacts: Contacts) -> Out:
        """Takes contacts, and stops at once. The places of contacts are remembered as obstacles."""
        last, max_age = self.contacts.stamp, self.config.contacts.age
        if self.rejections.judge(topics.CONTACTS.key, contacts.stamp, last, self.now, max_age):
            begun = new_contacts(contacts, self.contacts.newest)
            self.inputs.set_contacts(contacts, self.now)
            if self.contacts.touches and self.odometry_buffer.latest is not None:
                points, here = contact_points(self.robot, contacts)[0], self.odometry_buffer.odom_from_base
                self.obstacles.add_contacts(points, here, bool(begun.bumpers or begun.cliffs), self.now)
            yield from self.watch()

    @on(topics.POSE)
    def estimate(self, pose: PoseEstimate) -> Out:
        """Takes the pose estimate."""
        self.inputs.set_pose(pose, self.now)
        return ()

    @answer(requests.OVERRIDE)
    def override(self, request: Override) -> Answer[Reply]:
        """Lets teleoperation drive slowly without the protective field for a while."""
        refusal = self.inputs.set_override(request.seconds, self.now)
        yield from self.drive()
        detail = f"{refusal.text}: {refusal.hint}" if refusal else ""
        return Reply(self.now, refusal is None, refusal.code if refusal else "", detail)

    @every(hz=50)
    def watch(self) -> Out:
        """Stops between the ticks of `drive`, as soon as a stop condition holds."""
        if self.decision.moves and self._stop_reason() is not None:
            yield from self.drive()

    @every(hz=20)
    def drive(self) -> Out:
        """Decides on the velocity and publishes it."""
        self.decision = self._evaluate()
        self.limiter.sent, self.limiter.sent_at = (self.decision.v, self.decision.w), self.now
        if self.decision.state in (GuardState.STOPPED, GuardState.FAULT):
            self.stopped_at = self.now
        yield topics.CMD_VEL(Velocity(self.now, self.decision.v, self.decision.w, self.decision.reason))
        if self.published != (self.decision.state, self.decision.source, self.decision.reason):
            yield from self.publish_status()

    @every(hz=10)
    def publish_status(self) -> Out:
        """Publishes `guard/status`."""
        decision = self.decision
        self.published = decision.state, decision.source, decision.reason
        yield topics.GUARD(decision.status(self.now, self.stopped_at))

    def _is_usable(self, topic: Topic[Velocity], command: Velocity, source: CommandSource) -> bool:
        """Whether a command's stamp is newer than the last one's and recent."""
        last, age = source.command.stamp if source.command else None, self.config.arbitration.command_age
        is_usable = self.rejections.judge(topic.key, command.stamp, last, self.now, age)
        if not is_usable:
            source.heard(command, self.now)
        return is_usable

    def _evaluate(self) -> GuardDecision:
        """The decision at `self.now`: a stop, or the active source's command within limits and field."""
        source = self.inputs.source(self.now)
        name = source.name if self.inputs.has_command(self.now) else ""
        stop = self._stop_reason()
        if stop is not None or source.command is None:
            reason, state = stop or (reasons.NO_COMMAND, GuardState.IDLE)
            return GuardDecision(state, reason.code, name, detail=self.inputs.detail(reason, state, self.now))
        if self.inputs.is_overridden(self.now):
            return self.limiter.overridden(source.command, name, self.now)
        return self.limiter.limited(source.command, name, self.now)

    def _stop_reason(self) -> tuple[Reason, GuardState] | None:
        """The highest stop condition, with the lasers' views in the direction of the command."""
        self.inputs.update_views(self.now)
        return self.inputs.stop_reason(self.now)
