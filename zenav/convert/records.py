# SPDX-License-Identifier: Apache-2.0
"""What a log of a drive holds for a mapper, whatever its format: odometry, and scans with the odometry at them."""

from dataclasses import dataclass, field

from shared.geometry import Pose2
from shared.types import Float32s


@dataclass(frozen=True, slots=True)
class LoggedPose:
    """Raw wheel odometry."""

    stamp: int  # ns, the log's clock
    odom_from_base: Pose2
    v: float  # m/s
    w: float  # rad/s


@dataclass(frozen=True, slots=True)
class LoggedScan:
    """A sweep, with the odometry at its first beam. range_max: m, 0 where the log does not have it.

    ranges: (n,) m, NaN where nothing was measured.   scan_time: s from the first beam to the last.
    v, w: m/s and rad/s of the base, 0 where the line does not have them.
    """

    stamp: int  # ns, the log's clock
    odom_from_base: Pose2
    odom_from_laser: Pose2
    angle_min: float
    angle_increment: float
    range_max: float
    ranges: Float32s
    scan_time: float = 0.0
    v: float = 0.0
    w: float = 0.0

    @property
    def end(self) -> int:
        """ns, when the last beam was taken."""
        return self.stamp + round(self.scan_time * 1e9)


@dataclass(slots=True)
class DriveLog:
    """A log's records in their order, and what was wrong with it.

    unit: what the log consists of, of which n_bad could not be read.   has_odometry: where it has none, the records'
    poses say nothing.   notes: what was chosen in it, and what was lost, in words for people.
    """

    records: list[LoggedPose | LoggedScan]
    n_bad: int = 0
    truncated: bool = False
    unit: str = "lines"
    has_odometry: bool = True
    notes: list[str] = field(default_factory=list)
