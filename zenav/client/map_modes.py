# SPDX-License-Identifier: Apache-2.0
"""`zenav map save|load|new|mode`: what the running mapper's map is, and what it does with it."""

import sys
from dataclasses import dataclass
from math import radians
from pathlib import Path
from threading import Event

from services.mapper.config import MapperConfig
from services.mapper.maps.map_file import pack_map, unpack_map
from shared import requests, topics
from shared.config import RobotFile, UserError, load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import Localization, MapMode, PoseEstimate
from shared.reasons import NO_GRAPH, POSE_OLD
from shared.requests import NameMap
from shared.runners.transport import stack_address
from zenav.client import Client
from zenav.client.map_transfer import fetch_map, give_map, start_mode
from zenav.client.map_view import current_map, pose_text
from zenav.client.navigation_client import RequestRefusedError, accepted
from zenav.client.places import PLACES
from zenav.client.zones import RUNS, ZONES, follow_map, zones_in
from zenav.maps.atomic_folder import replace_together
from zenav.maps.foreign_map import is_picture, read_map
from zenav.maps.map_files import MAPS_FOLDER, find_map, folder_for, picture_files
from zenav.maps.saved_map import GRAPH, map_files

At = tuple[float, float, float]
"""Where the robot stands on a map: m, m, degrees."""
MAX_LOCALIZATION_S = 6.0  # s within which a robot is found near a given pose, or where the map is known well


@dataclass(frozen=True, slots=True)
class OnMap:
    """A saved map that the mapper is to take, the mode, and where the robot is on it, if anybody knows.

    picture: the YAML, where that alone is meant: another program's map has no graph.
    """

    folder: Path
    mode: MapMode
    at: At | None
    picture: Path | None = None

    @classmethod
    def of(cls, place: str, mode: MapMode, at: At | None) -> "OnMap":
        """The map of a name below maps/, a folder, or the path of a YAML. Raises UserError where there is none."""
        path = find_map(place)
        return cls(path.parent, mode, at, path if is_picture(Path(place)) else None)

    def read(self, file: RobotFile) -> bytes:
        """Its graph, for the mapper of a robot. Raises UserError where there is no map, or it is damaged, foreign or a
        newer program's, or its zones are wrong.
        """
        zones_in(self.folder)
        resolution = file.section("mapper", MapperConfig).occupancy.resolution
        return pack_map(read_map(self.picture or self.folder, resolution))

    def files(self) -> list[str]:
        """Paths of the files that it is made of."""
        names: tuple[str, ...] = (GRAPH, "map.yaml", "map.pgm")
        if self.picture is not None:
            names = tuple(self.picture.with_suffix(suffix).name for suffix in (self.picture.suffix, ".pgm", ".png"))
        return [str((self.folder / name).resolve()) for name in names if (self.folder / name).is_file()]

    def give(self, client: Client, content: bytes) -> None:
        """Lets the mapper go on with it. Raises UserError where it refuses."""
        wait = Event().wait
        start_mode(client, wait, self.mode, give_map(client, wait, content), _pose(self.at), name_of(self.folder))
        follow_map(client, self.folder)


def save_map(robot: str, stack: str, place: str, force: bool = False) -> None:
    """Writes the present map into a folder: see saved_map.py; without a pose graph, where the mapper keeps none.

    Another map of that name is overwritten only with `force`: its places and zones go too. Raises UserError.
    """
    folder = folder_for(place)
    summary = ""
    with _client(robot, stack) as client:
        overwrites = _has_another_map(client, folder)
        if overwrites and not force:
            hint = f"choose another name, or overwrite it with its places and zones: zenav map save {place} --force"
            raise UserError(f"there is another map in {folder}", hint)
        try:
            saved = unpack_map(fetch_map(client, Event().wait), "the mapper's map")
            files, summary = map_files(saved, saved.graph.poses), f" ({len(saved.keyframes)} keyframes)"
        except RequestRefusedError as refused:
            if refused.code != NO_GRAPH.code:
                raise
            sys.stderr.write(f"{refused.what}: only its picture is saved\nhint: {refused.hint}\n")
            files = picture_files(current_map(client))
        replace_together(folder, files)
        if overwrites:
            PLACES.replace(folder, {})
            ZONES.replace(folder, {})
        if name_of(folder):
            name_map(client, name_of(folder))
    sys.stdout.write(f"{folder / 'map.yaml'}{summary}\n")


def _has_another_map(client: Client, folder: Path) -> bool:
    """Whether a folder below maps/ has a map that is not the present one. Maps elsewhere have no name."""
    if not name_of(folder) or not (folder / "map.yaml").exists():
        return False
    state = client.latched_value(topics.MAP_STATE)
    return state is None or state.name != name_of(folder)


def name_of(folder: Path) -> str:
    """The name of a saved map below maps/; empty for a folder elsewhere."""
    return folder.name if folder.resolve().parent == MAPS_FOLDER.resolve() else ""


def name_map(client: Client, name: str) -> None:
    """Gives the present map a name, where the mapper runs; empty: none. Raises UserError where it refuses."""
    if client.answers(requests.NAME_MAP, RUNS):
        accepted(client.ask(requests.NAME_MAP, NameMap(client.now(), name)))


def rename_present_map(robot: str, stack: str, name: str, to: str) -> None:
    """Gives the present map another name if it has this one: its folder was renamed, or deleted (empty)."""
    with _client(robot, stack) as client:
        state = client.latched_value(topics.MAP_STATE)
        if state is not None and state.name == name:
            name_map(client, to)


def load_map(robot: str, stack: str, place: str, mode: MapMode, at: At | None) -> int:
    """Gives a saved map to the mapper, which finds the robot on it: near `at`, or wherever it is."""
    on_map = OnMap.of(place, mode, at)
    content = on_map.read(load_robot(robot))
    with _client(robot, stack) as client:
        on_map.give(client, content)
        return _print_pose(client)


def change_mode(robot: str, stack: str, mode: MapMode, at: At | None) -> int:
    """Lets the mapper go on with the present map in another mode, or begin a new one."""
    with _client(robot, stack) as client:
        start_mode(client, Event().wait, mode, at=_pose(at))
        if mode is MapMode.MAP:
            follow_map(client, None)
        return _print_pose(client)


def _print_pose(client: Client) -> int:
    """Where the robot is on the map, as soon as the mapper knows; or what helps it."""
    client.follow(topics.POSE)
    begun = client.now()

    def is_localized(estimate: PoseEstimate) -> bool:
        return estimate.stamp >= begun and estimate.state is not Localization.LOST

    estimate = client.wait(topics.POSE, is_localized, MAX_LOCALIZATION_S) or client.latest(topics.POSE)
    sys.stdout.write(f"{pose_text(estimate) if estimate else POSE_OLD.text}\n")
    return 0


def _pose(at: At | None) -> Pose2 | None:
    return None if at is None else Pose2(at[0], at[1], wrapped(radians(at[2])))


def _client(robot: str, stack: str) -> Client:
    return Client(load_robot(robot).robot.name, stack_address(stack))
