# SPDX-License-Identifier: Apache-2.0
"""zenav map wall over Zenoh: after the mapper was killed, the wall is there again."""

import os
import signal

import pytest

from shared import topics
from shared.messages import Localization, MapMode
from shared.types import NS_PER_S
from tests.stack.processes import running
from zenav.__main__ import _status
from zenav.client.map_modes import change_mode, save_map
from zenav.maps.saved_map import read_saved_map

NAMES = ("sim", "base_driver", "odometry", "mapper", "guard")
pytestmark = pytest.mark.timeout(300)


def test_a_wall_drawn_by_command_survives_a_killed_mapper(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with running(tmp_path / "logs", NAMES) as stack:
        where, client = str(stack.where.domain), stack.client
        client.follow(topics.POSE, topics.MAP_STATE)
        stack.until(lambda: client.latest(topics.POSE) and client.latest(topics.POSE).state is Localization.GOOD)
        save_map("x80sv", where, "room")
        stack.until(lambda: client.latched_value(topics.MAP_STATE).name == "room")
        assert _status(["map", "wall", "0.5,0.2", "0.5,-0.3", "--stack", where]) == 0
        assert "1   wall" in capsys.readouterr().out
        change_mode("x80sv", where, MapMode.LOCALISE, None)
        stack.until(lambda: client.latest(topics.POSE).mode is MapMode.LOCALISE)
        os.kill(stack.pid("mapper"), signal.SIGKILL)
        killed = client.now()
        stack.until(lambda: client.latest(topics.POSE).stamp > killed + NS_PER_S, 60.0)
        stack.until(lambda: client.latched_value(topics.MAP_STATE) is not None)
        state = client.latched_value(topics.MAP_STATE)
        assert (state.name, [edit.kind for edit in state.edits]) == ("room", ["wall"])
        assert client.latest(topics.POSE).mode is MapMode.LOCALISE
        save_map("x80sv", where, "again")
    again = read_saved_map(tmp_path / "maps" / "again")
    assert [edit.kind for edit in again.edits] == ["wall"]
    assert (again.tiles.cells >= 97).sum() == 0, "below the wall is what the laser saw"
    assert len(again.keyframes) > 0
