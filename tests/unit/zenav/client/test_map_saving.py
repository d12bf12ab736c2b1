# SPDX-License-Identifier: Apache-2.0
"""`zenav map save`: the map in use is saved again under its name; another map of that name is kept unless forced."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from shared.messages import MapState
from shared.reasons import NO_GRAPH
from shared.ros_map import read_ros_map, write_ros_map
from zenav.__main__ import _status
from zenav.client import map_modes
from zenav.client.navigation_client import RequestRefusedError
from zenav.client.places import PLACES
from zenav.client.zones import ZONES
from zenav.maps.map_files import grid_of
from zenav.page.target import PageTarget
from zenav.page.tools import run

RESOLUTION = {"old": 0.1, "new": 0.05}  # m, of the saved and of the present map


@pytest.fixture
def office(tmp_path, monkeypatch) -> Path:
    """maps/office, with a place and a zone; the present map has no name."""
    monkeypatch.chdir(tmp_path)
    for name, place in (("old", "maps/office"), ("new", "present")):
        write_ros_map(Path(place), np.zeros((20, 30), np.int8), RESOLUTION[name], 0.0, 0.0)
    folder = Path("maps/office")
    PLACES.write(folder, "desk", {"x": 1.0, "y": 0.0, "yaw": 90.0})
    ZONES.write(folder, "stairs", {"corners": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], "speed": None})
    present_map(monkeypatch, "")
    return folder


def present_map(monkeypatch, name: str) -> None:
    """A stack whose mapper keeps no graph, and whose map has this name."""

    def fetch_map(client, wait):
        raise RequestRefusedError(NO_GRAPH.code, NO_GRAPH.text, NO_GRAPH.hint)

    client = SimpleNamespace(
        latched_value=lambda topic: MapState(1, 1, name, ()), answers=lambda request, seconds: False
    )
    monkeypatch.setattr(map_modes, "_client", lambda robot, stack: nullcontext(client))
    monkeypatch.setattr(map_modes, "fetch_map", fetch_map)
    monkeypatch.setattr(map_modes, "current_map", lambda client: grid_of(Path("present/map.yaml")))


def saved_resolution(folder: Path) -> float:
    return read_ros_map(folder / "map.yaml")[1]


def test_another_map_of_that_name_is_kept_with_a_hint(office, capsys):
    assert _status(["map", "save", "office"]) != 0
    words = capsys.readouterr().err
    assert "there is another map" in words
    assert "--force" in words
    assert saved_resolution(office) == RESOLUTION["old"]
    assert (list(PLACES.read(office)), list(ZONES.read(office))) == (["desk"], ["stairs"])


def test_a_page_does_not_overwrite_another_map_either(office):
    reply = run(PageTarget("x80sv", "0"), "map_save", {"name": "office"})
    assert not reply["accepted"]
    assert reply["hint"]
    assert saved_resolution(office) == RESOLUTION["old"]


def test_with_force_the_other_maps_places_and_zones_go(office):
    assert _status(["map", "save", "office", "--force"]) == 0
    assert saved_resolution(office) == RESOLUTION["new"]
    assert (PLACES.read(office), ZONES.read(office)) == ({}, {})


@pytest.mark.parametrize("options", [[], ["--force"]])
def test_the_map_in_use_is_saved_again_with_its_places_and_zones(office, monkeypatch, options):
    present_map(monkeypatch, "office")
    assert _status(["map", "save", "office", *options]) == 0
    assert saved_resolution(office) == RESOLUTION["new"]
    assert (list(PLACES.read(office)), list(ZONES.read(office))) == (["desk"], ["stairs"])


def test_a_new_name_and_a_folder_elsewhere_need_no_force(office):
    for place in ("lab", "present"):
        assert _status(["map", "save", place if place == "lab" else "./present"]) == 0
