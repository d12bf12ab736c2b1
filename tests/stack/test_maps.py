# SPDX-License-Identifier: Apache-2.0
"""zenav map over Zenoh: a map is saved from a running mapper, given back, left as it is, and begun anew."""

import pytest

from shared import topics
from shared.messages import Localization, MapMode
from tests.stack.processes import running
from zenav.map_modes import GRAPH, change, load, save
from zenav.store import SAVED, SAVING

NAMES = ("sim", "base_driver", "odometry", "mapper", "guard")
pytestmark = pytest.mark.timeout(300)


def test_a_map_is_saved_loaded_and_begun_anew(tmp_path, capsys):
    folder = tmp_path / "room"
    with running(tmp_path, NAMES, settings=("mapper.front_end.window=40",)) as stack:
        where, client = str(stack.where.domain), stack.client
        client.follow(topics.POSE)

        def told(mode: MapMode) -> None:
            def holds() -> bool:
                pose = client.latest(topics.POSE)
                return pose is not None and pose.mode is mode and pose.state is Localization.GOOD

            stack.until(holds)

        told(MapMode.MAP)
        save("x80sv", where, str(folder))
        content = (folder / GRAPH).read_bytes()
        files = {path.name for path in folder.iterdir()}
        assert {"map.pgm", "map.yaml", "map.png", GRAPH} <= files
        assert not {SAVED, SAVING} & files
        load("x80sv", where, str(folder), MapMode.LOCALISE, (0.1, 0.0, 2.0))
        told(MapMode.LOCALISE)
        save("x80sv", where, str(folder))
        assert (folder / GRAPH).read_bytes() == content, "it was left as it is"
        change("x80sv", where, MapMode.CONTINUE, None)
        told(MapMode.CONTINUE)
        change("x80sv", where, MapMode.MAP, None)
        told(MapMode.MAP)
        load("x80sv", where, str(folder / "map.yaml"), MapMode.LOCALISE, None)
        told(MapMode.LOCALISE)
    assert "localise: the robot is at" in capsys.readouterr().out
