# SPDX-License-Identifier: Apache-2.0
"""Maps in the format of ROS map_server: a grey picture (map.pgm) and its YAML. Picture row 0 has the highest y."""

import os
import tempfile
import warnings
from io import BytesIO
from math import isfinite
from pathlib import Path

import numpy as np

from shared.config import UserError, load_yaml
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, UNKNOWN
from shared.types import Bools, Int8s, UInt8s

MODES = ("trinary", "scale", "raw")
OCCUPIED_SHARE, FREE_SHARE = 0.65, 0.196  # map_saver's thresholds
OCCUPIED_GREY, FREE_GREY, UNKNOWN_GREY = 0, 254, 205  # as map_saver writes them
MAX_PIXELS = 80_000_000  # 450 x 450 m at 5 cm; Pillow warns from 89 million on
MIN_RESOLUTION, MAX_RESOLUTION = 0.001, 10.0  # m a cell
MAX_ORIGIN_M = 90_000.0  # the tiles of a MapUpdate reach 96 km at 5 cm a cell
PICTURES = ("PPM", "PNG", "BMP", "GIF", "JPEG", "TIFF")  # as map_server reads; others of Pillow's run programs
KEYS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


def read_ros_map(path: Path) -> tuple[Int8s, float, float, float]:
    """Cells (h, w) int8 in percent, -1 unknown, row 0 at the lowest y; resolution (m); lower left corner x, y (m).

    Raises UserError as `read_turned_ros_map` does, and for a map that is turned.
    """
    cells, resolution, x0, y0, yaw = read_turned_ros_map(path)
    if abs(yaw) > 1e-6:
        raise UserError(f"{path}: the map is turned by {yaw} rad", f"turn it back: zenav map convert {path} FOLDER")
    return cells, resolution, x0, y0


def read_turned_ros_map(path: Path) -> tuple[Int8s, float, float, float, float]:
    """As `read_ros_map`, and the yaw (rad) of the cells about their lower left corner.

    `mode: trinary` (the default), `scale` and `raw` as in http://wiki.ros.org/map_server. Raises UserError where the
    YAML or the picture cannot be read or is not valid.
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
    except (TypeError, ValueError, OverflowError):
        raise UserError(
            f"{path}: resolution, origin, thresholds and negate must be numbers", "origin: [x, y, yaw]"
        ) from None
    if not all(isfinite(v) for v in (resolution, occupied_from, free_up_to, x0, y0, yaw)):
        raise UserError(f"{path}: resolution {resolution} m a cell, origin {x0}, {y0}", "they must be finite")
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        raise UserError(f"{path}: resolution {resolution:g} m a cell", f"from {MIN_RESOLUTION:g} to {MAX_RESOLUTION:g}")
    if max(abs(x0), abs(y0)) > MAX_ORIGIN_M:
        raise UserError(f"{path}: the origin {x0:g}, {y0:g} m is too far away", f"at most {MAX_ORIGIN_M:g} m")
    if mode not in MODES:
        raise UserError(f"{path}: mode {mode} is not known", "trinary, scale or raw")
    if not 0 <= free_up_to < occupied_from <= 1:
        raise UserError(f"{path}: free_thresh is not under occupied_thresh", "0.196 and 0.65 are map_saver's")
    grey, alpha = _grey(path.parent / str(tree["image"]), path)
    return _cells(grey, alpha, mode, negate, occupied_from, free_up_to)[::-1].copy(), resolution, x0, y0, yaw


def write_ros_map(folder: Path, cells: Int8s, resolution: float, x0: float, y0: float, name: str = "map") -> Path:
    """Writes NAME.pgm and NAME.yaml and returns the YAML's path. Each is replaced whole, the picture first.

    cells, resolution, x0, y0: as for `ros_map_files`.

    Raises UserError where the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, content in ros_map_files(cells, resolution, x0, y0, name).items():
            replace_file(folder / file, content)
    except OSError as error:
        raise UserError(f"cannot write the map to {folder}: {error.strerror}", "check the path and the disk") from None
    return folder / f"{name}.yaml"


