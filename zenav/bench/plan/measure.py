# SPDX-License-Identifier: Apache-2.0
"""One map's queries: the raw problem, the planner's own way, and what others make of the same."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from time import process_time
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from services.planner.costmap import GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.planning import PlanningConfig, plan_path
from services.planner.ray_cost import path_cost
from services.planner.search import GridSearch
from services.planner.smoothing import resampled_path
from shared.config import Robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS, MapUpdate
from shared.types import Float64s, UInt16s
from zenav.bench.plan.maps import (
    FREE,
    INFLATED,
    RESOLUTION,
    BenchmarkMap,
    Cell,
    PlanQuery,
    cell_sized_robot,
    costmap_of,
)
from zenav.bench.plan.navfn import NavFn
from zenav.bench.plan.shortest import corners_of, shortest_length

T = TypeVar("T")

CLEARANCE_STEP = 0.1  # cells between the places at which a path's clearance is looked up
MAX_LENGTH_ERROR = 1e-3  # cells by which a raw length may differ from the published one
N_TILES = 40  # tile updates that are timed
N_QUERIES_SLOW = {256: 20, 512: 10, 1024: 4, 4096: 1}  # queries a map that slow peers get
N_QUERIES = {256: 60, 512: 40, 1024: 30, 4096: 12}  # queries a map that the others get


@dataclass(slots=True)
class PlannerRow:
    """What one planner did: CPU ms, whether it was solved, and where it was: length, and others' figures by name."""

    ms: list[float] = field(default_factory=list)
    n: int = 0
    solved: int = 0
    touched: int = 0  # paths over a blocked cell
    figures: dict[str, list[float]] = field(default_factory=dict)

    def note(self, name: str, value: float) -> None:
        """Keeps one more figure."""
        self.figures.setdefault(name, []).append(value)

    def add(self, other: "PlannerRow") -> None:
        """Takes another map's row in."""
        self.ms += other.ms
        self.n, self.solved, self.touched = self.n + other.n, self.solved + other.solved, self.touched + other.touched
        for name, values in other.figures.items():
            self.figures.setdefault(name, []).extend(values)

    def summary(self) -> dict[str, Any]:
        """Median and p99 of the time, shares, means."""
        summary: dict[str, Any] = {
            "n": self.n,
            "solved": round(self.solved / max(self.n, 1), 4),
            "touched": self.touched,
        }
        if self.ms:
            summary |= {
                "ms_median": round(float(np.median(self.ms)), 3),
                "ms_p99": round(float(np.percentile(self.ms, 99)), 3),
            }
        for name, values in self.figures.items():
            summary[name] = round(float(np.mean(values)), 4)
            summary[f"{name}_max"] = round(float(np.max(values)), 4)
        return summary


def timed_call(work: Callable[..., T], *arguments: Any) -> tuple[T, float]:
    """What it gives, and its CPU time, ms."""
    begun = process_time()
    result = work(*arguments)
    return result, (process_time() - begun) * 1e3


def grid_search_row(benchmark: BenchmarkMap) -> PlannerRow:
    """The exact search, no costs; the figure `wrong` is 1 where the length is not the published one."""
    costs = np.pad(benchmark.free, 1).astype(np.uint16)
    search, row = GridSearch(), PlannerRow()
    for warm in (True, False):
        for scenario in benchmark.scenarios[:3] if warm else benchmark.scenarios:
            ends = _shifted(scenario.start, 1), _shifted(scenario.goal, 1)
            path, ms = timed_call(search.cheapest_path, costs, *ends, 1, 1)
            if not warm:
                steps = np.abs(np.diff(path, axis=0)).sum(axis=1)
                octile = np.count_nonzero(steps == 1) + np.count_nonzero(steps == 2) * np.sqrt(2)
                row.n, row.solved = row.n + 1, row.solved + (len(path) > 0)
                row.ms.append(ms)
                row.note("wrong", float(not abs(octile - scenario.optimum) <= MAX_LENGTH_ERROR + scenario.rounded))
    return row


