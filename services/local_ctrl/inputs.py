# SPDX-License-Identifier: Apache-2.0
"""The newest inputs of local control, their ages, and whether the robot may move on them."""

import numpy as np
from pydantic import Field

from services.local_ctrl.local_costmap import CostmapConfig
from shared import reasons, topics
from shared.config import Robot, Section
from shared.geometry import Pose2
from shared.lasers import NO_SECOND_LASER, lasers_by_topic
from shared.messages import LaserScan, Localization, Odometry, PoseEstimate, RangeReadings
from shared.odometry_buffer import OdometryBuffer
from shared.reasons import Reason
from shared.rejections import RejectionCause, Rejections
from shared.scan_faults import mismatch
from shared.types import NS_PER_S, Bools, Float64s

MAX_SCAN_AGE_S = 1.0  # at its arrival


class AgesConfig(Section):
    """Maximum ages of the inputs while the robot moves. A stamp equally far in the future is too old as well."""

    odometry: float = Field(0.2, ge=0.02, le=5, description="s")
    scan: float = Field(0.3, ge=0.02, le=5, description="s since the sweep's end")
    pose: float = Field(1.0, ge=0.1, le=10, description="s")
    plan: float = Field(2.0, ge=0.1, le=60, description="s")
    plan_for_new_goal: float = Field(
        1.0, ge=0, le=10, description="s that the plan of the goal before is followed after a new goal"
    )
    pose_jump: float = Field(0.5, ge=0.05, le=10, description="m that the pose may jump without a new plan")


class ControlInputs:
    """The last seconds of odometry, the newest scan of each laser, and the newest pose. Times are ns."""

    def __init__(self, ages: AgesConfig, robot: Robot) -> None:
        self.ages = ages
        self.odometry = OdometryBuffer(robot.drive)
        self.lasers = {topic.key: laser for topic, laser in lasers_by_topic(robot).items()}
        self.scans: dict[str, LaserScan] = {}  # by the topic's key
        self.ranges_stamp: int | None = None  # of the newest readings of the range sensors
        self.pose: PoseEstimate | None = None
        self.restarted_at = 0  # ns, last restart of odometry: poses from before belong to another `odom`
        self.jumped_at = 0  # ns, last jump of the pose: plans from before start elsewhere

    def add_odometry(self, odometry: Odometry) -> bool:
        """Takes the newest odometry. Returns False where it does not continue the last one: odometry restarted."""
        continues = self.odometry.add(odometry)
        if not continues:
            self.scans.clear()
            self.pose = None
            self.restarted_at = self.jumped_at = odometry.stamp
        return continues

    def add_scan(self, key: str, scan: LaserScan, rejections: Rejections, now: int) -> Float64s | None:
        """Takes a laser's scan unless its stamp or beams are wrong, or odometry does not cover it.

        key: of its topic.  Returns (n, 3) float64 x, y, yaw of the base in `odom` at each beam; None for a rejected
        scan.
        """
        if key not in self.lasers:
            rejections.reject(key, RejectionCause.CONTENT, NO_SECOND_LASER, now)
            return None
        last, unlike = self.scans.get(key), mismatch(scan, self.lasers[key])
        last_end = scan_end(last) if last is not None else None
        if not rejections.judge(key, scan_end(scan), last_end, now, MAX_SCAN_AGE_S, unfit=unlike):
            return None
        if last is not None and -NS_PER_S < scan.stamp - last.stamp <= 0:
            return None
        if not self.odometry.covers(scan.stamp, scan_end(scan)):
            return None
        self.scans[key] = scan
        return self.odometry.poses(np.linspace(0.0, scan.scan_time, len(scan.ranges)), scan.stamp)

    def add_ranges(self, readings: RangeReadings, rejections: Rejections, now: int) -> Pose2 | None:
        """Takes readings of the range sensors unless their stamp is wrong.

        Returns the newest pose in `odom`; None for rejected readings, or without odometry.
        """
        if self.odometry.latest is None:
            return None
        if not rejections.judge(topics.RANGES.key, readings.stamp, self.ranges_stamp, now, self.ages.scan):
            return None
        self.ranges_stamp = readings.stamp
        return self.odometry.odom_from_base

    def add_pose(self, pose: PoseEstimate) -> None:
        """Takes a pose unless it is out of order or older than the last restart of odometry."""
        if pose.stamp < self.restarted_at:
            return
        if self.pose is not None:
            if -NS_PER_S < pose.stamp - self.pose.stamp <= 0:
                return
            if self.map_from_base(pose).distance(self.map_from_base(self.pose)) > self.ages.pose_jump:
                self.jumped_at = pose.stamp
        self.pose = pose

    def map_from_base(self, pose: PoseEstimate) -> Pose2:
        """The robot's pose in `map` now, by `pose`."""
        return pose.map_from_odom @ self.odometry.odom_from_base

    @property
    def odom_from_map(self) -> Pose2:
        """By the newest pose; the identity without one."""
        return self.pose.map_from_odom.inverse() if self.pose is not None else Pose2()

    def stale_input(self, now: int, rejections: Rejections) -> Reason | None:
        """The reason to stand: odometry or a scan is missing or too old; else None. rejections: of these inputs."""
        odometry = self.odometry.latest
        if odometry is None or abs(now - odometry.stamp) > self.ages.odometry * NS_PER_S:
            return reasons.BAD_STAMPS if rejections.late_cause(topics.ODOM.key, now) else reasons.ODOM_OLD
        for key in self.lasers:
            scan = self.scans.get(key)
            if scan is None or abs(now - scan_end(scan)) > self.ages.scan * NS_PER_S:
                return reasons.BAD_STAMPS if rejections.late_cause(key, now) else reasons.SCAN_OLD
        return None

    def localization_fault(self, now: int) -> Reason | None:
        """The reason why the pose cannot be used, or None."""
        if self.pose is None or abs(now - self.pose.stamp) > self.ages.pose * NS_PER_S:
            return reasons.POSE_OLD
        return reasons.POSE_LOST if self.pose.state is Localization.LOST else None


def scan_end(scan: LaserScan) -> int:
    """ns of the last beam."""
    return scan.stamp + round(scan.scan_time * NS_PER_S)


def sensors_in_use(robot: Robot, costmap: CostmapConfig) -> tuple[Bools, Float64s]:
    """(n,) which range sensors of the robot are in use, and (n, 2) m, their least and largest range."""
    kinds = {"ultrasonic": costmap.ultrasonic, "infrared": costmap.infrared}
    wanted = np.array([kinds[sensor.kind] for sensor in robot.ranges], bool)
    return wanted, np.array([(s.range_min, s.range_max) for s in robot.ranges], float).reshape(-1, 2)
