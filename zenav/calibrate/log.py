# SPDX-License-Identifier: Apache-2.0
"""What a drive left behind, in a recording or heard live: wheels, scans, poses, commands, in order of their stamps."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from shared import topics
from shared.codec import CodecError, decode
from shared.config import Drive, Laser, Robot, UserError
from shared.geometry import Pose2
from shared.messages import (
    BaseOdometry,
    Imu,
    LaserScan,
    Message,
    MotorCommand,
    PoseEstimate,
    Truth,
    Velocity,
    WheelState,
)
from shared.recording import Recording
from shared.topics import Topic
from zenav.calibrate.base_motion import BaseMotion
from zenav.calibrate.rolling import WheelTravel

TOPICS: tuple[Topic[Any], ...] = (
    topics.WHEELS, topics.BASE_ODOMETRY, topics.SCAN, topics.POSE, topics.TRUTH, topics.CMD_VEL, topics.MOTORS,
    topics.IMU,
)  # fmt: skip


@dataclass
class CalibrationLog:
    """The messages of one drive. `add` files one; whatever comes late or twice is left out.

    drive: of a base with odometry of its own, which is filed as the angles of its wheels.
    """

    drive: Drive | None = None
    wheels: list[WheelState] = field(default_factory=list)
    scans: list[LaserScan] = field(default_factory=list)
    poses: list[PoseEstimate] = field(default_factory=list)
    truth: list[Truth] = field(default_factory=list)
    commands: list[Velocity] = field(default_factory=list)
    motors: list[MotorCommand] = field(default_factory=list)
    imus: list[Imu] = field(default_factory=list)
    n_late: int = 0

    def __post_init__(self) -> None:
        self._base = BaseMotion(self.drive) if self.drive is not None else None

    def add(self, message: Message) -> None:
        """Files a message of one of TOPICS."""
        if isinstance(message, BaseOdometry):
            if self._base is None or (self.wheels and message.stamp <= self.wheels[-1].stamp):
                return
            message = self._base.wheels(message)
        place = self._place(message)
        if place and message.stamp <= place[-1].stamp:
            self.n_late += 1
        else:
            place.append(message)

    def _place(self, message: Message) -> list[Any]:
        places: dict[type[Message], list[Any]] = {
            WheelState: self.wheels, LaserScan: self.scans, PoseEstimate: self.poses, Truth: self.truth,
            Velocity: self.commands, MotorCommand: self.motors, Imu: self.imus,
        }  # fmt: skip
        return places[type(message)]

    @property
    def rolled(self) -> WheelTravel:
        """How the wheels turned. Raises UserError where there is nothing."""
        if len(self.wheels) < 2:
            raise UserError(
                "there is no motion of the base", "record base/wheels or base/odometry: is base_driver running?"
            )
        return WheelTravel.of(self.wheels)

    def during(self, begin: int, end: int) -> "CalibrationLog":
        """The part of the log from `begin` to `end` (ns), both included."""
        part = CalibrationLog()
        for messages in (self.wheels, self.scans, self.poses, self.truth, self.commands, self.motors, self.imus):
            for message in messages:
                if begin <= message.stamp <= end:
                    part.add(message)
        return part


def calibration_log(robot: Robot) -> CalibrationLog:
    """An empty log for this robot."""
    return CalibrationLog(robot.drive if robot.drive.kind == "velocity" else None)


def read_calibration_log(path: Path, robot: Robot, scans: Topic[LaserScan] = topics.SCAN) -> CalibrationLog:
    """The log in a recording of this robot. Raises UserError where it is damaged beyond use, or another robot's.

    scans: the topic of `robot.laser`.
    """
    recording = Recording(path)
    name = recording.about.get("robot", "")
    if name and name != robot.name:
        raise UserError(f"{path} is a recording of {name}, not of {robot.name}", "name its robot: --robot")
    log = calibration_log(robot)
    for entry in recording.entries([scans.key if topic is topics.SCAN else topic.key for topic in TOPICS]):
        topic = topics.BY_KEY[entry.key]
        try:
            log.add(decode(topic.type, entry.payload)[0])
        except CodecError:
            continue  # a message of another version, or damaged: the others count
    if not log.wheels and not log.scans:
        raise UserError(
            f"{path} holds neither base/wheels, base/odometry nor scan of this version",
            "record a drive: zenav up records into recordings/",
        )
    same_laser(log.scans, robot.laser)
    return log


def same_laser(scans: list[LaserScan], laser: Laser) -> None:
    """Raises UserError where the scans are of another laser than the configured one."""
    if not scans:
        return
    scan = scans[len(scans) // 2]
    if abs(scan.angle_increment - laser.angle_increment) > 1e-3 or abs(scan.angle_min - laser.angle_min) > 1e-2:
        geometry = f"first beam {scan.angle_min:.3f}, step {scan.angle_increment:.5f} rad"
        raise UserError(
            f"the scans are of another laser ({geometry}) than robot.laser says",
            "name the robot that recorded: --robot, or correct robot.laser",
        )


def true_poses(log: CalibrationLog) -> tuple[list[int], list[Pose2]]:
    """Stamps and poses by the simulator, in the frame of the first one."""
    start = log.truth[0].world_from_base.inverse() if log.truth else Pose2()
    return [t.stamp for t in log.truth], [start @ t.world_from_base for t in log.truth]
