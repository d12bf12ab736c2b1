# SPDX-License-Identifier: Apache-2.0
"""`zenav map merge`: saved maps of one building, from one robot or several, as one map."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from services.mapper.back_end.pose_graph import pose_of
from services.mapper.config import MapperConfig
from services.mapper.maps.map_file import SavedMap
from services.mapper.maps.map_merging import MergedMap, merge_maps
from shared.config import UserError, load_robot
from shared.geometry import Pose2
from zenav.client.named_items import NamedItems
from zenav.client.places import PLACES, NamedPlace
from zenav.client.zones import ZONES
from zenav.maps.foreign_map import read_map
from zenav.maps.map_files import find_map, folder_for
from zenav.maps.saved_map import GRAPH, write_saved_map

ANOTHER_NAME = "choose another name, or overwrite it: --force"


@dataclass(frozen=True, slots=True)
class MergedPart:
    """A map that went into another one.  first_row: of its keyframes there."""

    folder: Path
    saved: SavedMap
    first_row: int

    def moved(self, merged: SavedMap, x: float, y: float) -> Pose2:
        """Returns merged_from_own near (x, y) m: the motion of the nearest keyframe."""
        poses = self.saved.graph.poses
        nearest = int(np.argmin(np.hypot(poses[:, 0] - x, poses[:, 1] - y)))
        return pose_of(merged.graph.poses[self.first_row + nearest]) @ pose_of(poses[nearest]).inverse()


def merge(names: Sequence[str], out: str, robot: str, force: bool) -> Path:
    """Writes one map of several into a folder, with their places and zones; returns the folder.

    The first map's frame stays. A map that is not found on the first one may be found when another was joined before.
    Raises UserError, and writes nothing, where a map is found on none.
    """
    folder = folder_for(out)
    if (folder / "map.yaml").exists() and not force:
        raise UserError(f"there is a map in {folder}", ANOTHER_NAME)
    if len(names) < 2 or len(set(names)) < len(names):
        raise UserError("merge takes two different maps or more", "name them: zenav map merge red blue --out office")
    file = load_robot(robot)
    config = file.section("mapper", MapperConfig)
    range_max = max(laser.range_max for laser in file.robot.mapping_lasers)
    waiting = {name: _read(name, config) for name in names}
    first = waiting.pop(names[0])
    merged, parts = first, [MergedPart(_folder_of(names[0]), first, 0)]
    while waiting:
        problems: dict[str, UserError] = {}
        for name, saved in tuple(waiting.items()):
            try:
                result = merge_maps(merged, saved, config, range_max)
            except UserError as error:
                problems[name] = error
                continue
            parts.append(MergedPart(_folder_of(name), saved, len(merged.keyframes)))
            merged = result.saved
            sys.stdout.write(_joint_text(name, result))
            del waiting[name]
        if len(problems) == len(waiting) and problems:
            name, problem = next(iter(problems.items()))
            raise UserError(f"{name} is not joined to {names[0]}: {problem.what}", problem.hint)
    places, zones = _followed(parts, merged, PLACES, _moved_place), _followed(parts, merged, ZONES, _moved_zone)
    write_saved_map(folder, merged)
    for items, entries in ((PLACES, places), (ZONES, zones)):
        items.replace(folder, entries)
    sys.stdout.write(
        f"{folder / 'map.yaml'} ({len(merged.keyframes)} keyframes, {len(places)} places, {len(zones)} zones)\n"
    )
    return folder


def _read(name: str, config: MapperConfig) -> SavedMap:
    path = find_map(name)
    saved = read_map(path.parent if (path.parent / GRAPH).exists() else path, config.occupancy.resolution)
    if not saved.keyframes:
        raise UserError(f"{path}: the map holds no keyframes", "map the building again")
    return saved


def _folder_of(name: str) -> Path:
    return find_map(name).parent


def _joint_text(name: str, result: MergedMap) -> str:
    pose, overlap = result.first_from_second, result.overlap
    return (
        f"{name}: at x {pose.x:.2f} m, y {pose.y:.2f} m, {degrees(pose.yaw):.1f} degrees; "
        f"{len(overlap.matching)} of {len(overlap.judged)} common places match, {result.n_closures} closures\n"
    )


def _followed(
    parts: Sequence[MergedPart],
    merged: SavedMap,
    items: NamedItems[Any],
    move: Callable[[Any, MergedPart, SavedMap], dict[str, Any]],
) -> dict[str, dict[str, Any]]:
    """Returns the named items of all maps on the merged one; a name that two maps have gets its map's name too."""
    followed: dict[str, dict[str, Any]] = {}
    for part in parts:
        for name, item in items.read(part.folder).items():
            own = f"{name}_{part.folder.name}" if name in followed else name
            if own in followed:
                raise UserError(f"two maps have a {items.word} {own}", f"rename one of them in {items.file}")
            followed[own] = move(item, part, merged)
    return followed


def _moved_place(place: NamedPlace, part: MergedPart, merged: SavedMap) -> dict[str, Any]:
    shift = part.moved(merged, place.x, place.y)
    pose = shift @ Pose2(place.x, place.y)
    yaw = None if place.yaw is None else round((place.yaw + degrees(shift.yaw) + 180) % 360 - 180, 1)
    return {"x": round(pose.x, 3), "y": round(pose.y, 3), "yaw": yaw}


def _moved_zone(zone: Any, part: MergedPart, merged: SavedMap) -> dict[str, Any]:
    corners = np.array(zone.corners, np.float64)
    x, y = corners.mean(axis=0).tolist()
    moved = part.moved(merged, x, y) @ corners
    return {**zone.model_dump(), "corners": [[round(x, 3), round(y, 3)] for x, y in moved.tolist()]}
