# SPDX-License-Identifier: Apache-2.0
"""What planners are asked: the Moving AI Lab's maps with scenarios, and real buildings in ROS's format."""

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.planner.costmap import CostConfig, GlobalCostmap
from shared.config import Robot, UserError
from shared.grid import OccupancyGrid, update_of_cells

Bools = NDArray[np.bool_]
Int8s = NDArray[np.int8]
Cell = tuple[int, int]  # row, column

RESOLUTION = 0.05  # m a cell, where a map does not say
SIZES = {256: 320, 512: 640, 1024: 1200, 4096: 5000}  # class: cells along the longer side, at most
ENLARGED, TIMES = "Milan_0_1024", 4  # what the class of 4096 is made of: none is published


@dataclass(frozen=True, slots=True)
class Scenario:
    """From a cell to a cell, (row, column); `optimum`: the published octile length, cells, `rounded` by as much."""

    start: Cell
    goal: Cell
    optimum: float
    rounded: float


@dataclass(frozen=True, slots=True, eq=False)
class Benchmark:
    """free: (h, w) bool, row 0 as in the file; times: how much larger than the published map."""

    name: str
    free: Bools
    scenarios: list[Scenario]
    times: int = 1

    @property
    def size(self) -> int:
        """Its class."""
        return next(size for size, most in SIZES.items() if max(self.free.shape) <= most)


def movingai(folder: Path, limit: int) -> list[Benchmark]:
    """The folder's maps, each with at most `limit` scenarios spread over the buckets, and one enlarged.

    Raises UserError where there is none, or one makes no sense.
    """
    names = sorted(path.name.removesuffix(".map.gz") for path in folder.glob("*.map.gz"))
    if not names:
        raise UserError(f"{folder} holds no NAME.map.gz", "give the folder with movingai/, or set ZENAV_DATA")
    found = [read_movingai(folder, name, limit) for name in names]
    return found + [enlarged(one, TIMES) for one in found if one.name == ENLARGED]


def read_movingai(folder: Path, name: str, limit: int) -> Benchmark:
    """A map and some of its scenarios. Raises UserError where a file cannot be read or makes no sense."""
    try:
        lines = gzip.decompress((folder / f"{name}.map.gz").read_bytes()).decode().splitlines()
        height, width = int(lines[1].split()[1]), int(lines[2].split()[1])
        free = np.array([[letter in ".GS" for letter in line[:width]] for line in lines[4 : 4 + height]])
        rows = gzip.decompress((folder / f"{name}.map.scen.gz").read_bytes()).decode().splitlines()[1:]
        all_ = [_scenario(row) for row in rows if row.strip()]
        if free.shape != (height, width) or not all(free[s.start] and free[s.goal] for s in all_):
            raise ValueError("the rows do not fit the map")
    except (OSError, EOFError, ValueError, IndexError) as error:
        raise UserError(f"{folder / name}: {error}", "fetch the map and its .scen again from movingai.com") from None
    return Benchmark(name, free, all_[:: max(-(-len(all_) // limit), 1)])


def _scenario(row: str) -> Scenario:
    """Columns: bucket, map, width, height, start x, start y, goal x, goal y, optimum; x is the column."""
    fields = row.split()
    x0, y0, x1, y1 = map(int, fields[4:8])
    digits = len(fields[8].partition(".")[2])
    return Scenario((y0, x0), (y1, x1), float(fields[8]), 0.5 * 10.0**-digits)


def enlarged(benchmark: Benchmark, times: int) -> Benchmark:
    """Each cell as a square of cells; from and to the middle of what was a cell."""
    half = times // 2
    scenarios = [
        Scenario(
            (s.start[0] * times + half, s.start[1] * times + half),
            (s.goal[0] * times + half, s.goal[1] * times + half),
            s.optimum * times,
            s.rounded * times,
        )
        for s in benchmark.scenarios
    ]
    free = np.kron(benchmark.free, np.ones((times, times), bool))
    return Benchmark(f"{benchmark.name} x {times}", free, scenarios, times)


def cell_sized(robot: Robot) -> Robot:
    """The robot with a body no larger than a cell: games' maps have gaps of one."""
    half = 0.4 * RESOLUTION
    return robot.model_copy(update={"footprint": ((half, -half), (half, half), (-half, half), (-half, -half))})


def terrain_of(cells: Int8s, resolution: float, config: CostConfig, robot: Robot) -> GlobalCostmap:
    """What the planner makes of cells in percent, row 0 lowest; cells[0, 0] lies at (pad, pad) of its costs."""
    grid = OccupancyGrid(resolution)
    grid.apply(update_of_cells(cells, resolution, 0.0, 0.0))
    terrain = GlobalCostmap(config, robot, resolution)
    terrain.update(grid, None)
    return terrain


FREE = CostConfig(margin=0, min_margin=0, inflation_radius=RESOLUTION, clearance_weight=0, unknown="forbidden")
"""Cells are free or blocked, and nothing else."""

INFLATED = CostConfig(margin=0, min_margin=0, unknown="forbidden")
"""The planner's own costs around obstacles."""
