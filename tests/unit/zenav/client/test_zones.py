# SPDX-License-Identifier: Apache-2.0
"""Zones by name, as places: a saved zone is read again beside its map; an invalid one gives an error."""

from contextlib import nullcontext

import numpy as np
import pytest

from shared.config import UserError
from shared.messages import Zone, ZoneKind, Zones
from zenav.__main__ import _status
from zenav.client import zones
from zenav.client.zones import FILE, add_zone, zones_in
from zenav.maps.map_files import MAPS_FOLDER

CHANGE_ACTIVE = zones._change_active


@pytest.fixture(autouse=True)
def nobody_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ZENAV_MAP", raising=False)
    monkeypatch.setattr(zones, "_change_active", lambda *_: None)


def test_what_is_kept_is_listed_and_forgotten_it_is_gone(capsys):
    assert _status(["zones", "add", "stairs", "3,0", "5,0", "5,-2"]) == 0
    assert _status(["zones", "add", "hall", "0,4", "8,4", "8,7", "--speed", "0.3"]) == 0
    assert _status(["zones", "add", "ward", "-1,4", "-3,4", "-3,7", "--percent", "50"]) == 0
    capsys.readouterr()
    assert _status(["zones", "list"]) == 0
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["stairs", "keep", "out", "3,0", "5,0", "5,-2"],
        ["hall", "0.3", "m/s", "0,4", "8,4", "8,7"],
        ["ward", "50", "percent", "-1,4", "-3,4", "-3,7"],
    ]
    stairs, hall, ward = zones_in(MAPS_FOLDER)
    assert [z.kind for z in (stairs, hall, ward)] == [ZoneKind.KEEP_OUT, ZoneKind.SLOW, ZoneKind.SLOW]
    assert np.array_equal(stairs.ys, [0, 0, -2])
    assert _status(["zones", "remove", "hall"]) == 0
    assert [z.name for z in zones_in(MAPS_FOLDER)] == ["stairs", "ward"]
    with pytest.raises(UserError, match="'hall' is no zone"):
        zones.remove_zone("x80sv", "0", "hall", "")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["a", "1,1", "2,2"], "3 to"),
        (["a", "1,1", "2,2", "3"], "no corner"),
        (["a", "1,1", "2,2", "3,3,90"], "no corner"),
        (["a", "0,0", "2,2", "2,0", "0,2.5"], "cross"),
        (["a", "0,0", "2,0", "2,2", "--speed", "1", "--percent", "3"], "not both"),
        (["1a", "0,0", "2,0", "2,2"], "no name for a zone"),
        (["a", "0,0", "2,0", "2,2", "--speed", "-1"], "speed -1.0: Input should be greater"),
    ],
)
def test_what_is_no_zone_is_told_in_one_line_and_nothing_is_written(words, told, capsys):
    assert _status(["zones", "add", *words]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert "hint:" in error
    assert not (MAPS_FOLDER / FILE).exists()


def test_a_file_that_is_wrong_is_told_with_its_line():
    MAPS_FOLDER.mkdir()
    (MAPS_FOLDER / FILE).write_text("a: {corners: [[0, 0], [1, 0], [1, 1]]}\nb: {corners: [[0, 0], [1, 0]]}\n")
    with pytest.raises(UserError, match=r"zones\.yaml:2: b: "):
        zones_in(MAPS_FOLDER)


class FakeStack:
    """A client of a stack that runs, or of none."""

    def __init__(self, runs=True, active=()):
        self.runs, self.given = runs, []
        corners = np.array([0.0, 1.0, 1.0]), np.array([0.0, 0.0, 1.0])
        self.active = [Zone(0, name, ZoneKind.KEEP_OUT, *corners) for name in active]

    def answers(self, request, timeout):
        return self.runs

    def ask(self, request, message):
        from shared.requests import Reply

        self.active = message.zones
        self.given.append([zone.name for zone in message.zones])
        return Reply(0, True, "", "")

    def latched_value(self, topic):
        return Zones(0, tuple(self.active))

    def now(self):
        return 0


def test_one_more_zone_or_less_leaves_those_of_the_loaded_map(monkeypatch):
    """The stack has the map `office`, and the command names none."""
    stack = FakeStack(active=("stairs", "ramp"))
    monkeypatch.setattr(zones, "_change_active", CHANGE_ACTIVE)
    monkeypatch.setattr(zones, "_connected", lambda *_: nullcontext(stack))
    add_zone("x80sv", "0", "hall", zones.zone_of(["0,4", "8,4", "8,7"], 0.3, None), "")
    zones.remove_zone("x80sv", "0", "hall", "")
    add_zone("x80sv", "0", "ramp", zones.zone_of(["0,4", "8,4", "8,7"], None, None), "")
    assert stack.given == [["stairs", "ramp", "hall"], ["stairs", "ramp"], ["stairs", "ramp"]]
    assert [z.name for z in zones_in(MAPS_FOLDER)] == ["ramp"]


def test_with_another_map_its_zones_hold_and_with_a_new_one_none(capsys):
    folder = MAPS_FOLDER / "office"
    folder.mkdir(parents=True)
    (folder / "map.yaml").write_text("{}")
    assert _status(["zones", "add", "stairs", "3,0", "5,0", "5,-2", "--map", "office"]) == 0
    stack = FakeStack()
    zones.follow_map(stack, folder)
    zones.follow_map(stack, None)
    zones.follow_map(stack, MAPS_FOLDER)
    assert stack.given == [["stairs"], [], []]
    zones.follow_map(FakeStack(runs=False), folder)
    assert "no zones hold" in capsys.readouterr().err


def test_what_is_written_is_what_the_stack_is_given():
    text = "# of the first floor\na: {corners: [[0, 0], [1, 0], [1, 1]], percent: 40}\n"
    MAPS_FOLDER.mkdir()
    (MAPS_FOLDER / FILE).write_text(text)
    assert _status(["zones", "add", "b", "0,0", "2,0", "2,2"]) == 0
    assert "# of the first floor" in (MAPS_FOLDER / FILE).read_text()
    held = Zones(0, zones_in(MAPS_FOLDER))
    assert held.problem() is None
    assert [(z.name, z.share) for z in held.zones] == [("a", 0.4), ("b", 1.0)]