def planner_row(terrain: GlobalCostmap, scenarios: list[PlanQuery]) -> tuple[PlannerRow, list[Float64s]]:
    """`plan_path`, as the planner calls it, from pose to path; the paths, (x, y) in cells of the costs."""
    outline, config, row = HierarchicalSearch(), PlanningConfig(spacing=terrain.resolution), PlannerRow()
    paths = []
    for warm in (True, False):
        for scenario in scenarios[:3] if warm else scenarios:
            start, goal = (
                Pose2(*terrain.centre(*_shifted(cell, terrain.pad))) for cell in (scenario.start, scenario.goal)
            )
            plan, ms = timed_call(plan_path, terrain, outline, start, goal, 0.0, config)
            if warm:
                continue
            path = (plan.points - terrain.origin) / terrain.resolution
            paths.append(path)
            row.ms.append(ms)
            _add_path(row, terrain, path)
            if len(path) > 1:
                row.note("turn_deg", float(np.degrees(np.abs(np.diff(np.unwrap(plan.yaws[:-1]))).max(initial=0.0))))
    return row, paths


def _add_path(row: PlannerRow, terrain: GlobalCostmap, path: Float64s) -> None:
    row.n += 1
    if not len(path):
        return
    row.solved += 1
    row.touched += path_cost(terrain.costs, path) < 0
    away = path_clearance(terrain, path)
    row.note("path_m", path_length(path) * terrain.resolution)
    row.note("clearance_least_m", float(away.min()))
    row.note("clearance_mean_m", float(away.mean()))


def path_clearance(terrain: GlobalCostmap, path: Float64s) -> Float64s:
    """(n,) m from the path's cells to the nearest obstacle, at most the inflation radius."""
    path = resampled_path(path, CLEARANCE_STEP)
    cells = np.clip(path.astype(np.int64) - terrain.pad, 0, np.array(terrain.distance.shape[::-1]) - 1)
    return np.asarray(terrain.distance[cells[:, 1], cells[:, 0]] * terrain.resolution, np.float64)


def path_length(path: Float64s) -> float:
    """Cells."""
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def movingai_rows(benchmark: BenchmarkMap, robot: Robot) -> tuple[dict[str, PlannerRow], list[str]]:
    """All rows of one of the Moving AI maps, by name; and a line for each figure that is left out."""
    small = cell_sized_robot(robot)
    cells = np.where(benchmark.free, 0, 100).astype(np.int8)
    rows = {} if benchmark.times > 1 else {"raw, exact 8-connected": grid_search_row(benchmark)}
    terrain = costmap_of(cells, RESOLUTION, FREE, small)
    some = evenly_spread(benchmark.scenarios, N_QUERIES[benchmark.size])
    rows["ours, free and blocked"], paths = planner_row(terrain, benchmark.scenarios)
    optima, left_out = any_angle_lengths(benchmark, some, paths), []
    if optima is None:
        optima = {}
        left_out.append(f"{benchmark.name}: too many corners for the shortest length of all, no `of the shortest`")
    path_of = dict(zip(map(id, benchmark.scenarios), paths))
    for scenario in some:
        path, best = path_of[id(scenario)], optima.get(id(scenario), 0.0)
        if best > 0 and len(path):
            rows["ours, free and blocked"].note("length", path_length(path) / best)
    rows |= peer_rows(terrain.costs, terrain, some, optima, N_QUERIES_SLOW[benchmark.size])
    del terrain
    terrain = costmap_of(cells, RESOLUTION, INFLATED, small)
    rows["ours, with costs"], _ = planner_row(terrain, benchmark.scenarios)
    rows |= {f"{name}, with costs": row for name, row in navfn_rows(terrain.costs, terrain, some, {}).items()}
    if benchmark.size == 4096:
        rows["a tile's update"] = tile_updates(terrain, cells)
    sys.stderr.write(f"{benchmark.name}: {len(benchmark.scenarios)} scenarios\n")
    return rows, left_out


def any_angle_lengths(benchmark: BenchmarkMap, some: list[PlanQuery], paths: list[Float64s]) -> dict[int, float] | None:
    """The shortest length of all for some scenarios, cells, by the scenario's id; None if one search is too large.

    some: a part of the benchmark's scenarios.   paths: of all its scenarios, (n, 2) float64, cells.
    An enlarged map is searched by the published map's corners: the obstacles are the same, and the corners few.
    A column without its longest paths would be biased, so a map counts whole or not at all.
    """
    times = benchmark.times
    free = benchmark.free[::times, ::times]
    corners, ids = corners_of(free), set(map(id, some))
    solved = [(path_length(path), s) for s, path in zip(benchmark.scenarios, paths) if id(s) in ids and len(path)]
    optima = {}
    for upper_bound, scenario in sorted(solved, key=lambda pair: -pair[0]):  # the longest first: it fails early
        ends = np.array([scenario.start[::-1], scenario.goal[::-1]], float) + 0.5
        best = shortest_length(free, corners, ends / times, upper_bound / times)
        if best is None:
            return None
        optima[id(scenario)] = times * best
    return optima


