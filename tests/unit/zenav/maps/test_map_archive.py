# SPDX-License-Identifier: Apache-2.0
"""Archives and names from elsewhere: what leads out of its folder, or is too much, is refused and writes nothing."""

import gzip
import io
import stat
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from shared.config import UserError
from shared.grid import OccupancyGrid, update_of_cells
from shared.recording import Writer
from shared.ros_map import MAX_PIXELS, read_ros_map, ros_map_files
from zenav.convert import ros_files
from zenav.convert.carmen import MAX_LINE, read_carmen
from zenav.convert.ros_files import read_bag
from zenav.maps.map_archive import MAX_ENTRIES, MAX_UNPACKED, MAX_YAML, is_inner_path, unpack_map_archive
from zenav.maps.map_files import write_map
from zenav.page.target import PageTarget
from zenav.page.tools import run

FILES = ros_map_files(np.zeros((20, 30), np.int8), 0.05, 0.0, 0.0)
YAML, PICTURE = FILES["map.yaml"], FILES["map.pgm"]
TARGET = PageTarget("x80sv", "0")
OUTSIDE = [
    "../map.yaml", "maps/../../map.yaml", "/map.yaml", "/etc/map.yaml", "..\\map.yaml", "a\\map.yaml",
    "C:map.yaml", "C:/map.yaml", "./map.yaml", "a//map.yaml", "a/../map.yaml", "map\n.yaml", "\x1b[2Jmap.yaml",
    "a" * 256 + ".yaml",
]  # fmt: skip


