# SPDX-License-Identifier: Apache-2.0
"""`zenav bench odometry`: the wheels that the real X80SV recorded, against the odometry that its driver recorded."""

import csv
import gzip
import os
from collections.abc import Iterable
from itertools import pairwise
from math import degrees, hypot, pi
from pathlib import Path
from typing import Any

import numpy as np

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.odometry.dead_reckoning import INTEGRATIONS, DeadReckoningConfig
from services.odometry.service import OdometryService
from shared import topics
from shared.config import Robot, UserError, load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import BoardReport, WheelState
from shared.service import Out
from shared.topics import Publication
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table

MAX_DISTANCE, MAX_TURN = 1.5e-4, 0.01
"""m and degrees: by the driver's own integration, at most so far from what it recorded.

Its state was in 32-bit floats, which gives 0.096 mm and 0.0043 degrees. One encoder count that is lost (0.7 mm of a
wheel) exceeds both.
"""

MIN_ROWS = 2600  # of the recording: fewer are not that drive
SAME = "document"  # the integration of the robot's own driver
COUNTS, WRAP = 756, 32768  # encoder counts a turn; where they wrap
COLUMNS = "integration, from", "seconds", "driven, m", "off at most, mm", "at the end, mm", "turned off at most, deg"


def odometry(directory: Path | None, out: Path | None) -> int:
    """Shows the table, writes the JSON; 0 when the driver's own integration is within its limits."""
    check_writable(out)
    report = integration_errors(directory or default_folder())
    rows = [
        (
            name, f"{row['seconds']:.0f}", f"{row['driven_m']:.1f}", f"{row['distance_max_m'] * 1e3:.3f}",
            f"{row['distance_end_m'] * 1e3:.3f}", f"{row['turn_max_deg']:.4f}",
        )
        for name, row in report["rows"].items()
    ]  # fmt: skip
    show_table("against the odometry that the X80SV recorded", COLUMNS, rows)
    write_report(out, report)
    return 0 if report["summary"]["kept"] else 1


def default_folder() -> Path:
    """$ZENAV_DATA/x80sv. Raises UserError where that is not set."""
    data = os.environ.get("ZENAV_DATA")  # noqa: TID251  # only the environment has the folder of benchmark data
    if not data:
        raise UserError("there is no folder of the recorded drive", "give DIR with odom.csv.gz, or set ZENAV_DATA")
    return Path(data) / "x80sv"


def integration_errors(folder: Path) -> dict[str, Any]:
    """Each integration from the wheels' angles, and from encoder counts through the base driver. Raises UserError."""
    robot = load_robot("x80sv").robot
    wheels, recorded = table_numbers(folder / "wheel_positions.csv.gz"), table_numbers(folder / "odom.csv.gz")
    if min(len(wheels), len(recorded)) < MIN_ROWS:
        raise UserError(f"{folder} holds {len(wheels)} rows of wheels", f"the drive has more than {MIN_ROWS}")
    truth = [Pose2(*row[2:5]) for row in recorded]
    rows = {}
    for integration in INTEGRATIONS:
        rows[f"{integration}, wheel angles"] = pose_differences(by_angles(wheels, robot, integration), truth, wheels)
        rows[f"{integration}, encoder counts"] = pose_differences(by_counts(wheels, robot, integration), truth, wheels)
    same = [row for name, row in rows.items() if name.startswith(SAME)]
    worst = {key: max(row[key] for row in same) for key in ("distance_max_m", "turn_max_deg")}
    is_within = worst["distance_max_m"] < MAX_DISTANCE and worst["turn_max_deg"] < MAX_TURN
    return {"summary": {"integration": SAME, **worst, "kept": is_within}, "rows": rows}


def table_numbers(path: Path) -> list[list[float]]:
    """The numbers of a table of the recording, without its head. Raises UserError where there is none."""
    try:
        with gzip.open(path, "rt", encoding="utf-8") as file:
            return [[float(value) for value in row] for row in list(csv.reader(file))[1:]]
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {error}", "give the folder of the X80SV's recorded drive") from None


def by_angles(wheels: list[list[float]], robot: Robot, integration: str) -> list[Pose2]:
    """odom_from_base after each row of wheels: t s, left and right rad, of which the left counts down going forward."""
    service = OdometryService(DeadReckoningConfig.model_validate({"integration": integration}), robot)
    times, left, right = np.array(wheels).T
    rolled = zip(times, -unwrapped_angles(left), unwrapped_angles(right))
    states = [
        WheelState(stamp=round(t * 1e9), epoch=1, left=float(a), right=float(b), left_speed=0.0, right_speed=0.0)
        for t, a, b in rolled
    ]
    return [pose for state in states for pose in poses_in(service.wheels(state))]


def by_counts(wheels: list[list[float]], robot: Robot, integration: str) -> list[Pose2]:
    """As `by_angles`, from counts that wrap, as the board sends them, through the base driver."""
    driver = BaseDriverService(BaseDriverConfig(), robot)
    service = OdometryService(DeadReckoningConfig.model_validate({"integration": integration}), robot)
    nothing, currents = np.empty(0, np.float32), np.zeros(2, np.float32)
    poses: list[Pose2] = []
    for t, left, right in wheels:
        driver.now = service.now = round(t * 1e9)
        counts = [round(angle * COUNTS / (2 * pi)) % WRAP for angle in (left, right)]
        report = BoardReport(
            stamp=driver.now,
            left_counts=counts[0],
            right_counts=counts[1],
            left_speed=0.0,
            right_speed=0.0,
            ultrasonic=nothing,
            infrared=nothing,
            battery=7.2,
            currents=currents,
        )
        for publication in driver.board(report):
            if isinstance(publication, Publication) and isinstance(publication.message, WheelState):
                poses += poses_in(service.wheels(publication.message))
    return poses


def poses_in(out: Out) -> Iterable[Pose2]:
    """The poses among what the odometry says."""
    for output in out:
        if isinstance(output, Publication) and output.topic is topics.ODOM:
            yield output.message.odom_from_base  # type: ignore[attr-defined]  # the topic's type


def unwrapped_angles(angles: np.ndarray) -> np.ndarray:
    """(n,) rad: encoder angles that wrap at WRAP counts, made continuous."""
    wrap = WRAP * 2 * pi / COUNTS
    steps = np.diff(angles)
    return np.concatenate([[angles[0]], angles[0] + np.cumsum(steps - wrap * np.round(steps / wrap))])


def pose_differences(poses: list[Pose2], truth: list[Pose2], wheels: list[list[float]]) -> dict[str, float]:
    """How far poses are from the recorded ones, whose row 0 has no row of wheels: m, and degrees."""
    ours = [truth[1] @ pose for pose in poses]
    pairs = list(zip(truth[1:], ours))
    gaps = [hypot(a.x - b.x, a.y - b.y) for a, b in pairs]
    return {
        "poses": len(pairs),
        "seconds": round(wheels[len(pairs) - 1][0], 1),
        "driven_m": round(sum(a.distance(b) for (a, _), (b, _) in pairwise(pairs)), 2),
        "distance_max_m": max(gaps),
        "distance_end_m": gaps[-1],
        "turn_max_deg": max(degrees(abs(wrapped(a.yaw - b.yaw))) for a, b in pairs),
    }
