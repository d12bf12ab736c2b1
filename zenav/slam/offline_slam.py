# SPDX-License-Identifier: Apache-2.0
"""`zenav slam`: the mapper's own code over a log of a drive, as fast as it goes."""

import json
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import cos, sin
from pathlib import Path
from time import process_time
from typing import Any, Literal

import numpy as np

from services.mapper.config import MapperConfig
from services.mapper.front_end.registration import Registrar, RegistrationConfig
from services.mapper.maps.map_file import SavedMap
from services.mapper.service import MapperService
from shared.config import Robot, UserError
from shared.geometry import Pose2, interpolated
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, MapUpdate, Odometry, PoseEstimate
from shared.service import Job, Out
from shared.topics import Publication
from shared.types import NS_PER_S, Float64s
from zenav.convert.content import Choice
from zenav.convert.log_robot import robot_of_log
from zenav.convert.records import DriveLog, LoggedPose, LoggedScan
from zenav.convert.source import read_log
from zenav.maps.atomic_folder import replace_together
from zenav.maps.foreign_map import read_map
from zenav.maps.saved_map import map_files
from zenav.slam.odometry_lag import clear_lag, headings, odometry_lag, without_lag

Mode = Literal["map", "localise", "continue"]
"""A new map; the robot found in a saved one, which stays as it is; a saved one that goes on."""

NOTHING = Choice()
MAP_EVERY = 500  # scans between two maps: no client of a log needs them sooner


class OfflineRun:
    """A mapper, fed; what it published, kept."""

    def __init__(self, config: MapperConfig, robot: Robot, saved: SavedMap | None = None, mode: Mode = "map") -> None:
        self.mapper = MapperService(config, robot)
        self.loaded, self.mode = saved, mode
        self.grid = OccupancyGrid()
        self.estimates: list[PoseEstimate] = []
        self.places: list[Pose2] = []  # of the estimates, in the front end's frame
        self.maps_from_local: list[Pose2 | None] = []  # at the estimates, None where the robot was not found yet
        self.logs: list[str] = []
        self.job_seconds = 0.0  # of CPU
        self.lag = self.lag_seconds = 0.0  # s that odometry was late, which is corrected; of CPU to find it
        self._jobs: deque[Job] = deque()
        self.mapper.warm_up()
        if saved is not None:
            self.add(self.mapper.use_map(saved, fixed=mode == "localise"))

    def add(self, out: Out | None) -> None:
        for item in out or ():
            if isinstance(item, Job):
                self._jobs.append(item)
            elif not isinstance(item, Publication):
                self.logs.append(getattr(item, "text", ""))
            elif isinstance(item.message, PoseEstimate):
                self.estimates.append(item.message)
                self.places.append(self.mapper.front_end.local_from_base)
                searching = not self.mapper.slam.is_localized
                self.maps_from_local.append(None if searching else self.mapper.back_end.map_from_local)
            elif isinstance(item.message, MapUpdate):
                self.grid.apply(item.message)

    def run_jobs(self) -> None:
        """Runs what was to be done beside the scans."""
        begun = process_time()
        while self._jobs:
            job = self._jobs.popleft()
            self.add(getattr(self.mapper, job.done)(job.function(*job.arguments)))
        self.job_seconds += process_time() - begun

    def finish(self) -> None:
        """Places the last scan, optimizes the graph and draws the map by it."""
        self.mapper.now += NS_PER_S
        self.add(self.mapper.release())
        self.add(self.mapper.slam.jobs.optimize())
        self.run_jobs()
        self.mapper.now += 3600 * NS_PER_S  # the map may be redrawn
        self.add(self.mapper.publish_map())
        self.run_jobs()
        self.add(self.mapper.publish_map())

    def saved(self) -> SavedMap:
        """What another run can go on with; that which was loaded, where it was not to change."""
        return self.mapper.slam.snapshot()

    @property
    def localized(self) -> bool:
        """Whether the robot was ever found on the map."""
        return any(correction is not None for correction in self.maps_from_local)

    def corrected_estimates(self) -> list[PoseEstimate]:
        """The estimates, by what is known at the end; or in a map that does not change, when the robot was found."""
        if self.mode == "localise":
            return self._localized_estimates()
        corrections = self.mapper.back_end.corrections()
        if not corrections:
            return self.estimates
        stamps = [keyframe.stamp for keyframe in self.mapper.back_end.keyframes[-len(corrections) :]]
        corrected = []
        for estimate, place in zip(self.estimates, self.places):
            k = min(max(bisect_right(stamps, estimate.stamp) - 1, 0), len(stamps) - 1)
            after = min(k + 1, len(stamps) - 1)
            share = (estimate.stamp - stamps[k]) / max(stamps[after] - stamps[k], 1)
            pose = interpolated(corrections[k] @ place, corrections[after] @ place, min(max(share, 0.0), 1.0))
            corrected.append(_with_pose(estimate, pose))
        return corrected

    def _localized_estimates(self) -> list[PoseEstimate]:
        corrected: list[PoseEstimate] = []
        correction: Pose2 | None = None  # the first one later on
        rows = zip(reversed(self.estimates), reversed(self.places), reversed(self.maps_from_local))
        for estimate, place, map_from_local in rows:
            correction = map_from_local or correction
            if correction is not None:
                corrected.append(_with_pose(estimate, correction @ place))
        return corrected[::-1]


