# SPDX-License-Identifier: Apache-2.0
"""Synchronisation of scans with odometry: a scan waits until odometry covers its end, for a bounded time.

A scan leaves the queue de-skewed, with the motion since the last one. The wait is that of `tf2_ros::MessageFilter` of
ROS, with a deadline. The rules for clocks and dropped scans are our own.
"""

from dataclasses import dataclass

import numpy as np

from services.mapper.front_end.continuous_odometry import ContinuousOdometry, OdometryConfig
from services.mapper.front_end.deskew import deskew
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.grid.occupancy import OccupancyConfig
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2, interpolated
from shared.messages import LaserScan, Odometry
from shared.rejections import RejectionCause, Rejections, duration
from shared.scan_faults import RepeatedScans, mismatch
from shared.service import Log, Out
from shared.stamps import FUTURE
from shared.types import NS_PER_S, Float64s

MAX_AGE_S = 1.0  # of a scan when it arrives: an older one measures a former pose


@dataclass(frozen=True, slots=True)
class SyncedScan:
    """A de-skewed scan, and the motion since the last one.

    end: ns, of the sweep.  seconds: since the end of the last one, 0 for the first.  step: motion in that time, in
    `base`.  sigma_factor: of its standard deviations, over 1 without odometry.  skew: share of the step that the sweep
    took.  odom_from_base: pose at the end, as published.
    origins, ends: (n, 2) m in `base` at the end, ends NaN without an echo.
    silent: (n, 2) m in `base`, end of the free part of a beam without an echo, NaN elsewhere.
    """

    end: int
    seconds: float
    step: Pose2
    sigma_factor: float
    skew: float
    odom_from_base: Pose2
    origins: Float64s
    ends: Float64s
    silent: Float64s


