# SPDX-License-Identifier: Apache-2.0
"""What planners are asked: the Moving AI Lab's maps with scenarios, and real buildings in ROS's format."""

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from shared.config import Robot, UserError
from shared.grid import OccupancyGrid, update_of_cells
from shared.types import Bools, Int8s

Cell = tuple[int, int]  # row, column

RESOLUTION = 0.05  # m a cell, where a map does not say
SIZES = {256: 320, 512: 640, 1024: 1200, 4096: 5000}  # class: cells along the longer side, at most
ENLARGED, TIMES = "Milan_0_1024", 4  # what the class of 4096 is made of: none is published


@dataclass(frozen=True, slots=True)
class PlanQuery:
    """From a cell to a cell, (row, column).

    optimum: the published octile length, cells.   rounded: its largest error, cells.
    """

    start: Cell
    goal: Cell
    optimum: float
    rounded: float


@dataclass(frozen=True, slots=True, eq=False)
class BenchmarkMap:
    """A map and its scenarios.

    free: (h, w) bool, row 0 as in the file.   times: how much larger than the published map.
    notes: one line for each thing that is left out.
    """

    name: str
    free: Bools
    scenarios: list[PlanQuery]
    times: int = 1
    notes: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Its class: a key of SIZES."""
        return next(size for size, max_cells in SIZES.items() if max(self.free.shape) <= max_cells)


def read_movingai_maps(folder: Path, limit: int) -> tuple[list[BenchmarkMap], list[str]]:
    """The folder's maps, each with at most `limit` scenarios spread over the buckets, and one enlarged map.

    The second value has a line for each map that is left out because it cannot be read.
    Raises UserError if no map remains.
    """
    names = sorted(path.name.removesuffix(".map.gz") for path in folder.glob("*.map.gz"))
    if not names:
        raise UserError(f"{folder} holds no NAME.map.gz", "give the folder with movingai/, or set ZENAV_DATA")
    benchmarks, left_out, first_error = [], [], None
    for name in names:
        try:
            benchmarks.append(read_movingai_map(folder, name, limit))
        except UserError as error:
            first_error = first_error or error
            left_out.append(f"{name}: left out, {error.what}")
    if first_error is not None and not benchmarks:
        raise first_error
    return benchmarks + [
        enlarged_map(benchmark, TIMES) for benchmark in benchmarks if benchmark.name == ENLARGED
    ], left_out


def read_movingai_map(folder: Path, name: str, limit: int) -> BenchmarkMap:
    """A map and at most `limit` of its scenarios; those that begin or end in water are left out, with a note.

    Land is `.`, `G` and `S`. Water `W` is passable among itself, but not from land, so it is blocked here.
    Raises UserError if a file cannot be read, does not fit, is larger than any class or has no scenario on land.
    """
    try:
        lines = gzip.decompress((folder / f"{name}.map.gz").read_bytes()).decode().splitlines()
        height, width = int(lines[1].split()[1]), int(lines[2].split()[1])
        letters = np.array([list(line[:width]) for line in lines[4 : 4 + height]])
        if letters.shape != (height, width):
            raise ValueError("the rows do not fit the map")
        free, water = np.isin(letters, list(".GS")), letters == "W"
        rows = gzip.decompress((folder / f"{name}.map.scen.gz").read_bytes()).decode().splitlines()[1:]
        scenarios = [_query(row) for row in rows if row.strip()]
        on_land = [s for s in scenarios if not (water[s.start] or water[s.goal])]
        if not all(free[s.start] and free[s.goal] for s in on_land):
            raise ValueError("a scenario begins or ends in a blocked cell")
    except (OSError, EOFError, ValueError, IndexError) as error:
        raise UserError(f"{folder / name}: {error}", "fetch the map and its .scen again from movingai.com") from None
    if max(free.shape) > max(SIZES.values()):
        raise UserError(f"{folder / name}: {height} x {width} cells", f"at most {max(SIZES.values())} along a side")
    if not on_land:
        raise UserError(f"{folder / name}: no scenario on land", "take a map with land `.`, `G` or `S`")
    n_water = len(scenarios) - len(on_land)
    notes = (f"{name}: {n_water} of {len(scenarios)} scenarios begin or end in water (W), left out",) if n_water else ()
    return BenchmarkMap(name, free, on_land[:: max(-(-len(on_land) // limit), 1)], notes=notes)


def _query(row: str) -> PlanQuery:
    """Columns: bucket, map, width, height, start x, start y, goal x, goal y, optimum; x is the column."""
    fields = row.split()
    x0, y0, x1, y1 = map(int, fields[4:8])
    digits = len(fields[8].partition(".")[2])
    return PlanQuery((y0, x0), (y1, x1), float(fields[8]), 0.5 * 10.0**-digits)


def enlarged_map(benchmark: BenchmarkMap, times: int) -> BenchmarkMap:
    """Each cell as a square of cells; from and to the middle of what was a cell."""
    half = times // 2
    scenarios = [
        PlanQuery(
            (s.start[0] * times + half, s.start[1] * times + half),
            (s.goal[0] * times + half, s.goal[1] * times + half),
            s.optimum * times,
            s.rounded * times,
        )
        for s in benchmark.scenarios
    ]
    free = np.kron(benchmark.free, np.ones((times, times), bool))
    return BenchmarkMap(f"{benchmark.name} x {times}", free, scenarios, times)


def cell_sized_robot(robot: Robot) -> Robot:
    """The robot with a body no larger than a cell: games' maps have gaps of one."""
    half = 0.4 * RESOLUTION
    return robot.model_copy(update={"footprint": ((half, -half), (half, half), (-half, half), (-half, -half))})


def costmap_of(cells: Int8s, resolution: float, config: CostConfig, robot: Robot) -> GlobalCostmap:
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
