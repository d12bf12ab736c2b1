# SPDX-License-Identifier: Apache-2.0
"""`zenav calibrate odometry`: from a drive to wheel radii and wheel distance, by UMBmark and by the scans."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shared.config import Robot, UserError
from shared.geometry import Pose2
from shared.types import Float64s, Int64s
from zenav.calibrate.hand_eye import HandEyeSolution, MotionIntervals, intervals, solve
from zenav.calibrate.log import CalibrationLog, true_poses
from zenav.calibrate.rolling import WheelGeometry, WheelTravel, composed_poses, relative_poses
from zenav.calibrate.scan_track import ScanTrack, scan_track
from zenav.calibrate.umbmark import SquareRun, UmbmarkResult, ends_at, errors, largest_error, square_runs, umbmark
from zenav.render.chart import AFTER, BEFORE, OTHER, TRUE, Chart

WINDOW = 2.0  # m that drift is measured over
PASSES = 2  # scans are placed again with what the first pass found


@dataclass(frozen=True, slots=True)
class BasePoses:
    """A truth to compare odometry with: the base's poses (n, 3), yaw unwrapped, at stamps (n,) ns."""

    stamps: Int64s
    poses: Float64s


@dataclass(frozen=True, slots=True)
class Squares:
    """UMBmark's runs, with each one's true motion (k, 3), and what it found."""

    runs: Sequence[SquareRun]
    true: Float64s
    result: UmbmarkResult


def by_scans(log: CalibrationLog, robot: Robot) -> tuple[HandEyeSolution, MotionIntervals, ScanTrack]:
    """Wheels and laser mount that make the wheels' motion and the scans' one. Raises UserError where it cannot."""
    rolled, mount = log.rolled, mount_of(robot)
    wheels = WheelGeometry.of(robot.drive)
    for _ in range(PASSES):
        track = scan_track(log.scans, rolled, robot, wheels, mount)
        pieces = intervals(rolled, track)
        solution = solve(pieces, wheels, mount)
        wheels, mount = solution.wheels, solution.mount
    return solution, pieces, track


def mount_of(robot: Robot) -> Float64s:
    """(3,) base_from_laser, as configured."""
    mount = robot.laser.mount
    return np.array((mount.x, mount.y, mount.yaw))


def truth(
    log: CalibrationLog, robot: Robot, source: str, track: ScanTrack | None, mount: Float64s | None = None
) -> BasePoses:
    """The base's poses by the `scans` (track, where they are placed already), the mapper's `pose`, or the `sim`.

    mount: (3,) base_from_laser, if it is known better than configured.
    """
    if source == "scans":
        mount = mount_of(robot) if mount is None else mount
        track = track or scan_track(log.scans, log.rolled, robot, WheelGeometry.of(robot.drive), mount)
        back = Pose2(*(float(v) for v in mount)).inverse()
        return BasePoses(track.stamps, composed_poses(track.poses, np.array((back.x, back.y, back.yaw))))
    if source == "pose":
        stamps, poses = [e.stamp for e in log.poses], [e.map_from_base for e in log.poses]
    else:
        stamps, poses = true_poses(log)
    if len(stamps) < 2:
        key = "pose" if source == "pose" else "sim/truth"
        raise UserError(f"there is no {key} in this drive", "take --truth scans")
    rows = np.array([(p.x, p.y, p.yaw) for p in poses])
    rows[:, 2] = np.unwrap(rows[:, 2])
    return BasePoses(np.array(stamps, np.int64), rows)


def by_squares(log: CalibrationLog, robot: Robot, track: BasePoses | None, measured: Float64s | None = None) -> Squares:
    """UMBmark over the squares in a drive; their ends by `track`, or as `measured` (k, 2) m with a tape.

    Raises UserError where there are none, or not both ways round.
    """
    rolled, wheels = log.rolled, WheelGeometry.of(robot.drive)
    runs = square_runs(rolled, wheels)
    if not runs:
        raise UserError(
            "there is no square in this drive",
            "UMBmark wants squares both ways round, the robot standing for 1.5 s between two; or take --method scans",
        )
    if measured is not None:
        if len(measured) != len(runs):
            raise UserError(
                f"{len(runs)} squares were driven, {len(measured)} measured", "do not move the robot while it drives"
            )
        true = np.column_stack((measured, np.zeros(len(measured))))
    else:
        assert track is not None
        true = ends_at(track.stamps, track.poses, rolled, runs)
    return Squares(runs, true, umbmark(true, rolled, runs, wheels))


