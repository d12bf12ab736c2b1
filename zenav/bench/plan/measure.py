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
from zenav.bench.plan.maps import FREE, INFLATED, RESOLUTION, Benchmark, Cell, Scenario, cell_sized, terrain_of
from zenav.bench.plan.navfn import NavFn
from zenav.bench.plan.shortest import corners_of, shortest

Bools = NDArray[np.bool_]
UInt16s = NDArray[np.uint16]
Float64s = NDArray[np.float64]
T = TypeVar("T")

FINE = 0.1  # cells between the places at which a path's clearance is looked up
RIGHT = 1e-3  # cells by which a raw length may differ from the published one
TILES = 40  # tile updates that are timed
SLOW = {256: 20, 512: 10, 1024: 4, 4096: 1}  # queries a map that slow peers get
PEERS = {256: 60, 512: 40, 1024: 30, 4096: 12}  # queries a map that the others get


@dataclass(slots=True)
class Row:
    """What one planner did: CPU ms, whether it was solved, and where it was: length, and others' figures by name."""

    ms: list[float] = field(default_factory=list)
    n: int = 0
    solved: int = 0
    touched: int = 0  # paths over a blocked cell
    figures: dict[str, list[float]] = field(default_factory=dict)

    def note(self, name: str, value: float) -> None:
        """Keeps one more figure."""
        self.figures.setdefault(name, []).append(value)

    def add(self, other: "Row") -> None:
        """Takes another map's row in."""
        self.ms += other.ms
        self.n, self.solved, self.touched = self.n + other.n, self.solved + other.solved, self.touched + other.touched
        for name, values in other.figures.items():
            self.figures.setdefault(name, []).extend(values)

    def summary(self) -> dict[str, Any]:
        """Median and p99 of the time, shares, means."""
        told: dict[str, Any] = {"n": self.n, "solved": round(self.solved / max(self.n, 1), 4), "touched": self.touched}
        if self.ms:
            told |= {
                "ms_median": round(float(np.median(self.ms)), 3),
                "ms_p99": round(float(np.percentile(self.ms, 99)), 3),
            }
        for name, values in self.figures.items():
            told[name] = round(float(np.mean(values)), 4)
            told[f"{name}_max"] = round(float(np.max(values)), 4)
        return told


def timed(work: Callable[..., T], *given: Any) -> tuple[T, float]:
    """What it gives, and its CPU time, ms."""
    begun = process_time()
    result = work(*given)
    return result, (process_time() - begun) * 1e3


def raw(benchmark: Benchmark) -> Row:
    """The exact search, no costs; the figure `wrong` is 1 where the length is not the published one."""
    costs = np.pad(benchmark.free, 1).astype(np.uint16)
    search, row = GridSearch(), Row()
    for warm in (True, False):
        for scenario in benchmark.scenarios[:3] if warm else benchmark.scenarios:
            ends = _shifted(scenario.start, 1), _shifted(scenario.goal, 1)
            way, ms = timed(search.cheapest_path, costs, *ends, 1, 1)
            if not warm:
                steps = np.abs(np.diff(way, axis=0)).sum(axis=1)
                octile = np.count_nonzero(steps == 1) + np.count_nonzero(steps == 2) * np.sqrt(2)
                row.n, row.solved = row.n + 1, row.solved + (len(way) > 0)
                row.ms.append(ms)
                row.note("wrong", float(not abs(octile - scenario.optimum) <= RIGHT + scenario.rounded))
    return row


