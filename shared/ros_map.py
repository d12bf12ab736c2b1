# SPDX-License-Identifier: Apache-2.0
"""Maps as ROS map_server keeps them: a grey picture (map.pgm) and its YAML. Picture row 0 is the highest y."""

import os
import tempfile
from math import isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared.config import UserError, load_yaml
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, UNKNOWN

Int8s = NDArray[np.int8]
UInt8s = NDArray[np.uint8]

OCCUPIED_GREY, FREE_GREY, UNKNOWN_GREY = 0, 254, 205  # as map_saver writes them
KEYS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


def read_ros_map(path: Path) -> tuple[Int8s, float, float, float]:
    """Cells (h, w) int8 in percent, -1 unknown, row 0 at the lowest y; m a cell; x and y (m) of the lower left corner.

    `mode: trinary` (the default), `scale` and `raw` as http://wiki.ros.org/map_server has them. An origin with a yaw is
    refused. Raises UserError where the YAML or the picture cannot be read or does not make sense.
    """
    tree = load_yaml(path)
    missing = [key for key in KEYS if key not in tree and key != "negate"]
    if missing:
        raise UserError(f"{path}: no `{missing[0]}`", f"a map's YAML has {', '.join(KEYS)}")
    mode = str(tree.get("mode", "trinary"))
    try:
        resolution, occupied_from, free_up_to = (
            float(tree[key]) for key in ("resolution", "occupied_thresh", "free_thresh")
        )
        x0, y0, yaw = (float(v) for v in tree["origin"])
        negate = bool(int(tree.get("negate", 0)))
    except (TypeError, ValueError):
        raise UserError(
            f"{path}: resolution, origin, thresholds and negate must be numbers", "origin: [x, y, yaw]"
        ) from None
    if not all(isfinite(v) for v in (resolution, occupied_from, free_up_to, x0, y0, yaw)) or not 0 < resolution <= 10:
        raise UserError(
            f"{path}: resolution {resolution} m a cell, origin {x0}, {y0}", "they must be finite and over 0"
        )
    if abs(yaw) > 1e-6:
        raise UserError(f"{path}: the map is turned by {yaw} rad", "turn the picture, and set the origin's yaw to 0")
    if mode not in ("trinary", "scale", "raw"):
        raise UserError(f"{path}: mode {mode} is not known", "trinary, scale or raw")
    if not 0 <= free_up_to < occupied_from <= 1:
        raise UserError(f"{path}: free_thresh is not under occupied_thresh", "0.196 and 0.65 are map_saver's")
    grey, alpha = _grey(path.parent / str(tree["image"]), path)
    return _cells(grey, alpha, mode, negate, occupied_from, free_up_to)[::-1].copy(), resolution, x0, y0


def write_ros_map(folder: Path, cells: Int8s, resolution: float, x0: float, y0: float, name: str = "map") -> Path:
    """Writes NAME.pgm and NAME.yaml and returns the YAML's path. Each is replaced whole, the picture first.

    Raises UserError where the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, content in ros_map_files(cells, resolution, x0, y0, name).items():
            replace_file(folder / file, content)
    except OSError as error:
        raise UserError(f"cannot write the map to {folder}: {error.strerror}", "check the path and the disk") from None
    return folder / f"{name}.yaml"


def ros_map_files(cells: Int8s, resolution: float, x0: float, y0: float, name: str = "map") -> dict[str, bytes]:
    """The content of NAME.pgm and NAME.yaml. cells: (h, w) int8 percent, -1 unknown, row 0 lowest; m a cell; m, m.

    Cells between the thresholds become unknown, as map_saver does.
    """
    grey = np.full(cells.shape, UNKNOWN_GREY, np.uint8)
    grey[(cells != UNKNOWN) & (cells <= FREE_UP_TO)] = FREE_GREY
    grey[cells >= OCCUPIED_FROM] = OCCUPIED_GREY
    height, width = cells.shape
    settings = (
        f"image: {name}.pgm\nmode: trinary\nresolution: {resolution:.9g}\norigin: [{x0:.9g}, {y0:.9g}, 0]\n"
        f"negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {
        f"{name}.pgm": f"P5\n{width} {height}\n255\n".encode() + grey[::-1].tobytes(),
        f"{name}.yaml": settings.encode(),
    }


def replace_file(path: Path, content: bytes) -> None:
    """Writes a file so that a crash leaves the old one or the new one, never half of it."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _grey(image: Path, path: Path) -> tuple[UInt8s, UInt8s]:
    """Brightness (colours averaged, as map_server does) and opacity of a picture, row 0 on top."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(image) as picture:
            if picture.mode in ("L", "I", "I;16", "1", "P") and "transparency" not in picture.info:
                grey = np.asarray(picture.convert("L"), np.uint8)
                return grey, np.full(grey.shape, 255, np.uint8)
            channels = np.asarray(picture.convert("RGBA"), np.uint16)
    except FileNotFoundError:
        raise UserError(
            f"{path}: there is no picture {image}", "set `image` to the picture's path, from the YAML"
        ) from None
    except (OSError, UnidentifiedImageError, ValueError, Image.DecompressionBombError):
        raise UserError(f"{image}: not a whole picture", "write the map again: zenav map save") from None
    return channels[:, :, :3].mean(axis=2).astype(np.uint8), channels[:, :, 3].astype(np.uint8)


def _cells(grey: UInt8s, alpha: UInt8s, mode: str, negate: bool, occupied_from: float, free_up_to: float) -> Int8s:
    if mode == "raw":
        return np.where(grey <= 100, grey, 255).astype(np.uint8).view(np.int8)
    share = (grey if negate else 255 - grey.astype(np.int16)) / 255.0
    cells = np.full(grey.shape, UNKNOWN, np.int8)
    if mode == "scale":
        between = 99 * (share - free_up_to) / (occupied_from - free_up_to)
        cells[alpha > 0] = np.clip(between, 0, 99).astype(np.int8)[alpha > 0]
    cells[share > occupied_from] = 100
    cells[share < free_up_to] = 0
    return cells
