# SPDX-License-Identifier: Apache-2.0
"""Synchronisation of scans with odometry: a scan waits until odometry covers its end, for a bounded time.

A scan leaves the queue de-skewed, with the motion since the last one, and with the newest scan of a second laser. The
wait is that of `tf2_ros::MessageFilter` of ROS, with a deadline. No scan waits for the second laser. The rule for
clocks is our own.
"""

from dataclasses import dataclass

import numpy as np

from services.mapper.front_end.beams import Beams
from services.mapper.front_end.continuous_odometry import ContinuousOdometry, OdometryConfig
from services.mapper.front_end.deskew import deskew
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.robot_mask import RobotMask
from services.mapper.front_end.scan_source import ScanSource, scan_end
from services.mapper.grid.occupancy import OccupancyConfig
from shared import topics
from shared.config import Mount, Robot
from shared.geometry import Pose2, interpolated
from shared.lasers import SCAN_TOPICS
from shared.messages import LaserScan, Odometry
from shared.rejections import RejectionCause, Rejections, duration
from shared.service import Log, Out
from shared.stamps import FUTURE
from shared.types import NS_PER_S, Float64s

MAX_PERIODS_APART = 1.5  # of the slower laser: from the end of the second laser's scan to that of the first one's
MAX_REMAINING = 2.0  # sweeps of the first laser, from a beam of the second one to the end


@dataclass(frozen=True, slots=True)
class SyncedScan:
    """A de-skewed scan, and the motion since the last one.

    end: ns, of the sweep.  seconds: since the end of the last one, 0 for the first.  step: motion in that time, in
    `base`.  sigma_factor: of its standard deviations, over 1 without odometry.  skew: share of the step that the sweep
    took.  odom_from_base: pose at the end, as published.  beams: of all lasers, at the end.
    """

    end: int
    seconds: float
    step: Pose2
    sigma_factor: float
    skew: float
    odom_from_base: Pose2
    beams: Beams


