# SPDX-License-Identifier: Apache-2.0
"""Real buildings: a robot of real size, inflated costs, random places; against NavFn on the same costs."""

import sys
from pathlib import Path

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from shared.config import Robot
from shared.ros_map import read_ros_map
from zenav.bench.plan.equal_clearance import least_clearance, over_equal, over_least
from zenav.bench.plan.maps import Cell, Scenario, terrain_of
from zenav.bench.plan.measure import Float64s, Row, clearance, length, navfns, ours, spread

QUERIES = 50  # a map
COMPARED = 20  # of them with the shortest at equal clearance, which takes long to find
APART = 40  # cells between the ends of a query, at least
CONFIG = CostConfig(unknown="forbidden")
KEEN = CONFIG.model_copy(
    update={"clearance_weight": 1.75 * CONFIG.clearance_weight}
)  # its paths are as long as NavFn's


def maps(folder: Path) -> list[Path]:
    """The buildings' YAMLs: not the masks of keep-out and speed zones, which are no maps."""
    return sorted(path for path in folder.glob("*.yaml") if not path.stem.endswith(("_keepout", "_speed")))


def building_rows(path: Path, robot: Robot) -> dict[str, Row]:
    """Ours by two preferences and NavFn's, on one building; none without room for the robot. Raises UserError as the
    reader does.
    """
    cells, resolution, _, _ = read_ros_map(path)
    terrain = terrain_of(cells, resolution, CONFIG, robot)
    scenarios = places(terrain)
    if not scenarios:
        sys.stderr.write(f"{path.stem}: no room for {robot.name}\n")
        return {}
    rows = {}
    rows["ours"], paths = ours(terrain, scenarios)
    some = set(map(id, spread(scenarios, COMPARED)))
    for scenario, path_ in zip(scenarios, paths):
        if len(path_) > 1:
            _compare(rows["ours"], terrain, path_, id(scenario) in some)
    rows[f"ours, clearance_weight {KEEN.clearance_weight}"], _ = ours(
        terrain_of(cells, resolution, KEEN, robot), scenarios
    )
    rows |= navfns(terrain.costs, terrain, scenarios, {})
    sys.stderr.write(f"{path.stem}: {len(scenarios)} queries\n")
    return rows


def places(terrain: GlobalCostmap) -> list[Scenario]:
    """Random pairs of cells in the largest region, some way apart; seeded."""
    regions = terrain.components.labels_in(0, 0, *terrain.costs.shape)
    if not regions.any():
        return []
    largest = np.argwhere(regions == np.bincount(regions[regions > 0]).argmax()) - terrain.pad
    rng, found = np.random.default_rng(1), []
    for _ in range(100 * QUERIES):
        start, goal = largest[rng.integers(len(largest), size=2)]
        if np.hypot(*(goal - start)) >= APART:
            found.append(Scenario(_cell(start), _cell(goal), 0.0, 0.0))
        if len(found) == QUERIES:
            break
    return found


def _cell(place: "np.ndarray[tuple[int, ...], np.dtype[np.int64]]") -> Cell:
    return int(place[0]), int(place[1])


def _compare(row: Row, terrain: GlobalCostmap, path: Float64s, equally: bool) -> None:
    """Notes the figures `length` and, where asked, `equal`.

    length: over the shortest path with the same least clearance.
    equal: over the shortest path with the same least clearance and the same mean clearance.
    """
    away, size = clearance(terrain, path) / terrain.resolution, length(path)
    least = least_clearance(terrain, path, float(away.min()))
    shorter = over_least(terrain, path, size, least)
    row.note("length", shorter)
    if equally:
        row.note("equal", over_equal(terrain, path, size, least, float(away.mean()), shorter))
