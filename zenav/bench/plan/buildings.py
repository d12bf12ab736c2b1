# SPDX-License-Identifier: Apache-2.0
"""Real buildings: a robot of real size, inflated costs, random places; against NavFn on the same costs."""

import sys
from pathlib import Path

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from shared.config import Robot
from shared.ros_map import read_ros_map
from shared.types import Float64s
from zenav.bench.plan.equal_clearance import least_clearance, ratio_to_equal_clearance, ratio_to_least_clearance
from zenav.bench.plan.maps import Cell, PlanQuery, costmap_of
from zenav.bench.plan.measure import (
    PlannerRow,
    evenly_spread,
    navfn_rows,
    path_clearance,
    path_length,
    planner_row,
)

N_QUERIES = 50  # a map
N_COMPARED = 20  # of them with the shortest at equal clearance, which takes long to find
MIN_DISTANCE = 40  # cells between the ends of a query, at least
CONFIG = CostConfig(unknown="forbidden")
HIGH_CLEARANCE = CONFIG.model_copy(
    update={"clearance_weight": 1.75 * CONFIG.clearance_weight}
)  # its paths are as long as NavFn's


def building_maps(folder: Path) -> list[Path]:
    """The buildings' YAMLs: not the masks of keep-out and speed zones, which are no maps."""
    return sorted(path for path in folder.glob("*.yaml") if not path.stem.endswith(("_keepout", "_speed")))


def building_rows(path: Path, robot: Robot) -> dict[str, PlannerRow]:
    """Ours by two preferences and NavFn's, on one building; none without room for the robot. Raises UserError as the
    reader does.
    """
    cells, resolution, _, _ = read_ros_map(path)
    terrain = costmap_of(cells, resolution, CONFIG, robot)
    scenarios = random_queries(terrain)
    if not scenarios:
        sys.stderr.write(f"{path.stem}: no room for {robot.name}\n")
        return {}
    rows = {}
    rows["ours"], paths = planner_row(terrain, scenarios)
    some = set(map(id, evenly_spread(scenarios, N_COMPARED)))
    for scenario, path_ in zip(scenarios, paths):
        if len(path_) > 1:
            _add_optimal_lengths(rows["ours"], terrain, path_, id(scenario) in some)
    rows[f"ours, clearance_weight {HIGH_CLEARANCE.clearance_weight}"], _ = planner_row(
        costmap_of(cells, resolution, HIGH_CLEARANCE, robot), scenarios
    )
    rows |= navfn_rows(terrain.costs, terrain, scenarios, {})
    sys.stderr.write(f"{path.stem}: {len(scenarios)} queries\n")
    return rows


def random_queries(terrain: GlobalCostmap) -> list[PlanQuery]:
    """Random pairs of cells in the largest region, some way apart; seeded."""
    regions = terrain.components.labels_in(0, 0, *terrain.costs.shape)
    if not regions.any():
        return []
    largest = np.argwhere(regions == np.bincount(regions[regions > 0]).argmax()) - terrain.pad
    rng, queries = np.random.default_rng(1), []
    for _ in range(100 * N_QUERIES):
        start, goal = largest[rng.integers(len(largest), size=2)]
        if np.hypot(*(goal - start)) >= MIN_DISTANCE:
            queries.append(PlanQuery(_cell(start), _cell(goal), 0.0, 0.0))
        if len(queries) == N_QUERIES:
            break
    return queries


def _cell(place: "np.ndarray[tuple[int, ...], np.dtype[np.int64]]") -> Cell:
    return int(place[0]), int(place[1])


def _add_optimal_lengths(row: PlannerRow, terrain: GlobalCostmap, path: Float64s, equally: bool) -> None:
    """Notes the figures `length` and, where asked, `equal`.

    length: over the shortest path with the same least clearance.
    equal: over the shortest path with the same least clearance and the same mean clearance.
    Neither if the search of the first is too large.
    """
    away, size = path_clearance(terrain, path) / terrain.resolution, path_length(path)
    min_clearance = least_clearance(terrain, path, float(away.min()))
    shorter = ratio_to_least_clearance(terrain, path, size, min_clearance)
    if shorter is None:
        return
    row.note("length", shorter)
    if equally:
        row.note("equal", ratio_to_equal_clearance(terrain, path, size, min_clearance, float(away.mean()), shorter))
