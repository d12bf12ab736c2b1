# SPDX-License-Identifier: Apache-2.0
"""Saved maps for pages: list, save, load, rename, delete, download and upload; and the robot's pose on the map."""

import io
import shutil
import tempfile
import zipfile
from math import degrees
from pathlib import Path
from threading import Event

from shared import topics
from shared.config import UserError, load_robot, load_yaml
from shared.geometry import Pose2, wrapped
from shared.messages import MapMode
from shared.reasons import POSE_OLD
from shared.runners.transport import stack_address
from zenav.client import Client
from zenav.client.map_modes import At, change_mode, load_map, rename_present_map, save_map
from zenav.client.map_transfer import start_mode
from zenav.client.named_items import NAME
from zenav.maps.conversion import convert
from zenav.maps.map_archive import unpack_map_archive
from zenav.maps.map_files import MAPS_FOLDER, find_map
from zenav.page.target import PageTarget, Values

MODES = {"localize": MapMode.LOCALISE, "continue": MapMode.CONTINUE}


def maps(target: PageTarget, values: Values) -> list[Values]:
    """Each saved map: name, size in bytes of its files, s since 1970 of its last change."""
    rows = []
    for path in sorted(MAPS_FOLDER.glob("*/map.yaml")):
        states = [file.stat() for file in path.parent.iterdir() if file.is_file()]
        size, modified = sum(state.st_size for state in states), max(state.st_mtime for state in states)
        rows.append({"name": path.parent.name, "size": size, "modified": modified})
    return rows


def save(target: PageTarget, values: Values) -> None:
    """Saves the present map."""
    save_map(target.robot, target.stack, _new_folder(values["name"]).name)


def load(target: PageTarget, values: Values) -> None:
    """Lets the mapper go on with a saved map; in the mode "map" it begins a new one."""
    if values["mode"] == "map":
        change_mode(target.robot, target.stack, MapMode.MAP, None)
        return
    load_map(target.robot, target.stack, values["name"], MODES[values["mode"]], at_of(values.get("pose")))


def rename(target: PageTarget, values: Values) -> None:
    """Gives a saved map another name. Raises UserError where that is in use."""
    folder, to = _folder(values["name"]), _new_folder(values["to"])
    if to.exists():
        raise UserError(f"there is a map {values['to']} already", "choose another name, or delete that one first")
    folder.rename(to)
    rename_present_map(target.robot, target.stack, folder.name, to.name)


def delete(target: PageTarget, values: Values) -> None:
    """Deletes a saved map with its places and zones."""
    folder = _folder(values["name"])
    shutil.rmtree(folder)
    rename_present_map(target.robot, target.stack, folder.name, "")


def download(target: PageTarget, values: Values) -> bytes:
    """A map for ROS as a zip file: NAME/map.yaml and its picture."""
    folder = _folder(values["name"])
    picture = Path(str(load_yaml(folder / "map.yaml")["image"])).name
    if not (folder / picture).is_file() or (folder / picture).is_symlink():
        raise UserError(f"{folder} has no picture {picture}", "save the map again: zenav map save")
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in ("map.yaml", picture):
            archive.write(folder / file, f"{folder.name}/{file}")
    return content.getvalue()


def upload(target: PageTarget, values: Values) -> None:
    """Saves a map for ROS from a zip file: one YAML and its picture. Raises UserError where it is none."""
    with tempfile.TemporaryDirectory() as unpacked:
        path = unpack_map_archive(values["content"], Path(unpacked))
        convert(str(path), _new_folder(values["name"]), "trinary", False, False)


def set_pose(target: PageTarget, values: Values) -> None:
    """The robot is at a pose (m, m, rad) on the present map. A mapper that maps goes on mapping."""
    with Client(load_robot(target.robot).robot.name, stack_address(target.stack)) as client:
        estimate = client.latched_value(topics.POSE)
        if estimate is None:
            raise UserError(POSE_OLD.text, POSE_OLD.hint)
        mode = MapMode.LOCALISE if estimate.mode is MapMode.LOCALISE else MapMode.CONTINUE
        x, y, yaw = values["pose"]
        start_mode(client, Event().wait, mode, at=Pose2(x, y, wrapped(yaw)))


def at_of(pose: list[float] | None) -> At | None:
    """[x, y, yaw] in m, m, rad as the command line has it: m, m, degrees."""
    return None if pose is None else (pose[0], pose[1], degrees(pose[2]))


def _folder(name: str) -> Path:
    """The folder of a saved map below maps/. Raises UserError where there is none."""
    _new_folder(name)
    path = find_map(name)
    if path.parent != MAPS_FOLDER / name:
        raise UserError(f"{name} is no map of {MAPS_FOLDER}/", "see the list of maps")
    return path.parent


def _new_folder(name: str) -> Path:
    """The folder of a map's name, which may not exist yet. Raises UserError where the name is no map's."""
    if not NAME.fullmatch(name):
        raise UserError(f"{name[:80]!r} is no name of a map", "begin with a letter; then letters, digits, - and _")
    return MAPS_FOLDER / name