class ScanQueue:
    """Odometry by time, and one scan that waits for it.

    velocity: motion a second between the last two scans.  last_end: ns, end of the last scan, -1 without any.
    is_blind: whether the last scan had no odometry.
    """

    def __init__(
        self,
        config: OdometryConfig,
        occupancy: OccupancyConfig,
        robot: Robot,
        blind_doubt: float,
        rejections: Rejections,
    ) -> None:
        """blind_doubt: sigma_factor of a scan without odometry.  rejections: counts the dropped scans."""
        self.config, self.occupancy, self.blind_doubt = config, occupancy, blind_doubt
        self.laser, self.mount = robot.laser, robot.laser.mount
        self.repeats = RepeatedScans(robot.laser.mount)
        self.odometry = ContinuousOdometry(config, robot.drive)
        self.pending: tuple[int, LaserScan] | None = None  # ns, time of its arrival; the scan
        self.last_end = -1
        self.velocity = Pose2()
        self.is_blind = False
        self.rejections = rejections

    def reset(self) -> None:
        """Drops the waiting scan and the velocity: another map begins."""
        self.pending, self.velocity = None, Pose2()

    def add_odometry(self, odometry: Odometry, now: int) -> Out:
        """Adds odometry, unless its stamp lies in the future. Logs a jump. now: ns."""
        if odometry.stamp > now + FUTURE:
            detail = f"stamps are {duration(odometry.stamp - now)} ahead"
            self.rejections.reject(topics.ODOM.key, RejectionCause.AHEAD, detail, now)
            return
        if odometry.stamp < self.odometry.newest - NS_PER_S and odometry.stamp > now - NS_PER_S:
            self.odometry.clear()  # the clock was set back
            self.repeats.restart()
            self.is_blind = True
        jumps = self.odometry.n_jumps
        self.odometry.add(odometry, is_restart=self.is_blind and self.odometry.newest <= self.last_end)
        if self.odometry.n_jumps > jumps:
            yield Log("WARNING", "odometry jumped farther than the robot can drive: the pose on the map stays")

    def check_clock(self, now: int) -> Out:
        """Drops the waiting scan and the last stamp if the clock was set back, and logs that. now: ns."""
        if now < self.last_end - NS_PER_S:
            yield Log("WARNING", "the clock was set back: going on from here")
            self.last_end = -1
            self.pending = None

    def add_scan(self, scan: LaserScan, now: int) -> Out:
        """Adds a scan to the queue, or drops it and logs that. now: ns."""
        end, key = _end(scan), topics.SCAN.key
        last, unlike = self.last_end if self.last_end >= 0 else None, mismatch(scan, self.laser)
        usable = self.rejections.judge(key, end, last, now, MAX_AGE_S, unfit=unlike)
        if usable and end <= self.last_end:  # the clock was set back by less than a second
            self.rejections.reject(key, RejectionCause.SEQUENCE, "stamps go back", now)
        elif usable and self.repeats.take(
            scan, self.odometry.samples[-1].start_from_base if self.odometry.samples else Pose2()
        ):
            self.rejections.reject(
                key, RejectionCause.REPEATED, f"the laser repeats one scan: {self.repeats.n_repeats} times", now
            )
        elif usable:
            self.pending = now, scan
            return
        n = sum(self.n_dropped.values())
        if n == 1 or n % 100 == 0:
            yield Log("WARNING", f"scan dropped: {self.rejections.last_problem(key)} ({n} so far)")

    @property
    def n_dropped(self) -> dict[str, int]:
        """Number of dropped scans by cause."""
        return {str(kind): self.rejections.counts.get((topics.SCAN.key, kind), 0) for kind in RejectionCause}

    @property
    def is_covered(self) -> bool:
        """Whether odometry reaches the end of the waiting scan."""
        return self.pending is not None and self.odometry.newest >= _end(self.pending[1])

    @property
    def lacks_odometry(self) -> bool:
        """Whether a scan waits for odometry that has stopped."""
        return self.pending is not None and self._has_stopped(_end(self.pending[1]))

    def is_overdue(self, now: int) -> bool:
        """Whether a scan has waited for `max_wait`. now: ns."""
        return self.pending is not None and now - self.pending[0] >= self.config.max_wait * NS_PER_S

    def pop(self, error: OdometryError) -> SyncedScan:
        """Removes the waiting scan, and returns it de-skewed by odometry at its estimated scale."""
        assert self.pending is not None
        scan, self.pending = self.pending[1], None
        end = _end(scan)
        self.is_blind = self._has_stopped(end)
        seconds = (end - self.last_end) * 1e-9 if self.last_end >= 0 else 0.0
        step = self._step(end, seconds)
        origins, ends = deskew(scan, self.mount, *self._motion(scan, end, error))
        self.last_end = end
        sigma_factor = self.blind_doubt if self.is_blind else 1.0
        silent = self._silent_ends(scan, origins, ends)
        skew = min(scan.scan_time / seconds, 1.0) if seconds > 0 else 0.0
        return SyncedScan(
            end=end,
            seconds=seconds,
            step=step,
            sigma_factor=sigma_factor,
            skew=skew,
            odom_from_base=self._odom_from_base(end),
            origins=origins,
            ends=ends,
            silent=silent,
        )

    def set_motion(self, motion: Pose2, seconds: float) -> None:
        """Sets the velocity by the motion, in `base`, that the match measured in `seconds` since the scan before."""
        drivable = 0.02 <= seconds <= 1 and self.odometry.is_drivable(motion, seconds)
        self.velocity = _scaled_motion(motion, 1 / seconds) if drivable else Pose2()

    def _has_stopped(self, end: int) -> bool:
        return not self.odometry.samples or self.odometry.newest < end - self.config.timeout * NS_PER_S

    def _odom_from_base(self, end: int) -> Pose2:
        return (
            self.odometry.odom_from_start(end) @ self.odometry.start_from_base(end)
            if self.odometry.samples
            else Pose2()
        )

    def _step(self, end: int, seconds: float) -> Pose2:
        """The motion since the last scan: by odometry, or at the last velocity."""
        if self.last_end < 0:
            return Pose2()
        if self.is_blind:
            return _scaled_motion(self.velocity, min(seconds, 1.0))
        return self.odometry.start_from_base(self.last_end).inverse() @ self.odometry.start_from_base(end)

    def _motion(self, scan: LaserScan, end: int, error: OdometryError) -> tuple[Float64s, Float64s]:
        if not self.is_blind:
            times, motion = self.odometry.motion_during(scan.stamp, end)
            return times, motion * (error.forward_scale.value, error.forward_scale.value, error.turn_scale.value)
        back = _scaled_motion(self.velocity, scan.scan_time).inverse()
        return np.array((-scan.scan_time, 0.0)), np.array(((back.x, back.y, back.yaw), (0.0, 0.0, 0.0)))

    def _silent_ends(self, scan: LaserScan, origins: Float64s, ends: Float64s) -> Float64s:
        """`SyncedScan.silent`; all NaN unless `occupancy.no_echo_free` is set."""
        out = np.full_like(ends, np.nan)
        share = self.occupancy.no_echo_free
        if share > 0:
            no_echo = np.isnan(scan.ranges) | (scan.ranges >= scan.range_max)
            angles = self.mount.yaw + scan.angle_min + scan.angle_increment * np.flatnonzero(no_echo)
            reach = share * min(scan.range_max, self.occupancy.range_max)
            out[no_echo] = origins[no_echo] + reach * np.column_stack((np.cos(angles), np.sin(angles)))
        return out


def _end(scan: LaserScan) -> int:
    return scan.stamp + round(scan.scan_time * NS_PER_S)


def _scaled_motion(motion: Pose2, factor: float) -> Pose2:
    return interpolated(Pose2(), motion, factor)
