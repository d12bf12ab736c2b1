# SPDX-License-Identifier: Apache-2.0
"""The only way to cmd/vel: who may drive, how fast, and why the robot stands."""

from dataclasses import dataclass, replace
from math import pi

import numpy as np

from services.guard.arbitration import ArbitrationConfig, Source
from services.guard.limits import ramped
from services.guard.obstacles import Obstacles, ObstaclesConfig, looks_at
from services.guard.protective_field import FREE, FieldConfig, Permit, permitted
from services.guard.stops import Situation, StopsConfig, scan_end
from services.guard.track import Track
from services.guard.view import View, ViewConfig
from shared import reasons, requests, topics
from shared.config import Robot, Section
from shared.geometry import wrapped
from shared.messages import (
    BaseStatus,
    EmergencyStop,
    GuardState,
    GuardStatus,
    LaserScan,
    Odometry,
    PoseEstimate,
    RangeReadings,
    Velocity,
)
from shared.reasons import Reason
from shared.requests import Override, Reply
from shared.scan_faults import RepeatedScans, mismatch
from shared.service import Answer, Log, Out, Service, answer, every, on
from shared.stamps import fresh, supersedes
from shared.topics import Topic

MAX_ODOM_AGE = 1.0  # s after its stamp; younger odometry is late, but tells where earlier beams were taken
LONGEST_RAMP = 0.1  # s of acceleration that one command may make up for
RANGES_AGE = 1.0  # s after which range sensors no longer count as looking


class GuardConfig(Section):
    """The guard."""

    stops: StopsConfig = StopsConfig()
    arbitration: ArbitrationConfig = ArbitrationConfig()
    field: FieldConfig = FieldConfig()
    obstacles: ObstaclesConfig = ObstaclesConfig()
    view: ViewConfig = ViewConfig()


@dataclass(frozen=True, slots=True)
class Verdict:
    """What goes to the base now, and why."""

    state: GuardState
    reason: str
    source: str = ""
    v: float = 0.0
    w: float = 0.0
    speed_limit: float = 0.0
    detail: str = ""

    @property
    def moves(self) -> bool:
        return self.v != 0 or self.w != 0


