# SPDX-License-Identifier: Apache-2.0
"""What a log, a bag or a recording holds, as the stack's own messages: the middle of every conversion."""

from dataclasses import dataclass, field

import numpy as np

from shared.config import Mount
from shared.geometry import Pose2, interpolated, wrapped
from shared.messages import LaserScan, Message, Odometry
from zenav.convert.records import DriveLog, LoggedPose, LoggedScan

MAX_MOUNT_M = 5.0  # from the base to its laser, as a robot's file has it; what is farther off is another thing
ROUNDING_M = 1e-4  # of poses in a log, seen from each other
NO_RETURN = 0.98  # of the largest range in the log: the scanner's way to say that nothing came back


@dataclass(frozen=True, slots=True)
class Choice:
    """Topics and frames that somebody named; "" is found by type."""

    scan: str = ""
    odom: str = ""
    pose: str = ""
    base_frame: str = ""
    odom_frame: str = ""


@dataclass(slots=True)
class Content:
    """messages: the registry's key and the message, in the order of their stamps.   mount: where the laser sits.

    n_bad: messages that could not be read.   notes: see Log.   lacks: what there is in place of what is looked for.
    """

    messages: list[tuple[str, Message]]
    mount: Mount = field(default_factory=Mount)
    n_bad: int = 0
    notes: list[str] = field(default_factory=list)
    lacks: str = ""


def content_of(log: DriveLog) -> Content:
    """A log's records as messages. A scan's odometry has the speeds of the latest pose; without any pose, its own."""
    messages: list[tuple[str, Message]] = []
    scans = [record for record in log.records if isinstance(record, LoggedScan)]
    range_max = range_max_of(scans) if scans else 0.0
    v, w, has_poses = 0.0, 0.0, len(scans) < len(log.records)
    for record in sorted(log.records, key=lambda record: record.stamp):
        if isinstance(record, LoggedPose) or not has_poses:
            v, w = record.v, record.w
        if log.has_odometry:
            messages.append(("odom", Odometry(record.stamp, record.odom_from_base, v, w, np.zeros(9))))
        if isinstance(record, LoggedScan):
            messages.append(("scan", _scan(record, range_max)))
    notes = [*log.notes, *(["the log ends early: what follows in its zipped data is lost"] if log.truncated else [])]
    return Content(messages, mount_of(scans) if scans else Mount(), log.n_bad, notes)


def _scan(record: LoggedScan, range_max: float) -> LaserScan:
    ranges = np.where(record.ranges < range_max, record.ranges, np.float32(np.nan)).astype(np.float32)
    return LaserScan(
        stamp=record.stamp,
        angle_min=record.angle_min,
        angle_increment=record.angle_increment,
        scan_time=record.scan_time,
        range_min=0.0,
        range_max=range_max,
        ranges=ranges,
    )


def range_max_of(scans: list[LoggedScan]) -> float:
    """m, from which on nothing came back."""
    nominal = max(scan.range_max for scan in scans)
    largest = max(float(np.max(scan.ranges, initial=0.0, where=np.isfinite(scan.ranges))) for scan in scans)
    return max(min(nominal or 250.0, NO_RETURN * largest), 0.1)


def mount_of(scans: list[LoggedScan]) -> Mount:
    """base_from_laser, where it is the same at every scan; corrected logs have another thing in its place."""
    rows = np.array(
        [(p.x, p.y, p.yaw) for p in (scan.odom_from_base.inverse() @ scan.odom_from_laser for scan in scans)]
    )
    rows[:, 2] = np.unwrap(rows[:, 2])  # of a laser that looks back, pi and -pi are one heading
    middle = np.median(rows, axis=0)
    if np.abs(rows - middle).max() > 0.01 or np.abs(middle[:2]).max() > MAX_MOUNT_M + ROUNDING_M:
        return Mount()
    x, y = (float(v) for v in np.clip(middle[:2], -MAX_MOUNT_M, MAX_MOUNT_M))
    return Mount(x=x, y=y, yaw=wrapped(float(middle[2])))


def log_of(content: Content) -> DriveLog:
    """The records that a mapper takes: odometry, and each scan with the odometry at its first beam.

    A scan comes when its last beam was taken. Readings under range_min are no measurements.
    """
    scans = [message for _, message in content.messages if isinstance(message, LaserScan)]
    track = sorted((m for _, m in content.messages if isinstance(m, Odometry)), key=lambda odometry: odometry.stamp)
    base_from_laser = Pose2(content.mount.x, content.mount.y, content.mount.yaw)
    at_scans = odometry_at([scan.stamp for scan in scans], track)
    records: list[LoggedPose | LoggedScan] = []
    for scan, odom_from_base in zip(scans, at_scans):
        ranges = np.where(scan.ranges >= scan.range_min, scan.ranges, np.float32(np.nan)).astype(np.float32)
        records.append(
            LoggedScan(
                stamp=scan.stamp,
                odom_from_base=odom_from_base,
                odom_from_laser=odom_from_base @ base_from_laser,
                angle_min=scan.angle_min,
                angle_increment=scan.angle_increment,
                range_max=scan.range_max,
                ranges=ranges,
                scan_time=scan.scan_time,
            )
        )
    scan_stamps = {scan.stamp for scan in scans}
    records += [LoggedPose(o.stamp, o.odom_from_base, o.v, o.w) for o in track if o.stamp not in scan_stamps]
    records.sort(key=lambda record: record.end if isinstance(record, LoggedScan) else record.stamp)
    return DriveLog(
        records=records,
        n_bad=content.n_bad,
        truncated=False,
        unit="messages",
        has_odometry=bool(track),
        notes=list(content.notes),
    )


def odometry_at(stamps: list[int], track: list[Odometry]) -> list[Pose2]:
    """Odometry, which is in order, at stamps: interpolated; the nearest one's outside, and no motion without any."""
    if not track:
        return [Pose2()] * len(stamps)
    times = np.array([odometry.stamp for odometry in track])
    poses = []
    for stamp, after in zip(stamps, np.searchsorted(times, stamps)):
        late = track[min(int(after), len(track) - 1)]
        early = track[max(int(after) - 1, 0)]
        if late.stamp == stamp or late.stamp <= early.stamp:
            poses.append(late.odom_from_base)
            continue
        share = min(max((stamp - early.stamp) / (late.stamp - early.stamp), 0.0), 1.0)
        poses.append(interpolated(early.odom_from_base, late.odom_from_base, share))
    return poses
