# SPDX-License-Identifier: Apache-2.0
"""Places by name: a saved place is read again, beside a map or in a file of its own; an invalid one gives an error."""

import json

import pytest

from shared.config import UserError
from zenav.__main__ import _status
from zenav.client.places import FILE, dwell_times, goal_from, place_at, read
from zenav.maps.map_files import MAPS_FOLDER


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ZENAV_MAP", raising=False)


def test_what_is_kept_is_a_goal_by_its_name_and_forgotten_it_is_none(capsys):
    assert _status(["places", "save", "kitchen", "3.5", "-1.2", "90"]) == 0
    assert _status(["places", "save", "lab-2", "0", "2"]) == 0
    assert _status(["places", "save", "kitchen", "3.5", "-1.25", "90"]) == 0
    assert "no longer what it was" in capsys.readouterr().out
    assert goal_from(["kitchen"], "") == (3.5, -1.25, 90.0)
    assert goal_from(["lab-2"], "") == (0.0, 2.0, None)
    assert _status(["places", "list"]) == 0
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["kitchen", "3.5", "-1.25", "90"],
        ["lab-2", "0", "2"],
    ]
    assert _status(["places", "list", "--json"]) == 0
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [
        {"name": "kitchen", "x": 3.5, "y": -1.25, "yaw": 90.0},
        {"name": "lab-2", "x": 0.0, "y": 2.0, "yaw": None},
    ]
    assert _status(["places", "remove", "kitchen"]) == 0
    with pytest.raises(UserError, match="'kitchen' is no pose and no place"):
        goal_from(["kitchen"], "")
    assert _status(["places", "remove", "lab-2"]) == 0
    assert read(MAPS_FOLDER) == {}
    assert _status(["places", "list"]) == 0
    assert "zenav places save" in capsys.readouterr().err


def test_the_places_of_a_map_lie_beside_it_and_are_its_own():
    folder = MAPS_FOLDER / "office"
    folder.mkdir(parents=True)
    (folder / "map.yaml").write_text("{}")
    assert _status(["places", "save", "desk", "1", "2", "--map", "office"]) == 0
    assert (folder / FILE).is_file()
    assert goal_from(["desk"], "office") == (1.0, 2.0, None)
    with pytest.raises(UserError, match="'desk'"):
        goal_from(["desk"], "")


def test_a_person_s_comments_in_the_file_stay():
    MAPS_FOLDER.mkdir()
    (MAPS_FOLDER / FILE).write_text("# of the ground floor\nkitchen: {x: 1, y: 2} # by the window\n")
    assert _status(["places", "save", "lab", "3", "4", "-90"]) == 0
    text = (MAPS_FOLDER / FILE).read_text()
    assert "# of the ground floor" in text
    assert "# by the window" in text
    assert list(read(MAPS_FOLDER)) == ["kitchen", "lab"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("kitchen: {x: 1}", r"places\.yaml:1: kitchen\.y"),
        ("lab: {x: 1, y: 2}\nkitchen: {x: 1, y: 2, yw: 3}", r"places\.yaml:2: kitchen\.yw is not a setting"),
        ("kitchen: 3", "not a section"),
        ("kitchen: {x: [", "not valid YAML"),
        ("- kitchen", "mapping"),
    ],
)
def test_a_file_that_is_wrong_is_told_with_its_line(text, words):
    MAPS_FOLDER.mkdir()
    (MAPS_FOLDER / FILE).write_text(text)
    with pytest.raises(UserError, match=words):
        goal_from(["kitchen"], "")


def test_a_file_that_was_emptied_has_no_places():
    MAPS_FOLDER.mkdir()
    (MAPS_FOLDER / FILE).write_text("\n")
    assert read(MAPS_FOLDER) == {}
    assert _status(["places", "save", "lab", "3", "4"]) == 0
    assert list(read(MAPS_FOLDER)) == ["lab"]


def test_a_mistyped_name_names_the_nearest():
    assert _status(["places", "save", "kitchen", "1", "2"]) == 0
    with pytest.raises(UserError) as error:
        goal_from(["kichen"], "")
    assert "`kitchen`" in error.value.hint


def test_a_route_mixes_poses_and_places_each_with_its_stay():
    assert _status(["places", "save", "kitchen", "1", "2"]) == 0
    assert dwell_times(["3,-4", "kitchen@5", " -1,0@0"], 2.0, "") == (
        [(3.0, -4.0, None), (1.0, 2.0, None), (-1.0, 0.0, None)],
        (2.0, 5.0, 0.0),
    )
    assert dwell_times(["3,-4", "kitchen"], 2.0, "")[1] == ()


def test_a_place_is_within_a_map():
    with pytest.raises(UserError, match="no place on a map"):
        place_at(1e9, 0.0, None)