class GuardService(Service):
    """Priority, staleness, acceleration and the protective field, in that order."""

    config_type = GuardConfig
    config: GuardConfig

    def __init__(self, config: GuardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        drive = robot.drive
        self.corners = robot.corners
        self.situation = Situation(config.stops, config.arbitration, self.rejections)
        self.track = Track(drive)
        fastest = max(drive.max_speed, drive.max_reverse_speed)
        stopping = fastest * (config.field.reaction + fastest / drive.max_braking)
        self.obstacles = Obstacles(config.obstacles, robot, robot.circumscribed_radius + stopping + 0.5)
        self.view = View(config.view, robot)
        self.repeats = RepeatedScans(robot.laser.mount)
        self.ranges_stamp: int | None = None
        self.verdict = Verdict(GuardState.IDLE, reasons.STARTING.code)
        self.sent_at = 0
        self.told: tuple[GuardState, str, str] | None = None
        self.stopped_at = 0  # ns, when STOP or a fault last held

    def warm(self) -> None:
        far = np.full((2, 2), 0.5 + self.robot.circumscribed_radius)
        for w in (0.0, 0.1):
            permitted(far, self.corners, 0.1, w, self.robot.drive, self.config.field)

    def state(self) -> str:
        return f"{self.verdict.state} {self.verdict.reason}".rstrip()

    @on(topics.CMD_NAV)
    def command_nav(self, command: Velocity) -> Out:
        if self._usable(topics.CMD_NAV, command, self.situation.nav) and self.situation.nav.take(command, self.now):
            yield from self.drive()

    @on(topics.TELEOP)
    def command_teleop(self, command: Velocity) -> Out:
        source = self.situation.teleop
        if self._usable(topics.TELEOP, command, source) and source.take(command, self.now):
            yield from self.drive()

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        self.situation.now = self.now
        self.situation.take_stop(stop)
        yield from self.drive()

    @on(topics.GUARD)
    def before_the_restart(self, status: GuardStatus) -> Out:
        """STOP outlives the guard, and who pressed it: only a release later than our last word ends it."""
        self.stopped_at = max(self.stopped_at, status.stopped)
        if status.state is GuardState.STOPPED:
            self.situation.now = self.now
            self.situation.take_stop(EmergencyStop(status.stamp, True, "from before a restart"))
            yield from self.drive()

    @on(topics.BASE)
    def base_status(self, status: BaseStatus) -> Out:
        if supersedes(status.stamp, self.situation.base_stamp, self.now):
            self.situation.now = self.now
            self.situation.take_base(status)
            yield from self.watch()
            if status.waits:  # for a zero newer than its fault; ours was perhaps older. Then on, from standing
                self.verdict, self.sent_at = replace(self.verdict, v=0.0, w=0.0), self.now
                yield topics.CMD_VEL(Velocity(self.now, 0.0, 0.0, self.verdict.reason))

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        last = self.situation.odom_stamp
        if self.rejections.judge(topics.ODOM.key, odometry.stamp, last, self.now, MAX_ODOM_AGE):
            self.situation.now = self.now
            self.situation.take_odometry(odometry.stamp)
            if not self.track.add(odometry):
                self.obstacles.forget()
                self.view.forget()
                self.repeats.restart()
                self.situation.take_scan(None)
        return ()

    @on(topics.SCAN)
    def laser(self, scan: LaserScan) -> Out:
        last, age = self.situation.scan, self.config.stops.scan_age
        last_end = scan_end(last) if last else None
        unlike = mismatch(scan, self.robot.laser)
        usable = self.rejections.judge(topics.SCAN.key, scan_end(scan), last_end, self.now, age, unfit=unlike)
        if not usable or self.track.latest is None:
            return
        self.situation.now = self.now
        self.situation.take_scan(scan)
        self.view.take(scan, self.track, self.now)
        self.obstacles.take_scan(scan, self.track, self.view.covered)
        # a cover measures the same always: that it covers is the cause
        frozen = self.repeats.take(scan, self.track.odom_from_base) and not self.view.covered
        if frozen and not self.situation.frozen:
            yield Log("WARNING", f"the laser repeats one scan: {self.repeats.n_repeats} times")
        self.situation.frozen = frozen
        if self.verdict.moves and self._judged().reason not in ("", self.verdict.reason):
            yield from self.drive()

    @on(topics.RANGES)
    def range_readings(self, readings: RangeReadings) -> Out:
        age = self.config.stops.scan_age
        usable = self.rejections.judge(topics.RANGES.key, readings.stamp, self.ranges_stamp, self.now, age)
        if usable and self.track.latest is not None:
            self.ranges_stamp = readings.stamp
            self.obstacles.take_ranges(readings, self.track)
        return ()

    @on(topics.POSE)
    def estimate(self, pose: PoseEstimate) -> Out:
        self.situation.now = self.now
        self.situation.take_pose(pose)
        return ()

    @answer(requests.OVERRIDE)
    def override(self, request: Override) -> Answer[Reply]:
        self.situation.now = self.now
        refused = self.situation.take_override(request.seconds)
        yield from self.drive()
        why = f"{refused.text}: {refused.mend}" if refused else ""
        return Reply(self.now, refused is None, refused.code if refused else "", why)

    @every(hz=50)
    def watch(self) -> Out:
        """Stops at once, between the ticks that drive."""
        self.situation.now = self.now
        if self.verdict.moves and self._stop() is not None:
            yield from self.drive()

    @every(hz=20)
    def drive(self) -> Out:
        self.verdict = self._judged()
        self.sent_at = self.now
        if self.verdict.state in (GuardState.STOPPED, GuardState.FAULT):
            self.stopped_at = self.now
        yield topics.CMD_VEL(Velocity(self.now, self.verdict.v, self.verdict.w, self.verdict.reason))
        if self.told != (self.verdict.state, self.verdict.source, self.verdict.reason):
            yield from self.tell()

    @every(hz=10)
    def tell(self) -> Out:
        verdict = self.verdict
        self.told = verdict.state, verdict.source, verdict.reason
        yield topics.GUARD(
            GuardStatus(
                self.now,
                *self.told,
                detail=verdict.detail,
                speed_limit=verdict.speed_limit,
                stopped=self.stopped_at,
            )
        )

    def _usable(self, topic: Topic[Velocity], command: Velocity, source: Source) -> bool:
        last = source.command.stamp if source.command else None
        return self.rejections.judge(topic.key, command.stamp, last, self.now, self.config.arbitration.command_age)

    def _judged(self) -> Verdict:
        """The velocity of this tick: the source's, if nothing speaks against it, within limits and field."""
        situation = self.situation
        situation.now = self.now
        source = situation.source
        name = source.name if situation.heard else ""
        stop = self._stop()
        if stop is not None or source.command is None:
            reason, state = stop or (reasons.NO_COMMAND, GuardState.IDLE)
            return Verdict(state, reason.code, name, detail=self._detail(reason, state))
        drive, field, command = self.robot.drive, self.config.field, source.command
        if situation.overridden:
            return self._overridden(command, name)
        here = self.track.odom_from_base
        wanted, unseen = self._seen_ahead(*drive.clamped(command.v, command.w))
        points = np.concatenate([self.obstacles.points(here, self.now), self.view.points(here)])
        permit = permitted(points, self.corners, *wanted, drive, field)
        target = wanted[0] * permit.share, wanted[1] * permit.share
        v, w = self._ramped(target)
        if unseen is reasons.SCAN_BLIND:  # slower at once, as a stop would be
            v, w = (min(pair, key=abs) for pair in zip((v, w), target, strict=True))
        w = drive.bent(v, w)
        # accelerating bends the arc: what goes out is judged too
        check = FREE if (v, w) == target else permitted(points, self.corners, v, w, drive, field)
        v, w = v * check.share, w * check.share
        slowed = permit if permit.share < check.share else check
        limit = abs(wanted[0]) * slowed.share if slowed.share < 1 else drive.max_speed
        detail = f"contact after {slowed.travel:.2f} m" if slowed.share < 1 else ""
        state, told = _told(command, wanted, (v, w), permit, slowed)
        if unseen is not None and state is GuardState.ACTIVE and slowed.share == 1:
            told, detail, limit = unseen.code, self.view.detail, field.blind_speed
        return Verdict(state, told, name, v, w, limit, detail)

    def _stop(self) -> tuple[Reason, GuardState] | None:
        """The highest reason to stand, with what the laser sees of where the command leads."""
        command = self.situation.source.command
        self.situation.blind = command is not None and self.view.blind(command.v, command.w, self.now)
        return self.situation.stop()

    def _detail(self, reason: Reason, state: GuardState) -> str:
        """What people must know beside the reason."""
        if reason is reasons.SCAN_FROZEN:
            return f"{self.repeats.n_repeats} times the same ranges with new stamps"
        return self.view.detail if reason is reasons.SCAN_BLIND else self.situation.told(reason, state)

    def _overridden(self, command: Velocity, name: str) -> Verdict:
        """What a hand commands, at a creep, whatever is in the way."""
        field = self.config.field
        v, w = self.robot.drive.clamped(command.v, command.w)
        share = min(1.0, *(most / abs(x) for x, most in ((v, field.creep_speed), (w, field.creep_turn_rate)) if x))
        detail = "nothing keeps the robot from what is in its way"
        v, w = self._ramped((v * share, w * share))
        w = self.robot.drive.bent(v, w)
        return Verdict(GuardState.ACTIVE, reasons.OVERRIDE.code, name, v, w, field.creep_speed, detail)

    def _ramped(self, target: tuple[float, float]) -> tuple[float, float]:
        """The velocity now, on the way from the last one sent to the target."""
        elapsed = (self.now - self.sent_at) * 1e-9
        elapsed = elapsed if 0 <= elapsed <= LONGEST_RAMP else LONGEST_RAMP
        return ramped((self.verdict.v, self.verdict.w), target, elapsed, self.robot.drive)

    def _seen_ahead(self, v: float, w: float) -> tuple[tuple[float, float], Reason | None]:
        """The velocity, slow where the robot would drive in a direction that no sensor covers, or blindly; and why."""
        blind, scan = self.config.field.blind_speed, self.situation.scan
        if self.situation.blind:
            fastest = max(abs(v), abs(w) * self.robot.circumscribed_radius)
            share = min(1.0, blind / fastest) if fastest else 1.0
            return (v * share, w * share), reasons.SCAN_BLIND
        if abs(v) <= blind or scan is None:
            return (v, w), None
        ahead = 0.0 if v > 0 else pi
        seen = looks_at(scan, np.array([ahead - self.robot.laser.mount.yaw])).all()
        empty = self.view.empty(ahead, self.now)
        alive = self.ranges_stamp is not None and fresh(self.ranges_stamp, self.now, RANGES_AGE)
        sensed = alive and any(abs(wrapped(s.mount.yaw - ahead)) <= pi / 4 for s in self.robot.ranges)
        if sensed or (seen and not empty):
            return (v, w), None
        share = blind / abs(v)
        return (v * share, w * share), reasons.SCAN_EMPTY if seen else None


def _told(
    command: Velocity, wanted: tuple[float, float], output: tuple[float, float], permit: Permit, slowed: Permit
) -> tuple[GuardState, str]:
    """State and reason where nothing stops the robot outright. wanted: the command within the robot's limits."""
    stands = output == (0.0, 0.0)
    if Source.wants_zero(command):
        if stands:
            return GuardState.IDLE, command.reason or reasons.NO_COMMAND.code
        return GuardState.ACTIVE, command.reason
    if wanted == (0.0, 0.0):
        return GuardState.HOLD, (reasons.NO_REVERSE if command.v else reasons.NO_TURN_IN_PLACE).code
    if permit.share == 0 or (stands and slowed.share == 0):
        return GuardState.HOLD, reasons.OBSTACLE.code
    if slowed.share < 1:
        return GuardState.ACTIVE, reasons.OBSTACLE_SLOW.code
    # nobody else says why a robot that drives is slow
    return GuardState.ACTIVE, command.reason if command.reason == reasons.SPEED_ZONE.code else ""
