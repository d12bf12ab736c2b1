# SPDX-License-Identifier: Apache-2.0
"""Loads worlds: YAML worlds, ROS maps (map_server), cylinder lists (BARN). All file access of the simulator is here."""

import gzip
import json
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
from pydantic import ConfigDict, Field, ValidationError
from ruamel.yaml.comments import CommentedMap

from services.sim.building import building
from services.sim.crowd import crowd_world
from services.sim.warehouse import warehouse
from services.sim.world import Raster, World
from services.sim.world_file import build_world
from shared.config import RobotFile, Section, UserError, load_yaml, nearest
from shared.geometry import Pose2
from shared.grid import FREE_UP_TO
from shared.ros_map import read_ros_map

GENERATED = "barn:", "building:", "crowd:"  # how the names of worlds without a file begin, but for the warehouse
WORLDS_DIR = Path(__file__).resolve().parent / "worlds"  # data of this package
WAREHOUSE = "warehouse"
START_CLEARANCE_M = 1.0  # m of free space around a start that no file gives
MAX_SEARCHED_CELLS = 100_000_000  # of a world without a start
MIN_PASSAGE_M = 0.35  # m: floors connected by less count as two


class CylinderWorld(Section):
    """One world of a cylinder list."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    cylinders: tuple[tuple[float, float], ...]


class CylinderFile(Section):
    """A list of worlds of cylinders, as the BARN data set is kept here."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    cylinder_radius_m: float = Field(gt=0)
    start: tuple[float, float, float]
    goal: tuple[float, float]
    worlds: dict[str, CylinderWorld]


F = TypeVar("F", bound=CylinderFile)


def load_world(
    world: str, seed: int = 0, jitter: float = 0.0, barn_file: str = "", start: Pose2 | None = None
) -> World:
    """A world by name (`office`), by path (a world's or a ROS map's YAML), or by number, routes checked.

    Numbers are `barn:N` of barn_file, `building:N`, its floors `building:N/F`, and `crowd:N`. `warehouse` is generated,
    too.

    seed, jitter: where loose things stand, see `world_file.built`.  start: replaces the world's own.
    Raises UserError, naming file and line, where something is missing or wrong.
    """
    if world.startswith("barn:"):
        loaded, has_start = _cylinders(world, barn_file), True
    elif world.startswith("building:"):
        loaded, has_start = _building(world, seed, jitter), True
    elif world == WAREHOUSE:
        loaded = build_world(world, RobotFile(Path(world), CommentedMap(warehouse())), None, seed, jitter)
        has_start = True
    elif world.startswith("crowd:"):
        loaded, has_start = crowd_world(_number(world)), True
    else:
        path = world_path(world)
        tree = load_yaml(path)
        if "image" in tree:
            raster = _raster(path)
            loaded = World(path.stem, raster.bounds, Pose2(), raster=raster)
        else:
            mapped = _raster(path.parent / str(tree["map"])) if tree.get("map") else None
            loaded = build_world(path.stem, RobotFile(path, tree), mapped, seed, jitter)
        has_start = "start" in tree
    if start is None and not has_start:
        start = _most_open_pose(loaded)
    return loaded if start is None else replace(loaded, start=start)


def world_path(world: str) -> Path:
    """The file of a world that is not generated. Raises UserError where there is none."""
    path = Path(world) if world.endswith((".yaml", ".yml")) else WORLDS_DIR / f"{world}.yaml"
    if not path.is_file():
        names = (*(p.stem for p in sorted(WORLDS_DIR.glob("*.yaml"))), "barn:N", "building:N", "crowd:N", WAREHOUSE)
        raise UserError(f"there is no world {world}", nearest(world, names))
    return path


def _building(world: str, seed: int, jitter: float) -> World:
    name, slash, floor = world.partition("/")
    tree = building(_number(name), _digits(floor, world, "building:3/1 is another floor of building:3") if slash else 0)
    return build_world(world, RobotFile(Path(world), CommentedMap(tree)), None, seed, jitter)


def _number(world: str) -> int:
    kind, _, number = world.partition(":")
    return _digits(number, world, f"a number makes a {kind}, like {kind}:3")


def _digits(number: str, world: str, hint: str) -> int:
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        raise UserError(f"there is no world {world}", hint)
    return int(number)


def _raster(path: Path) -> Raster:
    """The solid cells of a ROS map: all that are not free, so also the unknown ones."""
    cells, resolution, x0, y0 = read_ros_map(path)
    return Raster((cells < 0) | (cells > FREE_UP_TO), x0, y0, resolution)


def _cylinders(world: str, barn_file: str) -> World:
    if not barn_file:
        raise UserError(f"world {world}: there is no list of cylinders", "give its file: `barn_file:` in section `sim`")
    path = Path(barn_file)
    file = read_cylinder_file(path, CylinderFile)
    number = world.partition(":")[2]
    if number not in file.worlds:
        raise UserError(f"{path}: there is no world {number}", nearest(number, tuple(file.worlds)[:12]))
    places = np.array(file.worlds[number].cylinders, float).reshape(-1, 2)
    circles = np.column_stack((places, np.full(len(places), file.cylinder_radius_m)))
    around = np.concatenate((places, np.array([file.start[:2], file.goal]))) if len(places) else np.array([file.goal])
    low, high = around.min(axis=0) - 1, around.max(axis=0) + 1
    bounds = float(low[0]), float(low[1]), float(high[0]), float(high[1])
    goal = Pose2(file.goal[0], file.goal[1], file.start[2])
    return World(f"barn_{number}", bounds, Pose2(*file.start), circles=circles, goals={"goal": goal})


def read_cylinder_file(path: Path, model: type[F]) -> F:
    """A list of worlds of cylinders, also gzipped. Raises UserError where it is missing or wrong."""
    try:
        text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        tree: Any = json.loads(text)
        return model.model_validate(tree)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or 'no gzip file'}", "check `barn_file:`") from None
    except (EOFError, ValueError, ValidationError, zlib.error) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path}: not a list of cylinders: {reason}", "see `CylinderFile` in its README") from None


def _most_open_pose(world: World) -> Pose2:
    """A pose on the largest floor with START_CLEARANCE_M, or with the largest clearance that exists.

    Raises UserError where the world is too large to look for it.
    """
    resolution = world.raster.resolution if world.raster else 0.1
    low_x, low_y, high_x, high_y = world.bounds
    if (high_x - low_x) * (high_y - low_y) / resolution**2 > MAX_SEARCHED_CELLS:
        raise UserError(f"world {world.name}: too large to look for a start", "give `start:` with x, y and yaw_deg")
    occupied, x0, y0 = world.occupied(resolution)
    room = np.minimum(
        scipy.ndimage.distance_transform_edt(np.pad(~occupied, 1))[1:-1, 1:-1] * resolution, START_CLEARANCE_M
    )
    floors, n_floors = scipy.ndimage.label(room > min(MIN_PASSAGE_M, room.max() / 2))
    if n_floors:
        room[floors != 1 + np.argmax(np.bincount(floors.ravel())[1:])] = 0.0
    row, column = np.unravel_index(int(np.argmax(room)), room.shape)
    return Pose2(x0 + (float(column) + 0.5) * resolution, y0 + (float(row) + 0.5) * resolution, 0.0)