def _with_pose(estimate: PoseEstimate, pose: Pose2) -> PoseEstimate:
    """The estimate, had it been this pose."""
    odom_from_base = estimate.map_from_odom.inverse() @ estimate.map_from_base
    return replace(estimate, map_from_base=pose, map_from_odom=pose @ odom_from_base.inverse())


def config_with_registrar(registrar: Registrar) -> MapperConfig:
    """The mapper's settings, all as they are but the registrar."""
    return MapperConfig(registration=RegistrationConfig(registrar=registrar))


def offline_slam(
    log: Path,
    out: Path,
    progress: Callable[[float], None] = lambda share: None,
    config: MapperConfig | None = None,
    mode: Mode = "map",
    saved_map: Path | None = None,
    choice: Choice = NOTHING,
) -> dict[str, Any]:
    """Runs the mapper over a log (convert/source.py) and writes map, trajectory and report into `out`.

    The files are the map's (see saved_map.py), trajectory.tum and report.json.
    progress: called with the share that is done, 0..1.   choice: topics and frames of a bag.
    saved_map: folder of the map on which the robot is localised, or which is continued.
    Returns the report. Raises UserError where the log cannot be read or holds no scan. Raises it too where the robot is
    not found on the saved map, or where `out` cannot be written.
    """
    config = config or MapperConfig()
    saved = _load_map(mode, saved_map, config)
    read, begun = read_log(log, choice), process_time()
    lag = clear_lag(read)
    read, lag_seconds = without_lag(read, lag) if lag else read, process_time() - begun
    scans = [record for record in read.records if isinstance(record, LoggedScan)]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write to {out}: {error.strerror}", "choose another folder for --out") from None
    run = OfflineRun(config, robot_of_log(scans), saved, mode)
    run.lag, run.lag_seconds = lag, lag_seconds
    first = min(record.stamp for record in read.records)
    times = _feed(run, read, first, progress)
    if not run.localized:
        raise UserError(
            f"{log}: the robot was not found on the map of {saved_map}",
            "is it of that building? A longer drive through what the map shows helps",
        )
    stamps, poses = corrected_trajectory(read, run.corrected_estimates(), first)
    report = _report(log, read, scans, run, poses, times)
    results = {
        "trajectory.tum": tum_text(stamps, poses).encode(),
        "report.json": (json.dumps(report, indent=2) + "\n").encode(),
    }
    replace_together(out, map_files(run.saved(), poses) | results)
    progress(1.0)
    return report


def _load_map(mode: Mode, folder: Path | None, config: MapperConfig) -> SavedMap | None:
    """The map that a mode begins with."""
    if (folder is None) != (mode == "map"):
        raise UserError(
            f"mode {mode} {'needs a map' if folder is None else 'takes no map'}", "--mode localise --map DIR"
        )
    if folder is None:
        return None
    saved = read_map(folder, config.occupancy.resolution)
    if not saved.keyframes:
        raise UserError(f"{folder}: the map holds no keyframes", "make one: zenav slam LOG --out DIR")
    if mode == "continue" and saved.tiles.resolution != config.occupancy.resolution:
        raise UserError(
            f"{folder}: the map has cells of {saved.tiles.resolution} m, the mapper of {config.occupancy.resolution} m",
            "set mapper.occupancy.resolution to the map's",
        )
    return saved


def _feed(run: OfflineRun, log: DriveLog, first: int, progress: Callable[[float], None]) -> list[float]:
    """The records as messages, in the log's order; CPU seconds of each scan."""
    times: list[float] = []
    laser = run.mapper.robot.laser
    for i, record in enumerate(log.records):
        stamp = mapper_time(first, record.stamp)
        end = record.end if isinstance(record, LoggedScan) else record.stamp
        run.mapper.now = max(run.mapper.now, mapper_time(first, end))
        v, w = (record.v, record.w) if isinstance(record, LoggedPose) else (0.0, 0.0)
        begun = process_time()
        if log.has_odometry:
            run.add(run.mapper.odometry(Odometry(stamp, record.odom_from_base, v, w, np.zeros(9))))
        if isinstance(record, LoggedScan):
            run.add(
                run.mapper.scan(
                    LaserScan(
                        stamp=stamp,
                        angle_min=record.angle_min,
                        angle_increment=record.angle_increment,
                        scan_time=record.scan_time,
                        range_min=laser.range_min,
                        range_max=laser.range_max,
                        ranges=record.ranges,
                    )
                )
            )
            times.append(process_time() - begun)
        elif times:
            times[-1] += process_time() - begun  # a sweep that takes time is placed when odometry reaches its end
        run.run_jobs()
        if isinstance(record, LoggedScan) and len(times) % MAP_EVERY == 0:
            run.add(run.mapper.publish_map())
        if i % 200 == 0:
            progress(i / len(log.records))
    run.finish()
    return times


