# SPDX-License-Identifier: Apache-2.0
"""How much faster than real time the simulator runs on one core: its handlers, called as a runner calls them."""

import tempfile
import time
from math import pi
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.sim.config import SimConfig
from services.sim.service import SimService
from shared.config import Drive, Laser, Robot, load_robot
from shared.messages import MotorCommand
from shared.ros_map import write_ros_map
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table

TICK_NS = 20_000_000
N_CELLS = 1000
CELL = 0.05  # m


def measure_speed(seconds: float = 10.0, repeats: int = 5) -> dict[str, Any]:
    """Medians of `repeats` runs of `seconds` simulated seconds: simulated seconds a CPU second, by world and laser.

    `summary.ratio` is the figure that the project promises: 720 beams, 40 Hz, a map of 1000 x 1000 cells.
    """
    robot = load_robot("x80sv")
    laser_720 = Laser(
        angle_min=-0.75 * pi,
        angle_increment=1.5 * pi / 719,
        n_beams=720,
        scan_time=0.025,
        rate=40,
        range_min=0.1,
        range_max=30.0,
    )
    fast = robot.robot.model_copy(update={"laser": laser_720})
    config = robot.section("sim", SimConfig)
    with tempfile.TemporaryDirectory() as folder:
        cells = np.where(grid_building(N_CELLS), 100, 0).astype(np.int8)
        grid = str(write_ros_map(Path(folder), cells, CELL, 0.0, 0.0, "building"))
        rows = {
            "map of 1000 x 1000 cells, 720 beams at 40 Hz": _ratio(config, fast, grid, seconds, repeats),
            "office, 720 beams at 40 Hz": _ratio(config, fast, "office", seconds, repeats),
            "office, the robot's own laser": _ratio(config, robot.robot, "office", seconds, repeats),
        }
    ratio = rows["map of 1000 x 1000 cells, 720 beams at 40 Hz"]["ratio"]
    return {"rows": rows, "summary": {"ratio": ratio, "seconds": seconds, "repeats": repeats}}


def grid_building(n: int) -> NDArray[np.bool_]:
    """(n, n) bool, solid cells: rooms of 5 to 8 m along corridors, with doors and furniture, the same every time."""
    rng = np.random.default_rng(0)
    solid = np.zeros((n, n), bool)
    lines = np.arange(0, n, n // 8)
    solid[lines], solid[:, lines], solid[-1], solid[:, -1] = True, True, True, True
    for line in lines[1:]:
        for begin in lines:
            place = begin + rng.integers(20, n // 8 - 40, size=2)
            solid[line, place[0] : place[0] + 20] = False
            solid[place[1] : place[1] + 20, line] = False
    for row, column in rng.integers(10, n - 30, size=(200, 2)):
        h, w = rng.integers(4, 24, size=2)
        solid[row : row + h, column : column + w] = True
    solid[n // 2 + 8 : n // 2 + 108, n // 2 + 8 : n // 2 + 108] = False
    return solid


def _ratio(config: SimConfig, robot: Robot, world: str, seconds: float, repeats: int) -> dict[str, float]:
    costs = []
    for seed in range(repeats):
        service = SimService(config.model_copy(update={"world": world, "seed": seed}), robot)
        service.warm_up()
        begin = time.process_time()
        n_scans = drive_circles(service, robot.drive, seconds)
        costs.append(time.process_time() - begin)
    cost = median(costs)
    return {"ratio": seconds / cost, "cpu_ms_a_second": 1000 * cost / seconds, "scans_a_second": n_scans / seconds}


def drive_circles(service: SimService, drive: Drive, seconds: float) -> int:
    """Drives circles for some simulated seconds, commanded before each tick as by a base driver; counts scans."""
    per_second = drive.counts_per_turn / (2 * pi * drive.wheel_radius)  # counts/s of a wheel at 1 m/s
    n_scans = 0
    for _ in range(round(seconds * 1e9 / TICK_NS)):
        service.now += TICK_NS
        list(service.motors(MotorCommand(service.now, -0.35 * per_second, 0.45 * per_second)))
        n_scans += sum(p.topic.key == "scan" for p in service.tick())  # type: ignore[union-attr]  # only publications
    return n_scans


MIN_SPEED_RATIO = 50.0  # times real time: the simulator with 720 beams at 40 Hz in 1000 x 1000 cells


def sim(out: Path | None) -> int:
    """`zenav bench sim`; 0 when the simulator is as fast as promised."""

    check_writable(out)
    report = measure_speed()
    rows = [
        (name, f"{row['ratio']:.0f}", f"{row['cpu_ms_a_second']:.2f}", f"{row['scans_a_second']:.0f}")
        for name, row in report["rows"].items()
    ]
    show_table("the simulator on one core", ("world", "times real time", "CPU, ms a second", "scans a second"), rows)
    write_report(out, report)
    return 0 if report["summary"]["ratio"] >= MIN_SPEED_RATIO else 1
