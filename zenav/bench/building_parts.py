# SPDX-License-Identifier: Apache-2.0
"""Parts of made-up buildings, each mapped by a robot that begins elsewhere: what `zenav bench merge` joins.

A part is a share of the rooms, in their order along the building's longer side. The driver goes along the corridors, so
two parts share more than their common rooms.
"""

from dataclasses import dataclass, replace
from math import pi
from pathlib import Path

import numpy as np

from services.mapper.maps.map_file import SavedMap
from services.sim.world import World
from shared.config import UserError
from shared.geometry import Pose2
from shared.types import Float64s
from zenav.bench.buildings import drive_tour
from zenav.bench.sim_slam_harness import SimSlamHarness, harness_robot_file
from zenav.maps.saved_map import GRAPH, read_saved_map, write_saved_map
from zenav.stack.hardware import simulated_world

TRUTH = "truth.npy"


@dataclass(frozen=True, slots=True)
class BuildingPart:
    """A share of a building's rooms, from `low` to `high`, and the seed of its drive: noise, loose things, people.

    world: `building:N`, or another floor of it.
    """

    world: str
    low: float
    high: float
    seed: int

    @property
    def folder(self) -> str:
        """Name of the folder of its map."""
        name = self.world.replace(":", "-").replace("/", "-floor-")
        return f"{name}-{round(100 * self.low)}-{round(100 * self.high)}-seed-{self.seed}"


@dataclass(frozen=True, slots=True)
class MappedPart:
    """A part's map, the true poses (n, 3) m, m, rad of its keyframes in the world, and the world of its seed."""

    saved: SavedMap
    truth: Float64s
    world: World


def mapped_part(robot: str, part: BuildingPart, folder: Path, settings: list[str]) -> MappedPart:
    """Returns the map of a part, which is driven unless an earlier run has left it in the folder."""
    place = folder / part.folder
    world = simulated_world(harness_robot_file(robot, part.world, part.seed, None, settings))
    if not (place / TRUTH).exists():
        _drive(robot, part, world, place, settings)
    saved = read_saved_map(place)
    truth = np.load(place / TRUTH)
    if len(truth) != len(saved.keyframes):
        raise UserError(f"{place / GRAPH} and {TRUTH} differ", "remove the folder: the part is driven again")
    return MappedPart(saved, truth, world)


def rooms_of(world: World, low: float, high: float) -> dict[str, Pose2]:
    """Returns the goals of a part: those whose rank along the longer side lies in this share of all."""
    low_x, low_y, high_x, high_y = world.bounds
    along_x = high_x - low_x >= high_y - low_y
    names = sorted(world.goals, key=lambda name: world.goals[name].x if along_x else world.goals[name].y)
    chosen = names[round(low * len(names)) : round(high * len(names))]
    return {name: world.goals[name] for name in chosen}


def _drive(robot: str, part: BuildingPart, world: World, place: Path, settings: list[str]) -> None:
    """Tours the rooms of a part from one of them, in a random heading, and writes its map and the truth."""
    rng = np.random.default_rng([part.seed, 5])
    rooms = rooms_of(world, part.low, part.high)
    middle = rooms[list(rooms)[int(rng.integers(len(rooms)))]]
    start = Pose2(middle.x, middle.y, float(rng.uniform(-pi, pi)))
    harness = SimSlamHarness(harness_robot_file(robot, part.world, part.seed, start, settings))
    harness.world = replace(harness.world, goals=rooms)
    drive_tour(harness, rng)
    saved = harness.mapper.slam.snapshot()
    write_saved_map(place, saved)
    np.save(place / TRUTH, true_poses(harness, saved))


def true_poses(harness: SimSlamHarness, saved: SavedMap) -> Float64s:
    """Returns the true poses (n, 3) m, m, rad of a map's keyframes in the world, interpolated at their stamps."""
    truths = np.array(harness.track.truths)
    stamps = np.array([keyframe.stamp for keyframe in saved.keyframes], np.float64)
    columns = truths[:, 1], truths[:, 2], np.unwrap(truths[:, 3])
    return np.column_stack([np.interp(stamps, truths[:, 0].astype(np.float64), column) for column in columns])