def zipped(*entries: tuple[str | zipfile.ZipInfo, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return content.getvalue()


def of_kind(name: str, kind: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (kind | 0o777) << 16
    return entry


def claiming(content: bytes, size: int) -> bytes:
    """An archive whose directory claims another size of its first entry."""
    at = content.index(b"PK\x01\x02")
    return content[: at + 24] + struct.pack("<I", size) + content[at + 28 :]


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inner").mkdir()
    return tmp_path / "inner"


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_archive_with_a_damaged_picture_is_refused_in_a_line(folder, method):
    content = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, 5000, dtype=np.uint8).tobytes()
    with zipfile.ZipFile(content, "w", method) as archive:
        archive.writestr("map.yaml", YAML)
        archive.writestr("map.pgm", noise)
    damaged = bytearray(content.getvalue())
    damaged[1000:1100] = bytes(100)
    with pytest.raises(UserError) as error:
        unpack_map_archive(bytes(damaged), folder)
    assert "\n" not in error.value.what


def test_a_map_is_unpacked_also_out_of_a_folder_of_the_archive(folder):
    for where in ("", "office/", "maps/office/"):
        path = unpack_map_archive(zipped((f"{where}map.yaml", YAML), (f"{where}map.pgm", PICTURE)), folder)
        assert path == folder / "map.yaml"
        assert read_ros_map(path)[0].shape == (20, 30)


BAD = {
    "no zip": (b"PK\x03\x04 nothing", "no zip file"),
    "cut": (zipped(("map.yaml", YAML), ("map.pgm", PICTURE))[:-30], "no zip file"),
    "link": (zipped((of_kind("map.yaml", stat.S_IFLNK), b"/etc/passwd")), "is a link or a device"),
    "device": (zipped((of_kind("map.pgm", stat.S_IFCHR), b"")), "is a link or a device"),
    "pipe": (zipped((of_kind("map.pgm", stat.S_IFIFO), b"")), "is a link or a device"),
    "many": (zipped(*((f"{k}.pgm", b"") for k in range(MAX_ENTRIES + 1))), "has 101 entries"),
    "bomb": (zipped(("map.yaml", YAML), ("map.pgm", bytes(MAX_UNPACKED))), "the map is too large"),
    "lie": (claiming(zipped(("map.yaml", bytes(MAX_YAML + 10)), ("map.pgm", PICTURE)), 10), "map"),
    "large YAML": (zipped(("map.yaml", b"#" * (MAX_YAML + 1)), ("map.pgm", PICTURE)), "'map.yaml' is too large"),
    "deep YAML": (zipped(("map.yaml", b"image: " + b"[" * 2_000), ("map.pgm", PICTURE)), "not valid YAML"),
    "twice": (zipped(("a/map.yaml", YAML), ("b/map.yaml", YAML)), "'map.yaml' is twice"),
    "two": (zipped(("a.yaml", YAML), ("b.yaml", YAML)), "2 YAML files"),
    "elsewhere": (zipped(("map.yaml", YAML.replace(b"map.pgm", b"/etc/passwd"))), "'/etc/passwd' is not in the file"),
    "above": (zipped(("map.yaml", YAML.replace(b"map.pgm", b"../map.pgm")), ("map.pgm", PICTURE)), "is not in the"),
    "itself": (zipped(("map.yaml", YAML.replace(b"map.pgm", b"map.yaml"))), "is not in the file"),
} | {f"path {name[:20]!r}": (zipped((name, YAML), ("map.pgm", PICTURE)), "leads out of the file") for name in OUTSIDE}


@pytest.mark.parametrize("case", BAD)
def test_an_archive_that_is_no_map_is_refused_and_nothing_is_written_outside(folder, case):
    content, words = BAD[case]
    with pytest.raises(UserError) as error:
        unpack_map_archive(content, folder)
    assert words in error.value.what
    assert "\n" not in error.value.what
    assert error.value.hint
    assert {path.name for path in folder.iterdir()} <= {"map.yaml"}
    assert [path.name for path in folder.parent.iterdir()] == ["inner"]


@settings(max_examples=200)
@given(st.text(st.sampled_from("ab./\\:~\0\n\x1b é")))
def test_a_path_that_is_accepted_stays_inside_on_every_system(path):
    if is_inner_path(path):
        assert not Path(path).is_absolute()
        assert (Path("/folder") / path).resolve().is_relative_to("/folder")
        assert (Path("/folder") / path).resolve() != Path("/folder")
        assert not set(path) & set("\\\0\n\x1b")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.text(st.sampled_from("ab./\\~\0\n é-_1")))
def test_a_name_from_a_page_is_a_folder_of_maps_or_refused(folder, name):
    archive = zipped(("map.yaml", YAML), ("map.pgm", PICTURE))
    before = set(folder.parent.iterdir())
    reply = run(TARGET, "map_upload", {"name": name, "content": archive})
    if reply["accepted"]:
        assert (folder.parent / "maps" / name / "map.yaml").is_file()
        assert (folder.parent / "maps" / name).resolve().parent == folder.parent / "maps"
    else:
        assert reply["hint"]
    assert set(folder.parent.iterdir()) <= before | {folder.parent / "maps"}


@pytest.mark.parametrize("name", ["", ".", "..", "../inner", "/etc", "a/b", "a\0b", "maps/..", "-x", "\u202eoffice"])
@pytest.mark.parametrize("op", ["map_upload", "map_download", "map_delete", "map_rename", "map_save"])
def test_no_operation_of_a_page_takes_a_name_that_leads_elsewhere(folder, op, name):
    values = {"name": name, "to": name, "content": zipped(("map.yaml", YAML), ("map.pgm", PICTURE))}
    reply = run(TARGET, op, values)
    assert not reply["accepted"]
    assert "is no name of a map" in reply["detail"]
    assert folder.is_dir()


@pytest.mark.parametrize("name", ["..", "../secret.mcap", "/etc/passwd", "a/../../secret.mcap", "", ".", "x\0.mcap"])
def test_no_recording_is_read_or_deleted_by_a_path(folder, name):
    (folder.parent / "recordings").mkdir()
    (folder.parent / "secret.mcap").write_bytes(b"secret")
    for op in ("recording_path", "recording_delete"):
        assert not run(TARGET, op, {"name": name})["accepted"]
    assert (folder.parent / "secret.mcap").exists()


def test_a_link_in_the_recordings_is_not_followed(folder):
    (folder.parent / "recordings").mkdir()
    (folder.parent / "recordings" / "a.mcap").symlink_to("/etc/passwd")
    assert not run(TARGET, "recording_path", {"name": "a.mcap"})["accepted"]


# --- pictures, bags and logs ------------------------------------------------------------------------------------------


def yaml_with(folder: Path, image: str) -> Path:
    (folder / "map.yaml").write_bytes(YAML.replace(b"map.pgm", image.encode()))
    return folder / "map.yaml"


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null", "."])
def test_a_picture_that_is_no_file_is_not_read(folder, device):
    with pytest.raises(UserError, match="is no file"):
        read_ros_map(yaml_with(folder, device))


@pytest.mark.parametrize("side", [9_000, 11_000, 50_000])
def test_a_picture_of_too_many_cells_is_refused_before_it_is_read(folder, side):
    (folder / "map.pgm").write_bytes(f"P5\n{side} {side}\n255\n".encode())
    assert side * side > MAX_PIXELS
    with pytest.raises(UserError, match="too large"):
        read_ros_map(yaml_with(folder, "map.pgm"))


def test_a_picture_that_would_run_a_program_is_none(folder):
    (folder / "map.eps").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
    Image.open(folder / "map.eps").close()  # Pillow would take it
    with pytest.raises(UserError, match="not a whole picture"):
        read_ros_map(yaml_with(folder, "map.eps"))


def test_a_compressed_bag_that_unpacks_without_end_is_refused(folder, monkeypatch):
    monkeypatch.setattr(ros_files, "FREE_BYTES", 1 << 22)
    path = folder / "bag.mcap.zst"
    path.write_bytes(zstandard.compress(bytes(1 << 25)))
    with pytest.raises(UserError, match="unpacks to over 100 times its size"):
        read_bag(path, frozenset())


def test_a_message_that_claims_gigabytes_is_not_unpacked():
    frame = zstandard.compress(b"x" * 100)
    size = struct.pack("<Q", 1 << 40)
    assert ros_files._plain(frame) == b"x" * 100
    bomb = frame[:4] + bytes([0b1110_0000]) + size + frame[6:]
    assert zstandard.frame_content_size(bomb) == 1 << 40
    assert ros_files._plain(bomb) == bomb


def test_a_line_without_an_end_is_read_in_pieces(folder):
    path = folder / "run.log.gz"
    path.write_bytes(gzip.compress(b"x" * (MAX_LINE * 3) + b"\nODOM 1 2 0.5 0.1 0 0 1.5 host 1.5\n"))
    log = read_carmen(path)
    assert len(log.records) == 1


# --- modes ------------------------------------------------------------------------------------------------------------


def test_maps_and_recordings_are_not_for_others(folder):
    grid = OccupancyGrid(0.05)
    grid.apply(update_of_cells(np.zeros((20, 30), np.int8), 0.05, 0.0, 0.0))
    write_map(grid, folder / "maps" / "office")
    with Writer(folder / "run.mcap"):
        pass
    assert stat.S_IMODE((folder / "maps" / "office").stat().st_mode) == 0o750
    for file in [*(folder / "maps" / "office").iterdir(), folder / "run.mcap"]:
        assert stat.S_IMODE(file.stat().st_mode) == 0o640, file
