# SPDX-License-Identifier: Apache-2.0
"""What pages do with maps, places, recordings and settings; and the process that does it."""

import asyncio
import io
import os
import zipfile
from math import pi
from pathlib import Path

import numpy as np
import pytest

from services.dashboard.frames import OPERATIONS as PAGE_OPERATIONS
from services.dashboard.tool_process import ToolProcess
from shared.ros_map import read_ros_map, write_ros_map
from zenav.page.target import PageTarget
from zenav.page.tools import OPERATIONS, run

TARGET = PageTarget("x80sv", "0")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def walls() -> np.ndarray:
    cells = np.zeros((20, 30), np.int8)
    cells[0] = 100
    return cells


def saved(name: str) -> Path:
    write_ros_map(Path("maps") / name, walls(), 0.05, -1.0, -2.0)
    return Path("maps") / name


def done(op: str, **values: object) -> object:
    reply = run(TARGET, op, values)
    assert reply["accepted"], reply
    return reply["data"]


def refused(op: str, **values: object) -> str:
    reply = run(TARGET, op, values)
    assert not reply["accepted"]
    assert reply["hint"]
    return reply["detail"]


def zipped(**files: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name.replace("__", "/").replace("_", "."), data)
    return content.getvalue()


def test_there_is_a_tool_for_each_operation_that_the_core_does_not_do_itself():
    assert set(PAGE_OPERATIONS) - set(OPERATIONS) == {"recording_mark"}
    assert set(OPERATIONS) - set(PAGE_OPERATIONS) == {"map_download", "map_upload", "recording_path"}, "by HTTP"


# --- maps -------------------------------------------------------------------------------------------------------------


def test_maps_are_listed_renamed_and_deleted():
    assert done("maps") == []
    saved("office"), saved("lab")
    (office,) = [row for row in done("maps") if row["name"] == "office"]
    assert office["size"] == sum(file.stat().st_size for file in Path("maps/office").iterdir())
    assert "already" in refused("map_rename", name="office", to="lab")
    done("map_rename", name="office", to="floor")
    assert [row["name"] for row in done("maps")] == ["floor", "lab"]
    done("map_delete", name="floor")
    assert not Path("maps/floor").exists()
    assert "floor" in refused("map_delete", name="floor")


def test_a_folder_beside_maps_is_no_map_of_a_page():
    write_ros_map(Path("office"), walls(), 0.05, 0.0, 0.0)
    assert "office" in refused("map_delete", name="office")
    assert Path("office/map.yaml").exists()


def test_a_map_that_is_downloaded_can_be_uploaded_again():
    saved("office")
    content = done("map_download", name="office")
    assert sorted(zipfile.ZipFile(io.BytesIO(content)).namelist()) == ["office/map.pgm", "office/map.yaml"]
    done("map_upload", name="copy", content=content)
    cells, resolution, x0, y0 = read_ros_map(Path("maps/copy/map.yaml"))
    assert (resolution, x0, y0) == (0.05, -1.0, -2.0)
    assert np.array_equal(cells, walls())
    assert "there is a map" in refused("map_upload", name="copy", content=content)


YAML = b"image: {}\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"x", "no zip file"),
        (zipped(), "0 YAML files"),
        (zipped(a_yaml=b"", b_yaml=b""), "2 YAML files"),
        (zipped(a_yaml=b"\xff"), "YAML"),
        (zipped(a_yaml=YAML.replace(b"{}", b"a.pgm")), "is not in the file"),
        (zipped(a_yaml=YAML.replace(b"{}", b"/etc/hostname"), hostname=b"x"), "is not in the file"),
        (zipped(a_yaml=YAML.replace(b"{}", b"../../x.pgm"), x_pgm=b"x"), "is not in the file"),
        (zipped(a_yaml=YAML.replace(b"{}", b"x.pgm"), x_pgm=b"x"), "x.pgm"),
    ],
)
def test_an_upload_that_is_no_map_is_refused_and_leaves_nothing(content, words):
    assert words in refused("map_upload", name="new", content=content)
    assert not Path("maps/new").exists()


