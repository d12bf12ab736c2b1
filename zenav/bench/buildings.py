# SPDX-License-Identifier: Apache-2.0
"""`zenav bench buildings`: made-up buildings, each toured once; pose and map against the truth."""

import statistics
import sys
from functools import partial
from math import hypot
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from shared.config import UserError
from shared.geometry import Pose2
from shared.types import Float64s
from zenav.bench.process_pool import pool_results
from zenav.bench.seeds import seeds_from
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.table import show_table

if TYPE_CHECKING:
    from zenav.bench.sim_slam_harness import SimSlamHarness

POSE_M, WITHIN = 0.03, 0.97
"""What each building must keep: mean pose error, m; share of the map's occupied cells within 5 cm of a true surface.

Also every goal of its tour is reached, and the robot touches nothing: a tour that is shorter measures less.
"""

AGAIN = 0.35  # of the rooms are visited a second time, in another order
COLUMNS = (
    "building", "size, m", "rooms", "not reached", "contacts", "pose, cm", "p99", "max", "deg", "keyframes, cm", "max",
    "map in 5 cm, %", "aligned, %", "complete, %", "map, cm", "driven, m", "time, s", "loops", "CPU, s", "",
)  # fmt: skip


def buildings(robot: str, numbers: str, jobs: int, out: Path | None, settings: list[str]) -> int:
    """Tours every building, shows the table, writes the JSON; 0 when every building kept every promise."""
    chosen = seeds_from(numbers)
    check_writable(out)
    folder = new_run_folder("bench-buildings")
    runs: list[dict[str, Any]] = []
    for run in pool_results(partial(tour_building, robot, folder, settings), chosen, jobs):
        runs.append(run)
        sys.stderr.write(f"building {run['building']}: {_ended(run)}\n")
    runs.sort(key=lambda run: int(run["building"]))
    show_table(f"buildings, pictures and maps in {folder}", COLUMNS, [_row(run) for run in runs])
    write_report(out, {"summary": summary(runs), "runs": runs})
    return 0 if all(reaches_targets(run) for run in runs) else 1


def reaches_targets(run: dict[str, Any]) -> bool:
    """Whether a building kept every promise."""
    complete = not run["trouble"] and not run["not_reached"] and not run["collisions"]
    return bool(complete and run["pose_error_mean_m"] < POSE_M and run["map_within_5_cm"] > WITHIN)


