# SPDX-License-Identifier: Apache-2.0
"""The scans of one laser as an input of the mapper: which of them are usable. The rules are our own."""

from shared.config import Laser
from shared.geometry import Pose2
from shared.messages import LaserScan
from shared.rejections import RejectionCause, Rejections
from shared.scan_faults import RepeatedScans, mismatch
from shared.service import Log, Out
from shared.topics import Topic
from shared.types import NS_PER_S

MAX_AGE_S = 1.0  # of a scan when it arrives: an older one measures a former pose


class ScanSource:
    """One laser and its topic.  last_end: ns, end of its last scan in use, -1 without any."""

    def __init__(self, topic: Topic[LaserScan], laser: Laser, rejections: Rejections) -> None:
        """rejections: counts the dropped scans."""
        self.key, self.laser, self.rejections = topic.key, laser, rejections
        self.repeats = RepeatedScans(laser.mount)
        self.last_end = -1

    def is_usable(self, scan: LaserScan, base_pose: Pose2, now: int) -> bool:
        """Whether a scan may be matched; else it is counted. base_pose: newest one by odometry. now: ns."""
        end = scan_end(scan)
        last, unlike = self.last_end if self.last_end >= 0 else None, mismatch(scan, self.laser)
        if not self.rejections.judge(self.key, end, last, now, MAX_AGE_S, unfit=unlike):
            return False
        if end <= self.last_end:  # the clock was set back by less than a second
            self.rejections.reject(self.key, RejectionCause.SEQUENCE, "stamps go back", now)
            return False
        if self.repeats.take(scan, base_pose):
            detail = f"the laser repeats one scan: {self.repeats.n_repeats} times"
            self.rejections.reject(self.key, RejectionCause.REPEATED, detail, now)
            return False
        return True

    def drop_log(self) -> Out:
        """The log of a dropped scan: of the first one, and of each hundredth."""
        n = sum(self.n_dropped.values())
        if n == 1 or n % 100 == 0:
            yield Log("WARNING", f"{self.key} dropped: {self.rejections.last_problem(self.key)} ({n} so far)")

    @property
    def n_dropped(self) -> dict[str, int]:
        """Number of dropped scans by cause."""
        return {str(kind): self.rejections.counts.get((self.key, kind), 0) for kind in RejectionCause}


def scan_end(scan: LaserScan) -> int:
    """ns of the last beam."""
    return scan.stamp + round(scan.scan_time * NS_PER_S)