class ScanQueue:
    """Odometry by time, and one scan of the first laser that waits for it.

    sources: the lasers that map, one or two.  second_scan: newest one of the second laser that was not used yet.
    velocity: motion a second between the last two scans.  is_blind: whether the last scan had no odometry.
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
        lasers = robot.mapping_lasers
        self.sources = [ScanSource(*pair, rejections) for pair in zip(SCAN_TOPICS, lasers, strict=False)]
        self.first = self.sources[0]
        self.max_apart = MAX_PERIODS_APART / min(laser.rate for laser in lasers)  # s
        self.odometry = ContinuousOdometry(config, robot.drive)
        self.odometry_arrived = -1  # ns, when the last message was taken
        self.pending: tuple[int, LaserScan] | None = None  # ns, time of its arrival; the scan
        self.second_scan: LaserScan | None = None
        self.velocity = Pose2()
        self.is_blind = False
        self.rejections, self.robot_mask = rejections, RobotMask()

    def restart(self) -> None:
        """Begins without a last scan: the map of a previous run is used."""
        self.forget_stamps()
        self.velocity = Pose2()

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
            for source in self.sources:
                source.repeats.restart()
            self.is_blind = True
        self.odometry_arrived = now
        jumps = self.odometry.n_jumps
        self.odometry.add(odometry, is_restart=self.is_blind and self.odometry.newest <= self.last_end)
        if self.odometry.n_jumps > jumps:
            yield Log("WARNING", "odometry jumped farther than the robot can drive: the pose on the map stays")

    def check_clock(self, now: int) -> Out:
        """Drops the waiting scan and the last stamp if the clock was set back, and logs that. now: ns."""
        if now < self.last_end - NS_PER_S:
            yield Log("WARNING", "the clock was set back: going on from here")
            self.forget_stamps()
            self.pending = None

    def forget_stamps(self) -> None:
        """The next scans have none before them."""
        self.second_scan = None
        for source in self.sources:
            source.last_end = -1

    def add_scan(self, scan: LaserScan, map_from_base: Pose2, now: int) -> Out:
        """Adds a scan of the first laser to the queue, or drops it and logs that. now: ns."""
        if self.first.is_usable(scan, self._base_pose, now):
            self.pending = now, self.robot_mask.masked(scan, self.first.laser.mount, map_from_base, now)
        else:
            yield from self.first.drop_log()

    def add_second_scan(self, scan: LaserScan, map_from_base: Pose2, now: int) -> Out:
        """Keeps a scan of the second laser for the next one of the first, or drops it and logs that. now: ns."""
        for source in self.sources[1:]:
            if source.is_usable(scan, self._base_pose, now):
                masked = self.robot_mask.masked(scan, source.laser.mount, map_from_base, now)
                self.second_scan, source.last_end = masked, scan_end(scan)
            else:
                yield from source.drop_log()

    @property
    def last_end(self) -> int:
        """ns, end of the last scan; -1 without any."""
        return self.first.last_end

    @property
    def _base_pose(self) -> Pose2:
        """The newest pose by odometry."""
        return self.odometry.samples[-1].start_from_base if self.odometry.samples else Pose2()

    @property
    def n_dropped(self) -> dict[str, int]:
        """Number of dropped scans of the first laser by cause."""
        return self.first.n_dropped

    def state(self) -> str:
        """Words for the health message: dropped scans, and missing odometry; empty without them."""
        n_dropped = sum(sum(source.n_dropped.values()) for source in self.sources)
        dropped = f", {n_dropped} scans dropped" if n_dropped else ""
        return dropped + (", no odometry: scan matching alone" if self.is_blind else "")

    @property
    def is_covered(self) -> bool:
        """Whether odometry reaches the end of the waiting scan."""
        return self.pending is not None and self.odometry.newest >= scan_end(self.pending[1])

    def lacks_odometry(self, now: int) -> bool:
        """Whether a scan waits for odometry that has stopped. now: ns.

        Odometry that arrives late has not stopped: after a pause of this process a scan may come before a second of it.
        """
        is_arriving = 0 <= now - self.odometry_arrived < self.config.max_wait * NS_PER_S
        return self.pending is not None and not is_arriving and self._has_stopped(scan_end(self.pending[1]))

    def is_overdue(self, now: int) -> bool:
        """Whether a scan has waited for `max_wait`. now: ns."""
        return self.pending is not None and now - self.pending[0] >= self.config.max_wait * NS_PER_S

    def pop(self, error: OdometryError) -> SyncedScan:
        """Removes the waiting scan, and returns it de-skewed by odometry at its estimated scale."""
        assert self.pending is not None
        scan, self.pending = self.pending[1], None
        end = scan_end(scan)
        self.is_blind = self._has_stopped(end)
        seconds = (end - self.last_end) * 1e-9 if self.last_end >= 0 else 0.0
        step = self._step(end, seconds)
        beams = self._beams(scan, end, error)
        self.first.last_end = end
        sigma_factor = self.blind_doubt if self.is_blind else 1.0
        skew = min(scan.scan_time / seconds, 1.0) if seconds > 0 else 0.0
        return SyncedScan(
            end=end,
            seconds=seconds,
            step=step,
            sigma_factor=sigma_factor,
            skew=skew,
            odom_from_base=self._odom_from_base(end),
            beams=beams,
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

    def _beams(self, scan: LaserScan, end: int, error: OdometryError) -> Beams:
        """The beams of a scan, and of the newest scan of the second laser, in `base` at `end`, ns."""
        first = self._deskewed(scan, self.first, error)
        second, self.second_scan = self.second_scan, None
        if second is None or abs(scan_end(second) - end) > self.max_apart * NS_PER_S:
            return first
        beams = self._deskewed(second, self.sources[1], error)
        end_from_own = self._motion_to(end, scan_end(second), error)
        before = (end - scan_end(second)) * 1e-9 + second.scan_time * beams.remaining  # s from each beam to the end
        remaining = before / scan.scan_time if scan.scan_time > 0 else np.zeros_like(before)
        return first.joined(
            Beams(
                origins=end_from_own @ beams.origins,
                ends=end_from_own @ beams.ends,
                silent=end_from_own @ beams.silent,
                remaining=remaining.clip(-MAX_REMAINING, MAX_REMAINING),
                n_first=0,
            )
        )

    def _deskewed(self, scan: LaserScan, source: ScanSource, error: OdometryError) -> Beams:
        """The beams of a scan in `base` at its own end."""
        mount, end = source.laser.mount, scan_end(scan)
        origins, ends = deskew(scan, mount, *self._motion(scan, end, error))
        silent, n = self._silent_ends(scan, mount, origins, ends), len(ends)
        return Beams(origins, ends, silent, np.linspace(1, 0, n), n)

    def _motion_to(self, end: int, other: int, error: OdometryError) -> Pose2:
        """The transform to `base` at `end` from `base` at another time near it, ns."""
        if self.is_blind:
            return _scaled_motion(self.velocity, (other - end) * 1e-9)
        motion = self.odometry.start_from_base(end).inverse() @ self.odometry.start_from_base(other)
        forward = error.forward_scale.value
        return Pose2(motion.x * forward, motion.y * forward, motion.yaw * error.turn_scale.value)

    def _motion(self, scan: LaserScan, end: int, error: OdometryError) -> tuple[Float64s, Float64s]:
        if not self.is_blind:
            times, motion = self.odometry.motion_during(scan.stamp, end)
            return times, motion * (error.forward_scale.value, error.forward_scale.value, error.turn_scale.value)
        back = _scaled_motion(self.velocity, scan.scan_time).inverse()
        return np.array((-scan.scan_time, 0.0)), np.array(((back.x, back.y, back.yaw), (0.0, 0.0, 0.0)))

    def _silent_ends(self, scan: LaserScan, mount: Mount, origins: Float64s, ends: Float64s) -> Float64s:
        """`Beams.silent`; all NaN unless `occupancy.no_echo_free` is set."""
        out = np.full_like(ends, np.nan)
        share = self.occupancy.no_echo_free
        if share > 0:
            no_echo = np.isnan(scan.ranges) | (scan.ranges >= scan.range_max)
            angles = mount.yaw + scan.angle_min + scan.angle_increment * np.flatnonzero(no_echo)
            reach = share * min(scan.range_max, self.occupancy.range_max)
            out[no_echo] = origins[no_echo] + reach * np.column_stack((np.cos(angles), np.sin(angles)))
        return out


def _scaled_motion(motion: Pose2, factor: float) -> Pose2:
    return interpolated(Pose2(), motion, factor)
