# SPDX-License-Identifier: Apache-2.0
"""When a scan is placed, and the motion that led to it: it waits until odometry covers its end, but not for long."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.mapper.deskew import deskewed
from services.mapper.occupancy import OccupancyConfig
from services.mapper.odometry_error import OdometryError
from services.mapper.odometry_track import OdometryConfig, OdometryTrack
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2, interpolated
from shared.messages import LaserScan, Odometry
from shared.rejections import Kind, Rejections, duration
from shared.scan_faults import RepeatedScans, mismatch
from shared.service import Log, Out
from shared.stamps import FUTURE

Float64s = NDArray[np.float64]

SECOND = 1_000_000_000
MAX_AGE = 1.0  # s; a scan that is older when it arrives says where the robot was, not where it is


@dataclass(frozen=True, slots=True)
class Arrival:
    """A scan to be placed.

    end: ns, of the sweep.  seconds: since the last one's, 0 for the first.  step: the motion since then, and its
    doubt: how much wider the prior is.  skew: the share of the step that the sweep took.  odom_from_base: at the end,
    as odometry publishes it.  origins, ends: (n, 2) m in `base` at the end, ends NaN without an echo.  silent: (n, 2) m
    in `base`, up to where a beam without an echo is free; NaN where it says nothing.
    """

    end: int
    seconds: float
    step: Pose2
    doubt: float
    skew: float
    odom_from_base: Pose2
    origins: Float64s
    ends: Float64s
    silent: Float64s


class Arrivals:
    """Odometry and scans by time. blind_doubt: an arrival's doubt without odometry. rejections: where drops count."""

    def __init__(
        self,
        config: OdometryConfig,
        occupancy: OccupancyConfig,
        robot: Robot,
        blind_doubt: float,
        rejections: Rejections,
    ) -> None:
        self.config, self.occupancy, self.blind_doubt = config, occupancy, blind_doubt
        self.laser, self.mount = robot.laser, robot.laser.mount
        self.repeats = RepeatedScans(robot.laser.mount)
        self.track = OdometryTrack(config, robot.drive)
        self.pending: tuple[int, LaserScan] | None = None  # when it came, and the scan
        self.last_end = -1  # ns, end of the last scan that was placed
        self.velocity = Pose2()  # motion a second between the last two scans
        self.blind = False  # the last scan was placed without odometry
        self.rejections = rejections

    def start(self) -> None:
        """Another map: the scan that waits is not placed on it, and nothing is known of the motion."""
        self.pending, self.velocity = None, Pose2()

    def hear(self, odometry: Odometry, now: int) -> Out:
        """Takes odometry, unless its stamp is another clock's."""
        if odometry.stamp > now + FUTURE:
            words = f"stamps are {duration(odometry.stamp - now)} ahead"
            self.rejections.reject(topics.ODOM.key, Kind.AHEAD, words, now)
            return
        if odometry.stamp < self.track.newest - SECOND and odometry.stamp > now - SECOND:
            self.track.clear()  # the clock was set back
            self.repeats.restart()
            self.blind = True
        jumps = self.track.n_jumps
        self.track.add(odometry, broken=self.blind and self.track.newest <= self.last_end)
        if self.track.n_jumps > jumps:
            yield Log("WARNING", "odometry jumped farther than the robot can drive: the pose on the map stays")

    def heard_clock(self, now: int) -> Out:
        """Notices a clock that was set back: the scans from before are of another time."""
        if now < self.last_end - SECOND:
            yield Log("WARNING", "the clock was set back: going on from here")
            self.last_end = -1
            self.pending = None

    def file(self, scan: LaserScan, now: int) -> Out:
        """Lets a scan wait to be placed, or drops it."""
        end, key = _end(scan), topics.SCAN.key
        last, unlike = self.last_end if self.last_end >= 0 else None, mismatch(scan, self.laser)
        usable = self.rejections.judge(key, end, last, now, MAX_AGE, unfit=unlike)
        if usable and end <= self.last_end:  # the clock was set back by less than a second
            self.rejections.reject(key, Kind.SEQUENCE, "stamps go back", now)
        elif usable and self.repeats.take(
            scan, self.track.samples[-1].start_from_base if self.track.samples else Pose2()
        ):
            self.rejections.reject(
                key, Kind.REPEATED, f"the laser repeats one scan: {self.repeats.n_repeats} times", now
            )
        elif usable:
            self.pending = now, scan
            return
        n = sum(self.n_dropped.values())
        if n == 1 or n % 100 == 0:
            yield Log("WARNING", f"scan dropped: {self.rejections.why(key)} ({n} so far)")

    @property
    def n_dropped(self) -> dict[str, int]:
        """Scans that were dropped, by why."""
        return {str(kind): self.rejections.counts.get((topics.SCAN.key, kind), 0) for kind in Kind}

    @property
    def covered(self) -> bool:
        """Whether odometry reaches to the end of the scan that waits."""
        return self.pending is not None and self.track.newest >= _end(self.pending[1])

    @property
    def hopeless(self) -> bool:
        """Whether a scan waits for odometry that has fallen silent."""
        return self.pending is not None and self._silent(_end(self.pending[1]))

    def waited(self, now: int) -> bool:
        """Whether a scan has waited long enough."""
        return self.pending is not None and now - self.pending[0] >= self.config.late * SECOND

    def take(self, error: OdometryError) -> Arrival:
        """The scan that waits, de-skewed by odometry less its known error."""
        assert self.pending is not None
        scan, self.pending = self.pending[1], None
        end = _end(scan)
        self.blind = self._silent(end)
        seconds = (end - self.last_end) * 1e-9 if self.last_end >= 0 else 0.0
        step = self._step(end, seconds)
        origins, ends = deskewed(scan, self.mount, *self._motion(scan, end, error))
        self.last_end = end
        doubt = self.blind_doubt if self.blind else 1.0
        free = self._free(scan, origins, ends)
        skew = min(scan.scan_time / seconds, 1.0) if seconds > 0 else 0.0
        return Arrival(end, seconds, step, doubt, skew, self._odom_from_base(end), origins, ends, free)

    def moved(self, motion: Pose2, seconds: float) -> None:
        """How the robot turned out to have moved since the last scan."""
        drivable = 0.02 <= seconds <= 1 and self.track.plausible(motion, seconds)
        self.velocity = _scaled(motion, 1 / seconds) if drivable else Pose2()

    def _silent(self, end: int) -> bool:
        return not self.track.samples or self.track.newest < end - self.config.timeout * SECOND

    def _odom_from_base(self, end: int) -> Pose2:
        return self.track.odom_from_start(end) @ self.track.at(end) if self.track.samples else Pose2()

    def _step(self, end: int, seconds: float) -> Pose2:
        """The motion since the last placed scan: by odometry, or at the last known speed."""
        if self.last_end < 0:
            return Pose2()
        if self.blind:
            return _scaled(self.velocity, min(seconds, 1.0))
        return self.track.at(self.last_end).inverse() @ self.track.at(end)

    def _motion(self, scan: LaserScan, end: int, error: OdometryError) -> tuple[Float64s, Float64s]:
        if not self.blind:
            times, motion = self.track.during(scan.stamp, end)
            return times, motion * (error.forward.gain, error.forward.gain, error.turn.gain)
        back = _scaled(self.velocity, scan.scan_time).inverse()
        return np.array((-scan.scan_time, 0.0)), np.array(((back.x, back.y, back.yaw), (0.0, 0.0, 0.0)))

    def _free(self, scan: LaserScan, origins: Float64s, ends: Float64s) -> Float64s:
        """Where beams without an echo were free, in `base`; NaN where they say nothing, which is the default."""
        out = np.full_like(ends, np.nan)
        share = self.occupancy.no_echo_free
        if share > 0:
            none = np.isnan(scan.ranges) | (scan.ranges >= scan.range_max)
            angles = self.mount.yaw + scan.angle_min + scan.angle_increment * np.flatnonzero(none)
            reach = share * min(scan.range_max, self.occupancy.range_max)
            out[none] = origins[none] + reach * np.column_stack((np.cos(angles), np.sin(angles)))
        return out


def _end(scan: LaserScan) -> int:
    return scan.stamp + round(scan.scan_time * SECOND)


def _scaled(motion: Pose2, factor: float) -> Pose2:
    return interpolated(Pose2(), motion, factor)