def test_an_upload_that_grows_beyond_the_limit_is_refused(monkeypatch):
    monkeypatch.setattr("zenav.maps.map_archive.MAX_UNPACKED", 1000)
    content = zipped(a_yaml=YAML.replace(b"{}", b"x.pgm"), x_pgm=bytes(2000))
    assert "too large" in refused("map_upload", name="new", content=content)


# --- places -----------------------------------------------------------------------------------------------------------


def test_places_are_kept_with_their_map_or_without_and_have_radians():
    saved("office")
    done("place_set", name="kitchen", pose=[1.0, 2.0, pi / 2], map="office")
    done("place_set", name="dock", pose=[0.0, 0.0, 0.0])
    rows = {row["name"]: row for row in done("places")}
    assert rows["kitchen"] == {"name": "kitchen", "x": 1.0, "y": 2.0, "yaw": pytest.approx(pi / 2), "map": "office"}
    assert rows["dock"]["map"] == ""
    assert [row["name"] for row in done("places", map="office")] == ["kitchen"]
    done("place_delete", name="kitchen", map="office")
    assert [row["name"] for row in done("places")] == ["dock"]
    assert "kitchen" in refused("place_delete", name="kitchen", map="office")


# --- recordings -------------------------------------------------------------------------------------------------------


def test_recordings_are_listed_and_deleted_but_for_the_one_that_is_written():
    Path("recordings").mkdir()
    for name, age in (("a.mcap", 100), ("b.mcap", 0)):
        path = Path("recordings") / name
        path.write_bytes(b"x" * 10)
        then = path.stat().st_mtime - age
        os.utime(path, (then, then))
    Path("recordings/a.mcap.keep").touch()
    rows = {row["name"]: (row["size"], row["marked"], row["current"]) for row in done("recordings")}
    assert rows == {"a.mcap": (10, True, False), "b.mcap": (10, False, True)}
    assert done("recording_path", name="a.mcap") == str(Path("recordings/a.mcap").resolve())
    assert "is being written" in refused("recording_delete", name="b.mcap")
    done("recording_delete", name="a.mcap")
    assert sorted(path.name for path in Path("recordings").iterdir()) == ["b.mcap"]
    assert "no recording" in refused("recording_path", name="a.mcap")


def test_a_link_is_no_recording(tmp_path):
    (tmp_path / "secret").write_text("x")
    Path("recordings").mkdir()
    Path("recordings/a.mcap").symlink_to(tmp_path / "secret")
    assert "no recording" in refused("recording_path", name="a.mcap")


# --- settings, faults, process ----------------------------------------------------------------------------------------


def test_settings_have_their_value_origin_and_description():
    target = PageTarget("x80sv", "0", ("guard.field.reaction=0.2",))
    rows = {row["name"]: row for row in run(target, "settings", {})["data"]}
    assert rows["guard.field.reaction"]["value"] == 0.2
    assert rows["guard.field.reaction"]["origin"] == "--set"
    assert rows["robot.drive.max_speed"]["description"] == "m/s forward"
    assert "x80sv.yaml" in rows["robot.drive.max_speed"]["origin"]
    assert rows["dashboard.tools"]["origin"] == "default"


def test_a_fault_of_a_tool_is_a_refusal_and_the_process_goes_on(capsys):
    assert "KeyError" in refused("map_delete")
    assert "KeyError" in refused("fly")
    assert "Traceback" in capsys.readouterr().err


def test_the_process_works_for_the_page_s_server_and_ends_with_it():
    saved("office")

    async def work() -> tuple[list[dict[str, object]], int | None]:
        tools = ToolProcess("zenav.page.tools", ("--robot", "x80sv", "--stack", "0"))
        replies = [await tools.run(op, {}) for op in ("maps", "fly", "places")]
        process = tools._process
        assert process is not None
        process.stdin.close()
        return replies, await asyncio.wait_for(process.wait(), 20)

    replies, status = asyncio.run(work())
    assert [reply["accepted"] for reply in replies] == [True, False, True]
    assert [row["name"] for row in replies[0]["data"]] == ["office"]
    assert status == 0