def ros_map_files(
    cells: Int8s,
    resolution: float,
    x0: float,
    y0: float,
    name: str = "map",
    mode: str = "trinary",
    negate: bool = False,
) -> dict[str, bytes]:
    """The content of NAME.pgm and NAME.yaml. cells: (h, w) int8 percent, -1 unknown, row 0 lowest; m a cell; m, m.

    - trinary: cells between the thresholds become unknown, as in map_saver.
    - scale: keeps every percent except 99, which has no grey value and becomes 98. Unknown cells are transparent, so
      the picture is NAME.png.
    - raw: keeps every percent and ignores `negate`.

    negate: white is occupied.
    """
    grey = _grey_of(cells, mode)[::-1]
    if negate and mode != "raw":
        grey = 255 - grey
    height, width = cells.shape
    image = f"{name}.png" if mode == "scale" else f"{name}.pgm"
    settings = (
        f"image: {image}\nmode: {mode}\nresolution: {resolution:.9g}\norigin: [{x0:.9g}, {y0:.9g}, 0]\n"
        f"negate: {int(negate and mode != 'raw')}\noccupied_thresh: {OCCUPIED_SHARE}\nfree_thresh: {FREE_SHARE}\n"
    )
    picture = f"P5\n{width} {height}\n255\n".encode() + grey.tobytes()
    if mode == "scale":
        picture = _png(grey, cells[::-1] != UNKNOWN)
    return {image: picture, f"{name}.yaml": settings.encode()}


def _grey_of(cells: Int8s, mode: str) -> UInt8s:
    """(h, w) brightness of cells, not negated."""
    if mode == "raw":
        return np.where(cells == UNKNOWN, 255, cells).astype(np.uint8)
    grey = np.full(cells.shape, UNKNOWN_GREY, np.uint8)
    if mode == "scale":
        every = np.arange(255, -1, -1, dtype=np.uint8)[None]  # of several greys with one percent, the darkest
        read = _cells(every, np.full_like(every, 255), "scale", False, OCCUPIED_SHARE, FREE_SHARE)[0]
        table = every[0][np.abs(read[None].astype(int) - np.arange(101)[:, None]).argmin(axis=1)]
        table[0] = FREE_GREY
        return np.where(cells == UNKNOWN, grey, table[np.maximum(cells, 0)]).astype(np.uint8)
    grey[(cells != UNKNOWN) & (cells <= FREE_UP_TO)] = FREE_GREY
    grey[cells >= OCCUPIED_FROM] = OCCUPIED_GREY
    return grey


def _png(grey: UInt8s, opaque: Bools) -> bytes:
    """A grey picture with transparency."""
    from PIL import Image

    content = BytesIO()
    alpha = np.where(opaque, 255, 0).astype(np.uint8)
    Image.merge("LA", (Image.fromarray(np.ascontiguousarray(grey)), Image.fromarray(alpha))).save(content, "PNG")
    return content.getvalue()


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
        if image.exists() and not image.is_file():  # reading a device might not end
            raise UserError(f"{image} is no file", "set `image` to the picture's path, from the YAML")
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            opened = Image.open(image, formats=PICTURES)
        with opened as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise Image.DecompressionBombError
            if picture.mode in ("L", "I", "I;16", "1", "P") and "transparency" not in picture.info:
                is_deep = picture.mode.startswith("I")  # 16 bits, which Pillow would cut at 255
                grey = np.clip(np.asarray(picture) // 257, 0, 255) if is_deep else np.asarray(picture.convert("L"))
                return grey.astype(np.uint8), np.full(grey.shape, 255, np.uint8)
            channels = np.asarray(picture.convert("RGBA"), np.uint16)
    except FileNotFoundError:
        raise UserError(
            f"{path}: there is no picture {image}", "set `image` to the picture's path, from the YAML"
        ) from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise UserError(f"{image}: too large", f"a map has at most {MAX_PIXELS} cells: take a coarser one") from None
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError):
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