def _ended(run: dict[str, Any]) -> str:
    """What ended otherwise than it should, in words."""
    if run["trouble"]:
        return str(run["trouble"])
    contacts = [f"{run['collisions']} contacts"] if run["collisions"] else []
    return ", ".join((*run["not_reached"], *contacts)) or "done"


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures over all buildings: mean, median and worst."""
    rows = [run for run in runs if not run["trouble"]]
    figures: dict[str, Any] = {
        "buildings": len(runs),
        "kept": sum(reaches_targets(run) for run in runs),
        "not_reached": sum(len(row["not_reached"]) for row in rows),
        "collisions": sum(row["collisions"] for row in rows),
    }
    worst = {
        "pose_error_mean_m": max,
        "pose_error_max_m": max,
        "keyframe_error_mean_m": max,
        "map_within_5_cm": min,
        "aligned_within_5_cm": min,
        "map_completeness": min,
    }
    for key in (*worst, "cpu_s", "distance_m", "seconds"):
        values = [row[key] for row in rows if row[key] is not None]
        if values:
            figures[key] = {"mean": round(statistics.fmean(values), 4), "median": round(statistics.median(values), 4)}
            if key in worst:
                figures[key]["worst"] = worst[key](values)
    return figures


def _row(run: dict[str, Any]) -> tuple[str, ...]:
    if run["trouble"]:
        return (str(run["building"]), *[""] * (len(COLUMNS) - 2), run["trouble"])

    def number(key: str, scale: float, digits: int) -> str:
        return "-" if run[key] is None else f"{run[key] * scale:.{digits}f}"

    return (
        str(run["building"]), run["size"], str(run["rooms"]), str(len(run["not_reached"])), str(run["collisions"]),
        number("pose_error_mean_m", 100, 2), number("pose_error_p99_m", 100, 1), number("pose_error_max_m", 100, 1),
        number("pose_error_mean_deg", 1, 2), number("keyframe_error_mean_m", 100, 2),
        number("keyframe_error_max_m", 100, 1), number("map_within_5_cm", 100, 1),
        number("aligned_within_5_cm", 100, 1), number("map_completeness", 100, 1), number("map_error_mean_m", 100, 2),
        number("distance_m", 1, 0), number("seconds", 1, 0), str(run["loops"]), number("cpu_s", 1, 1),
        "kept" if reaches_targets(run) else "not kept",
    )  # fmt: skip


def tour_building(robot: str, folder: Path, settings: list[str], number: int) -> dict[str, Any]:
    """The figures of one building; only `trouble` where it is wrong."""
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from zenav.bench.sim_slam_harness import SimSlamHarness, harness_robot_file
    from zenav.maps.saved_map import write_saved_map
    from zenav.render.floor_plan import floor_plan

    begun = process_time()
    try:
        harness = SimSlamHarness(harness_robot_file(robot, f"building:{number}", number, None, settings))
    except UserError as error:
        return {"building": number, "trouble": error.what}
    not_reached = drive_tour(harness, np.random.default_rng(number))
    cpu = process_time() - begun - harness.warming
    place = folder / f"building-{number}"
    if harness.mapper.back_end.keyframes:
        write_saved_map(place, harness.mapper.slam.snapshot())
    place.mkdir(exist_ok=True)
    (place / "picture.png").write_bytes(floor_plan(harness.track, harness.world, []))
    return {
        "building": number,
        "trouble": "",
        "not_reached": not_reached,
        **building_figures(harness),
        "cpu_s": round(cpu, 1),
    }


def drive_tour(harness: "SimSlamHarness", rng: np.random.Generator) -> list[str]:
    """Drives through all rooms, the nearest first, then through some again in any order, and back to the start.

    Where a person bars the way to a goal, the robot goes back to make room for that person, and tries once more.
    Returns a line for each goal that was not reached then either: its name and how the second drive ended.
    """
    from zenav.bench.sim_slam_harness import DriveResult

    left, here = dict(harness.world.goals), harness.world.start
    order: list[tuple[str, Pose2]] = []
    while left:
        name = min(left, key=lambda name: _length(harness.paths.path(here, left[name])))
        here = left.pop(name)
        order.append((name, here))
    again = rng.permutation(len(order))[: round(AGAIN * len(order))].tolist()
    not_reached, last_goal = [], harness.world.start
    for name, goal in (*order, *(order[i] for i in again), ("start", harness.world.start)):
        if (result := harness.drive(goal)) is DriveResult.GAVE_UP:
            harness.drive(last_goal)
            result = harness.drive(goal)
        if result is DriveResult.REACHED:
            last_goal = goal
        else:
            not_reached.append(f"{name}: {result.value}")
    harness.stand(4.0)
    return not_reached


def _length(path: Float64s) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) else float("inf")


def building_figures(harness: "SimSlamHarness") -> dict[str, Any]:
    """What is known of a run in a building."""
    from zenav.metrics.evaluation import MAX_WALL_ERROR_M, aligned_map_errors, evaluation_summary, pose_errors

    track, world = harness.track, harness.world
    metres, _ = pose_errors(track)
    keyframes = keyframe_errors(harness)
    aligned, shift = aligned_map_errors(track.grid, world, track.world_from_map)
    low_x, low_y, high_x, high_y = world.bounds
    robot = harness.paths.robot
    figures = evaluation_summary(track, world, robot.circumscribed_radius, robot.laser.range_max)
    return figures | {
        "size": f"{high_x - low_x:.0f} x {high_y - low_y:.0f}",
        "rooms": len(world.goals),
        "pose_error_p99_m": round(float(np.percentile(metres, 99)), 4) if len(metres) else None,
        "keyframe_error_mean_m": round(float(keyframes.mean()), 4) if len(keyframes) else None,
        "keyframe_error_max_m": round(float(keyframes.max()), 4) if len(keyframes) else None,
        "aligned_within_5_cm": round(float((aligned <= MAX_WALL_ERROR_M).mean()), 4) if len(aligned) else None,
        "frame_off": [round(shift.x, 4), round(shift.y, 4), round(shift.yaw, 5)],
        "loops": harness.mapper.back_end.n_loops,
    }


def keyframe_errors(harness: "SimSlamHarness") -> Float64s:
    """(n,) m: the keyframes of the pose graph, as it is at the end, against the truth of their time."""
    back_end, track = harness.mapper.back_end, harness.track
    if not back_end.keyframes:
        return np.zeros(0)
    truths = np.array(track.truths)
    stamps = np.array([keyframe.stamp for keyframe in back_end.keyframes], float)
    x, y = (np.interp(stamps, truths[:, 0].astype(float), truths[:, column]) for column in (1, 2))
    poses = [track.world_from_map @ Pose2(*row) for row in back_end.graph.poses.tolist()]
    return np.array([hypot(pose.x - a, pose.y - b) for pose, a, b in zip(poses, x, y)])