def ours(terrain: GlobalCostmap, scenarios: list[Scenario]) -> tuple[Row, list[Float64s]]:
    """`plan_path`, as the planner calls it, from pose to path; the paths, (x, y) in cells of the costs."""
    outline, config, row = HierarchicalSearch(), PlanningConfig(spacing=terrain.resolution), Row()
    paths = []
    for warm in (True, False):
        for scenario in scenarios[:3] if warm else scenarios:
            start, goal = (
                Pose2(*terrain.centre(*_shifted(cell, terrain.pad))) for cell in (scenario.start, scenario.goal)
            )
            plan, ms = timed(plan_path, terrain, outline, start, goal, 0.0, config)
            if warm:
                continue
            path = (plan.points - terrain.origin) / terrain.resolution
            paths.append(path)
            row.ms.append(ms)
            _judged(row, terrain, path)
            if len(path) > 1:
                row.note("turn_deg", float(np.degrees(np.abs(np.diff(np.unwrap(plan.yaws[:-1]))).max(initial=0.0))))
    return row, paths


def _judged(row: Row, terrain: GlobalCostmap, path: Float64s) -> None:
    row.n += 1
    if not len(path):
        return
    row.solved += 1
    row.touched += path_cost(terrain.costs, path) < 0
    away = clearance(terrain, path)
    row.note("path_m", length(path) * terrain.resolution)
    row.note("clearance_least_m", float(away.min()))
    row.note("clearance_mean_m", float(away.mean()))


def clearance(terrain: GlobalCostmap, path: Float64s) -> Float64s:
    """(n,) m from the path's cells to the nearest obstacle, at most the inflation radius."""
    path = resampled_path(path, FINE)
    cells = np.clip(path.astype(np.int64) - terrain.pad, 0, np.array(terrain.distance.shape[::-1]) - 1)
    return np.asarray(terrain.distance[cells[:, 1], cells[:, 0]] * terrain.resolution, np.float64)


def length(path: Float64s) -> float:
    """Cells."""
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def movingai_rows(benchmark: Benchmark, robot: Robot) -> dict[str, Row]:
    """All rows of one of the Moving AI maps, by name."""
    small = cell_sized(robot)
    cells = np.where(benchmark.free, 0, 100).astype(np.int8)
    rows = {} if benchmark.times > 1 else {"raw, exact 8-connected": raw(benchmark)}
    terrain = terrain_of(cells, RESOLUTION, FREE, small)
    some = spread(benchmark.scenarios, PEERS[benchmark.size])
    rows["ours, free and blocked"], paths = ours(terrain, benchmark.scenarios)
    optima = any_angle(benchmark, terrain, some, paths)
    found = dict(zip(map(id, benchmark.scenarios), paths))
    for scenario in some:
        best = optima[id(scenario)]
        if best > 0 and len(found[id(scenario)]):
            rows["ours, free and blocked"].note("length", length(found[id(scenario)]) / best)
    rows |= others(terrain.costs, terrain, some, optima, SLOW[benchmark.size])
    del terrain
    terrain = terrain_of(cells, RESOLUTION, INFLATED, small)
    rows["ours, with costs"], _ = ours(terrain, benchmark.scenarios)
    rows |= {f"{name}, with costs": row for name, row in navfns(terrain.costs, terrain, some, {}).items()}
    if benchmark.size == 4096:
        rows["a tile's update"] = tile_updates(terrain, cells)
    sys.stderr.write(f"{benchmark.name}: {len(benchmark.scenarios)} scenarios\n")
    return rows


def any_angle(
    benchmark: Benchmark, terrain: GlobalCostmap, some: list[Scenario], paths: list[Float64s]
) -> dict[int, float]:
    """The shortest length of all for some scenarios, cells, by the scenario's id.

    On an enlarged map by the published one's corners: the obstacles are the same, and so few.
    """
    times = benchmark.times
    free = benchmark.free[::times, ::times]
    corners = corners_of(free)
    found = {}
    for scenario, path in zip(benchmark.scenarios, paths):
        if scenario in some and len(path):
            ends = np.array([scenario.start[::-1], scenario.goal[::-1]], float) + 0.5
            found[id(scenario)] = times * shortest(free, corners, ends / times, length(path) / times)
    return found