def peer_rows(
    costs: UInt16s, terrain: GlobalCostmap, some: list[PlanQuery], optima: dict[int, float], n_slow: int
) -> dict[str, PlannerRow]:
    """NavFn, and what Python users choose where that is installed, on the same costs."""
    rows = navfn_rows(costs, terrain, some, optima)
    weights = np.where(costs > 0, 1.0, np.inf).astype(np.float32)
    for name, peer in installed_peers().items():
        if peer is None:
            sys.stderr.write(f"{name}: not installed, no row\n")
            continue
        rows[name] = _peer_row(terrain, evenly_spread(some, n_slow), optima, partial(peer, weights))
    return rows


def navfn_rows(
    costs: UInt16s, terrain: GlobalCostmap, some: list[PlanQuery], optima: dict[int, float]
) -> dict[str, PlannerRow]:
    """NavFn's two searches."""
    navfn = NavFn(costs)
    return {
        name: _peer_row(terrain, some, optima, partial(navfn.path, astar=astar))
        for name, astar in (("NavFn A*", True), ("NavFn Dijkstra", False))
    }


def _peer_row(
    terrain: GlobalCostmap, some: list[PlanQuery], optima: dict[int, float], plan: Callable[[Cell, Cell], Float64s]
) -> PlannerRow:
    row = PlannerRow()
    for warm in (True, False):
        for scenario in some[:1] if warm else some:
            ends = _shifted(scenario.start, terrain.pad), _shifted(scenario.goal, terrain.pad)
            path, ms = timed_call(plan, *ends)
            if warm:
                continue
            row.ms.append(ms)
            _add_path(row, terrain, path)
            if len(path) and optima.get(id(scenario), 0) > 0:
                row.note("length", path_length(path) / optima[id(scenario)])
    return row


def installed_peers() -> dict[str, Callable[[Any, Cell, Cell], Float64s] | None]:
    """The planners of other packages, by name; None where a package is not installed."""
    planners: dict[str, Callable[[Any, Cell, Cell], Float64s] | None] = {"pyastar2d": None, "scikit-image MCP": None}
    try:
        import pyastar2d

        def astar(weights: Any, start: Cell, goal: Cell) -> Float64s:
            path = pyastar2d.astar_path(weights, start, goal, allow_diagonal=True)
            return np.empty((0, 2)) if path is None else path[:, ::-1] + 0.5

        planners["pyastar2d"] = astar
    except ImportError:
        pass
    try:
        from skimage.graph import MCP_Geometric

        def mcp(weights: Any, start: Cell, goal: Cell) -> Float64s:
            search = MCP_Geometric(weights)
            search.find_costs([start], [goal])
            return np.array(search.traceback(goal), float)[:, ::-1] + 0.5

        planners["scikit-image MCP"] = mcp
    except ImportError:
        pass
    return planners


def tile_updates(terrain: GlobalCostmap, cells: NDArray[np.int8]) -> PlannerRow:
    """What a changed tile costs the planner: distances, costs, blocks and regions; also `grid_ms`, the map's own."""
    grid = OccupancyGrid(terrain.resolution)
    grid.cells = terrain.cells.copy()
    rng, row = np.random.default_rng(1), PlannerRow()
    tiles = np.array(cells.shape) // TILE_CELLS
    for version in range(N_TILES + 3):
        r, c = (int(rng.integers(n)) for n in tiles)
        tile = grid.cells[r * TILE_CELLS : (r + 1) * TILE_CELLS, c * TILE_CELLS : (c + 1) * TILE_CELLS].copy()
        flipped = rng.random(tile.shape) < 0.02
        tile[flipped] = np.where(tile[flipped] == 100, 0, 100)
        update = MapUpdate(
            stamp=0,
            map_id=0,
            version=version + 1,
            resolution=terrain.resolution,
            rows=np.array([r], np.int32),
            columns=np.array([c], np.int32),
            cells=tile.reshape(1, -1),
        )
        changed, grid_ms = timed_call(grid.apply, update)
        _, ms = timed_call(terrain.update, grid, changed)
        if version >= 3:
            row.n, row.solved = row.n + 1, row.solved + 1
            row.ms.append(ms)
            row.note("grid_ms", grid_ms)
    return row


def evenly_spread(items: list[PlanQuery], n: int) -> list[PlanQuery]:
    """At most n of them, evenly from the first to the last."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(n, len(items))).round().astype(int))]


def _shifted(cell: Cell, pad: int) -> Cell:
    return cell[0] + pad, cell[1] + pad
