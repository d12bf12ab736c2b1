# SPDX-License-Identifier: Apache-2.0
"""A map for ROS in a zip file from elsewhere: what may be in it, and how it is unpacked.

Nothing is unpacked by the path that the archive gives: two files are, by their own names, into a folder that the caller
made. An archive with a path out of it, a link or a name twice is refused as a whole, as is one over the limits.

There is no limit of the ratio of sizes. Deflate has at most 1032, and the picture of an empty map comes near it.
"""

import io
import stat
import zipfile
import zlib
from lzma import LZMAError
from pathlib import Path, PurePosixPath, PureWindowsPath
from zipfile import BadZipFile

from shared.config import UserError, load_yaml

MAX_ENTRIES = 100
MAX_UNPACKED = 256 * 2**20  # bytes of all entries; of a picture: 16 000 x 16 000 cells
MAX_YAML = 16 * 2**10  # bytes
SIDE_BY_SIDE = "zip the YAML and its picture, side by side"


def unpack_map_archive(content: bytes, folder: Path) -> Path:
    """Unpacks the YAML and its picture into an empty folder; returns the YAML's path. Raises UserError."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _unpack_map(archive, folder)
    except (BadZipFile, zlib.error, LZMAError, NotImplementedError, RuntimeError, EOFError, ValueError) as error:
        raise UserError(f"this is no zip file of a map: {error}", "zip the YAML and its picture") from None
    except OSError as error:  # bz2 raises it on damage too
        raise UserError(f"cannot unpack the map: {error.strerror or error}", "zip it again; check the disk") from None


def _unpack_map(archive: zipfile.ZipFile, folder: Path) -> Path:
    files = _checked(archive.infolist())
    yamls = [name for name in files if name.endswith((".yaml", ".yml"))]
    if len(yamls) != 1:
        raise UserError(f"the file holds {len(yamls)} YAML files", "a map is one YAML and its picture")
    path = _unpack(archive, files[yamls[0]], folder, MAX_YAML)
    picture = str(load_yaml(path).get("image", ""))
    if picture not in files or picture == yamls[0]:
        raise UserError(f"its picture {picture[:80]!r} is not in the file", SIDE_BY_SIDE)
    _unpack(archive, files[picture], folder, MAX_UNPACKED)
    return path


def _checked(entries: list[zipfile.ZipInfo]) -> dict[str, zipfile.ZipInfo]:
    """The files by their own names. Raises UserError for what no map's archive has."""
    if len(entries) > MAX_ENTRIES:
        raise UserError(f"the file has {len(entries)} entries", f"at most {MAX_ENTRIES}: one YAML and its picture")
    if sum(entry.file_size for entry in entries) > MAX_UNPACKED:
        raise UserError("the map is too large", f"at most {MAX_UNPACKED // 2**20} MiB unpacked")
    files: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        if not is_inner_path(entry.filename) or not is_inner_path(entry.orig_filename):
            raise UserError(f"{entry.orig_filename[:80]!r} leads out of the file", SIDE_BY_SIDE)
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise UserError(f"{entry.filename[:80]!r} is a link or a device", "zip the files themselves")
        if entry.is_dir():
            continue
        name = PurePosixPath(entry.filename).name
        if name in files:
            raise UserError(f"{name[:80]!r} is twice in the file", SIDE_BY_SIDE)
        files[name] = entry
    return files


def is_inner_path(path: str) -> bool:
    """Whether a path of an archive stays inside, on any system: relative, without `..`, backslash or control."""
    parts = path.rstrip("/").split("/")
    return (
        path.isprintable()
        and not PureWindowsPath(path).drive
        and "\\" not in path
        and all(part not in ("", ".", "..") and len(part) <= 255 for part in parts)
    )


def _unpack(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path, max_bytes: int) -> Path:
    with archive.open(entry) as file:
        content = file.read(max_bytes + 1)
    name = PurePosixPath(entry.filename).name
    if len(content) > max_bytes:
        raise UserError(f"{name[:80]!r} is too large", f"at most {max_bytes // 2**10} KiB unpacked")
    path = folder / name
    path.write_bytes(content)
    return path