def others(
    costs: UInt16s, terrain: GlobalCostmap, some: list[Scenario], optima: dict[int, float], n_slow: int
) -> dict[str, Row]:
    """NavFn, and what Python users choose where that is installed, on the same costs."""
    rows = navfns(costs, terrain, some, optima)
    weights = np.where(costs > 0, 1.0, np.inf).astype(np.float32)
    for name, peer in peers().items():
        if peer is None:
            sys.stderr.write(f"{name}: not installed, no row\n")
            continue
        rows[name] = _asked(terrain, spread(some, n_slow), optima, partial(peer, weights))
    return rows


def navfns(costs: UInt16s, terrain: GlobalCostmap, some: list[Scenario], optima: dict[int, float]) -> dict[str, Row]:
    """NavFn's two searches."""
    navfn = NavFn(costs)
    return {
        name: _asked(terrain, some, optima, partial(navfn.path, astar=astar))
        for name, astar in (("NavFn A*", True), ("NavFn Dijkstra", False))
    }


def _asked(
    terrain: GlobalCostmap, some: list[Scenario], optima: dict[int, float], plan: Callable[[Cell, Cell], Float64s]
) -> Row:
    row = Row()
    for warm in (True, False):
        for scenario in some[:1] if warm else some:
            ends = _shifted(scenario.start, terrain.pad), _shifted(scenario.goal, terrain.pad)
            path, ms = timed(plan, *ends)
            if warm:
                continue
            row.ms.append(ms)
            _judged(row, terrain, path)
            if len(path) and optima.get(id(scenario), 0) > 0:
                row.note("length", length(path) / optima[id(scenario)])
    return row


def peers() -> dict[str, Callable[[Any, Cell, Cell], Float64s] | None]:
    """The planners of other packages, by name; None where a package is not installed."""
    found: dict[str, Callable[[Any, Cell, Cell], Float64s] | None] = {"pyastar2d": None, "scikit-image MCP": None}
    try:
        import pyastar2d

        def astar(weights: Any, start: Cell, goal: Cell) -> Float64s:
            way = pyastar2d.astar_path(weights, start, goal, allow_diagonal=True)
            return np.empty((0, 2)) if way is None else way[:, ::-1] + 0.5

        found["pyastar2d"] = astar
    except ImportError:
        pass
    try:
        from skimage.graph import MCP_Geometric

        def mcp(weights: Any, start: Cell, goal: Cell) -> Float64s:
            search = MCP_Geometric(weights)
            search.find_costs([start], [goal])
            return np.array(search.traceback(goal), float)[:, ::-1] + 0.5

        found["scikit-image MCP"] = mcp
    except ImportError:
        pass
    return found


def tile_updates(terrain: GlobalCostmap, cells: NDArray[np.int8]) -> Row:
    """What a changed tile costs the planner: distances, costs, blocks and regions; also `grid_ms`, the map's own."""
    grid = OccupancyGrid(terrain.resolution)
    grid.cells = terrain.cells.copy()
    rng, row = np.random.default_rng(1), Row()
    tiles = np.array(cells.shape) // TILE_CELLS
    for version in range(TILES + 3):
        r, c = (int(rng.integers(n)) for n in tiles)
        tile = grid.cells[r * TILE_CELLS : (r + 1) * TILE_CELLS, c * TILE_CELLS : (c + 1) * TILE_CELLS].copy()
        flipped = rng.random(tile.shape) < 0.02
        tile[flipped] = np.where(tile[flipped] == 100, 0, 100)
        place = np.array([r], np.int32), np.array([c], np.int32)
        update = MapUpdate(0, 0, version + 1, terrain.resolution, *place, tile.reshape(1, -1))
        changed, grid_ms = timed(grid.apply, update)
        _, ms = timed(terrain.update, grid, changed)
        if version >= 3:
            row.n, row.solved = row.n + 1, row.solved + 1
            row.ms.append(ms)
            row.note("grid_ms", grid_ms)
    return row


def spread(items: list[Scenario], n: int) -> list[Scenario]:
    """At most n of them, evenly from the first to the last."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(n, len(items))).round().astype(int))]


def _shifted(cell: Cell, pad: int) -> Cell:
    return cell[0] + pad, cell[1] + pad