def square_error(squares: Squares, rolled: WheelTravel, wheels: WheelGeometry) -> float:
    """m: E_max,syst of these squares, had the robot had these wheels."""
    off = errors(squares.true, rolled, squares.runs, wheels)
    clockwise = np.array([run.clockwise for run in squares.runs], bool)
    return largest_error(off[clockwise], off[~clockwise])


def drift(rolled: WheelTravel, track: BasePoses, wheels: WheelGeometry) -> tuple[float, float] | None:
    """Odometry's error with these wheels: m a metre and rad a metre, over WINDOW m, rms; None in a shorter drive."""
    path = rolled.with_samples(track.stamps)
    inside = (track.stamps >= rolled.stamps[0]) & (track.stamps <= rolled.stamps[-1])
    rows = np.flatnonzero(inside)
    distances = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(track.poses[rows, :2], axis=0).T))))
    marks = rows[np.searchsorted(distances, np.arange(0.0, distances[-1] if len(distances) else 0.0, WINDOW))]
    if len(marks) < 2:
        return None
    begin, end = marks[:-1], marks[1:]
    whole = rolled.is_known(track.stamps[begin], track.stamps[end])
    begin, end = begin[whole], end[whole]
    poses, index = path.poses(wheels), np.searchsorted(path.stamps, track.stamps)
    off = relative_poses(track.poses[begin], track.poses[end]) - relative_poses(poses[index[begin]], poses[index[end]])
    if not len(off):
        return None
    return float(np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2))) / WINDOW, float(
        np.sqrt(np.mean(off[:, 2] ** 2))
    ) / WINDOW


def charts(
    log: CalibrationLog, robot: Robot, track: BasePoses | None, squares: Squares | None, after: WheelGeometry
) -> list[Chart]:
    """Where the squares ended, and the way by odometry before and after."""
    rolled, before = log.rolled, WheelGeometry.of(robot.drive)
    drawn_charts = []
    if squares is not None:
        ends = Chart("End of each square less odometry's (UMBmark)", "m along the first side", "m to its left", True)
        clockwise = np.array([run.clockwise for run in squares.runs], bool)
        for wheels, name, colours in ((before, "before", (BEFORE, OTHER)), (after, "after", (AFTER, TRUE))):
            off = errors(squares.true, rolled, squares.runs, wheels)
            ends.dots(off[clockwise, 0], off[clockwise, 1], colours[0], f"clockwise, {name}")
            ends.dots(off[~clockwise, 0], off[~clockwise, 1], colours[1], f"counter-clockwise, {name}")
        ends.dots([0], [0], (0, 0, 0))
        drawn_charts.append(ends)
    path_chart = Chart("The way, all begun alike", "x, m", "y, m", True)
    if track is not None:
        inside = np.flatnonzero((track.stamps >= rolled.stamps[0]) & (track.stamps <= rolled.stamps[-1]))
        if len(inside):
            path = rolled.with_samples(track.stamps)
            index = np.searchsorted(path.stamps, track.stamps[inside])
            for wheels, colour, name in ((before, BEFORE, "odometry before"), (after, AFTER, "odometry after")):
                poses = from_start(path.poses(wheels)[index])
                path_chart.line(poses[:, 0], poses[:, 1], colour, name)
            true = from_start(track.poses[inside])
            path_chart.line(true[:, 0], true[:, 1], TRUE, "truth")
    else:
        for wheels, colour, name in ((before, BEFORE, "odometry before"), (after, AFTER, "odometry after")):
            poses = rolled.poses(wheels)
            path_chart.line(poses[:, 0], poses[:, 1], colour, name)
    return [*drawn_charts, path_chart]


def from_start(poses: Float64s) -> Float64s:
    """(n, 3) poses seen from the first one."""
    return relative_poses(np.broadcast_to(poses[0], poses.shape), poses)
