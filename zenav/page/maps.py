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
from zenav.maps.conversion import convert
from zenav.maps.map_files import MAPS_FOLDER, find_map
from zenav.page.target import PageTarget, Values

MODES = {"localize": MapMode.LOCALISE, "continue": MapMode.CONTINUE}
MAX_UNPACKED = 256 * 2**20  # bytes of an uploaded map: 16 000 x 16 000 cells


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
    save_map(target.robot, target.stack, values["name"])


def load(target: PageTarget, values: Values) -> None:
    """Lets the mapper go on with a saved map; in the mode "map" it begins a new one."""
    if values["mode"] == "map":
        change_mode(target.robot, target.stack, MapMode.MAP, None)
        return
    load_map(target.robot, target.stack, values["name"], MODES[values["mode"]], at_of(values.get("pose")))


def rename(target: PageTarget, values: Values) -> None:
    """Gives a saved map another name. Raises UserError where that is in use."""
    folder, to = _folder(values["name"]), MAPS_FOLDER / values["to"]
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
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in ("map.yaml", picture):
            archive.write(folder / file, f"{folder.name}/{file}")
    return content.getvalue()


def upload(target: PageTarget, values: Values) -> None:
    """Saves a map for ROS from a zip file: one YAML and its picture. Raises UserError where it is none."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(values["content"]))
        files = {Path(entry.filename).name: entry for entry in archive.infolist() if not entry.is_dir()}
        if sum(entry.file_size for entry in files.values()) > MAX_UNPACKED:
            raise UserError("the map is too large", f"at most {MAX_UNPACKED // 2**20} MiB unpacked")
        yamls = [name for name in files if name.endswith((".yaml", ".yml"))]
        if len(yamls) != 1:
            raise UserError(f"the file holds {len(yamls)} YAML files", "a map is one YAML and its picture")
        with tempfile.TemporaryDirectory() as unpacked:
            path = _unpack(archive, files[yamls[0]], Path(unpacked))
            picture = str(load_yaml(path).get("image", ""))
            if picture not in files or picture == yamls[0]:
                raise UserError(
                    f"its picture {picture!r} is not in the file", "zip the YAML and its picture, side by side"
                )
            _unpack(archive, files[picture], Path(unpacked))
            convert(str(path), MAPS_FOLDER / values["name"], "trinary", False, False)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise UserError(f"this is no zip file of a map: {error}", "zip the YAML and its picture") from None


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
    path = find_map(name)
    if path.parent != MAPS_FOLDER / name:
        raise UserError(f"{name} is no map of {MAPS_FOLDER}/", "see the list of maps")
    return path.parent


def _unpack(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path) -> Path:
    path = folder / Path(entry.filename).name
    with archive.open(entry) as file:
        content = file.read(MAX_UNPACKED + 1)
    if len(content) > MAX_UNPACKED:
        raise UserError("the map is too large", f"at most {MAX_UNPACKED // 2**20} MiB unpacked")
    path.write_bytes(content)
    return path