def mapper_time(first: int, stamp: int) -> int:
    """A log's time as the mapper's: ns since a second before the first record."""
    return stamp - first + NS_PER_S


def corrected_trajectory(log: DriveLog, estimates: list[PoseEstimate], first: int) -> tuple[Float64s, Float64s]:
    """The base's pose at every record, in the order of their stamps: (n,) s on the log's clock, and (n, 3).

    At the end of scans it is the mapper's; between two of them odometry fills in, corrected by what it got wrong
    between them. Where the log has no odometry, which then stands still, the motion is even.
    """
    places = [estimate.stamp for estimate in estimates]
    rows, stamps = [], []
    for record in log.records:
        stamp = mapper_time(first, record.stamp)
        i = bisect_right(places, stamp) - 1
        if not log.has_odometry and len(estimates) > 1:
            i = min(max(i, 0), len(estimates) - 2)
        if i >= 0 and places[i] == stamp:
            pose = estimates[i].map_from_base
        elif i < 0 or i + 1 == len(places):
            pose = estimates[max(i, 0)].map_from_odom @ record.odom_from_base
        else:
            a, b = estimates[i], estimates[i + 1]
            share = min(max((stamp - a.stamp) / (b.stamp - a.stamp), -1.0), 2.0)
            early = a.map_from_odom @ record.odom_from_base
            late = b.map_from_odom @ record.odom_from_base
            pose = interpolated(early, late, share)
        stamps.append(record.stamp * 1e-9)
        rows.append((pose.x, pose.y, pose.yaw))
    order = np.argsort(stamps, kind="stable")  # a sweep is recorded after what was measured while it lasted
    return np.array(stamps)[order], np.array(rows)[order]


def tum_text(stamps: Float64s, poses: Float64s) -> str:
    """TUM format: `stamp x y z qx qy qz qw` a line."""
    return "".join(
        f"{t:.6f} {x:.6f} {y:.6f} 0 0 0 {sin(yaw / 2):.9f} {cos(yaw / 2):.9f}\n"
        for t, (x, y, yaw) in zip(stamps, poses)
    )


def _remaining_lag(run: OfflineRun, log: DriveLog, first: int) -> float | None:
    """s by which odometry is late against the matched scans."""
    turns = headings(log)
    turns[:, 0] += mapper_time(first, 0) / NS_PER_S
    return odometry_lag(turns, _placed(run))


def _placed(run: OfflineRun) -> Float64s:
    """(m, 2) s on the mapper's clock and rad, the scans' headings in the front end's frame, in time."""
    rows = {estimate.stamp * 1e-9: place.yaw for estimate, place in zip(run.estimates, run.places)}
    return np.array(sorted(rows.items())).reshape(-1, 2)


def _report(
    path: Path,
    log: DriveLog,
    scans: list[LoggedScan],
    run: OfflineRun,
    poses: Float64s,
    times: list[float],
) -> dict[str, Any]:
    remaining = _remaining_lag(run, log, min(record.stamp for record in log.records)) if log.has_odometry else None
    quality = np.array([estimate.quality for estimate in run.estimates] or [0.0])
    states = [str(estimate.state) for estimate in run.estimates]
    return {
        "log": path.name,
        "scans": len(scans),
        "scans_placed": len(run.estimates),
        "scans_dropped": dict(run.mapper.scan_queue.n_dropped),
        f"bad_{log.unit}": log.n_bad,
        "truncated": log.truncated,
        "notes": log.notes,
        "odometry_jumps": run.mapper.scan_queue.odometry.n_jumps,
        "odometry_lag_s": None if remaining is None else round(run.lag + remaining, 2),
        "odometry_lag_corrected_s": round(run.lag, 2),
        "seconds": round((scans[-1].stamp - scans[0].stamp) * 1e-9, 3),
        "length_m": round(float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()), 2),
        "cpu_s": round(sum(times) + run.job_seconds + run.lag_seconds, 3),
        "cpu_s_of_jobs": round(run.job_seconds, 3),
        "cpu_ms_per_scan": {
            "median": round(float(np.median(times)) * 1e3, 3),
            "p99": round(float(np.percentile(times, 99)) * 1e3, 3),
        },
        "quality": {
            "mean": round(float(quality.mean()), 4),
            "p01": round(float(np.percentile(quality, 1)), 4),
        },
        "mode": run.mode,
        "registrar": run.mapper.config.registration.registrar,
        "states": {state: states.count(state) for state in sorted(set(states))},
        "keyframes": len(run.mapper.back_end.keyframes),
        "loops": run.mapper.back_end.n_loops,
        "loops_refused": int((~run.mapper.back_end.graph.snapshot().on).sum()),
        "tiles": len(run.mapper.slam.grid.tile_index),
        "log_lines": run.logs[:20],
    }
