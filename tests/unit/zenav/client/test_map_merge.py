# SPDX-License-Identifier: Apache-2.0
"""`zenav map merge`: places and zones follow their map; what is not certain is refused, and nothing is written."""

import numpy as np
import pytest

from services.mapper.maps.map_file import SavedMap
from services.mapper.maps.map_merging import MergedMap, joined_graph
from services.mapper.maps.map_overlap import Overlap
from shared.config import UserError
from shared.geometry import Pose2
from tests.unit.zenav.logs import room_log
from zenav.__main__ import _status
from zenav.client import map_merge
from zenav.client.places import PLACES, NamedPlace
from zenav.client.zones import ZONES
from zenav.maps.saved_map import read_saved_map

SHIFT = Pose2(10.0, 4.0, np.pi / 2)
"""red_from_blue."""


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A working folder with the map of a room, under two names."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "room.log").write_text("\n".join(room_log()) + "\n")
    for name in ("red", "blue"):
        assert _status(["slam", str(folder / "room.log"), "--out", str(folder / "maps" / name)]) == 0
    return folder


@pytest.fixture
def maps(mapped, monkeypatch):
    monkeypatch.chdir(mapped)
    return mapped / "maps"


@pytest.fixture
def joined(monkeypatch):
    """Every map is found at SHIFT."""

    def merge_maps(first, second, config, range_max):
        graph = joined_graph(first.graph, second.graph, SHIFT, config.loop_closure.block_size)
        driven = np.concatenate((first.driven, first.driven[-1] + second.driven))
        saved = SavedMap(graph, (*first.keyframes, *second.keyframes), driven, first.tiles)
        return MergedMap(saved, Overlap(SHIFT, (0, 1), (0, 1), 0.0, 9.0), SHIFT, 7)

    monkeypatch.setattr(map_merge, "merge_maps", merge_maps)


def test_places_and_zones_of_both_maps_are_on_the_merged_one(maps, joined, capsys):
    for name, x in (("red", 1.0), ("blue", 2.0)):
        PLACES.write(maps / name, "desk", {"x": x, "y": 0.0, "yaw": 90.0})
    PLACES.write(maps / "blue", "lab", {"x": 1.0, "y": 1.0, "yaw": None})
    ZONES.write(maps / "blue", "stairs", {"corners": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], "speed": None})
    assert _status(["map", "merge", "red", "blue", "--out", "office"]) == 0
    output = capsys.readouterr().out
    assert "blue: at x 10.00 m, y 4.00 m, 90.0 degrees; 2 of 2 common places match, 7 closures" in output
    assert "3 places, 1 zones" in output
    office = PLACES.read(maps / "office")
    assert office["desk"] == NamedPlace(x=1.0, y=0.0, yaw=90.0)
    assert office["desk_blue"] == NamedPlace(x=10.0, y=6.0, yaw=-180.0)
    assert office["lab"] == NamedPlace(x=9.0, y=5.0, yaw=None)
    np.testing.assert_allclose(ZONES.read(maps / "office")["stairs"].corners, [(10, 4), (10, 5), (9, 5)], atol=1e-6)
    merged, red = read_saved_map(maps / "office"), read_saved_map(maps / "red")
    assert len(merged.keyframes) == 2 * len(red.keyframes)
    with pytest.raises(UserError, match="there is a map"):
        map_merge.merge(["red", "blue"], "office", "x80sv", force=False)


def test_a_merged_map_that_takes_another_one_s_place_keeps_none_of_its_zones(maps, joined):
    ZONES.write(maps / "blue", "ramp", {"corners": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]})
    map_merge.merge(["red", "blue"], "floor", "x80sv", force=False)
    ZONES.write(maps / "floor", "old", {"corners": [[5.0, 0.0], [6.0, 0.0], [6.0, 1.0]]})
    PLACES.write(maps / "floor", "old", {"x": 1.0, "y": 0.0, "yaw": None})
    ZONES.remove(maps / "blue", "ramp")
    for name in PLACES.read(maps / "blue"):
        PLACES.remove(maps / "blue", name)
    names = [set(items.read(maps / name)) for name in ("red", "blue") for items in (PLACES, ZONES)]
    map_merge.merge(["red", "blue"], "floor", "x80sv", force=True)
    assert set(PLACES.read(maps / "floor")) | set(ZONES.read(maps / "floor")) == set().union(*names)


def test_one_room_proves_nothing_and_leaves_no_map(maps):
    with pytest.raises(UserError, match="blue is not joined to red") as refused:
        map_merge.merge(["red", "blue"], "both", "x80sv", force=False)
    assert refused.value.hint
    assert not (maps / "both").exists()


@pytest.mark.parametrize("names", [["red"], ["red", "red"]])
def test_a_merge_needs_two_maps(maps, names):
    with pytest.raises(UserError, match="two different maps"):
        map_merge.merge(names, "both", "x80sv", force=False)
