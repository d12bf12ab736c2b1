# SPDX-License-Identifier: Apache-2.0
"""zenav map over Zenoh: a map is saved from a running mapper, loaded, kept as it is, and started afresh."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from shared import topics
from shared.messages import Localization, MapMode
from tests.stack.processes import running
from tests.unit.services.mapper.maps.test_map_file import made
from zenav.client.map_modes import GRAPH, change_mode, load_map, save_map
from zenav.maps.atomic_folder import SAVED, SAVING
from zenav.maps.saved_map import write_saved_map
from zenav.stack.launch import free_stack

ROOT = Path(__file__).resolve().parents[2]

NAMES = ("sim", "base_driver", "odometry", "mapper", "guard")
pytestmark = pytest.mark.timeout(300)


def test_a_map_is_saved_loaded_and_begun_from_the_start(tmp_path, capsys):
    saved = tmp_path / "room"
    with running(tmp_path, NAMES) as stack:
        where, client = str(stack.where.domain), stack.client
        client.follow(topics.POSE)

        def told(mode: MapMode) -> None:
            def holds() -> bool:
                pose = client.latest(topics.POSE)
                return pose is not None and pose.mode is mode and pose.state is Localization.GOOD

            stack.until(holds)

        told(MapMode.MAP)
        save_map("x80sv", where, str(saved))
        content = (saved / GRAPH).read_bytes()
        files = {path.name for path in saved.iterdir()}
        assert {"map.pgm", "map.yaml", "map.png", GRAPH} <= files
        assert not {SAVED, SAVING} & files
        load_map("x80sv", where, str(saved), MapMode.LOCALISE, (0.1, 0.0, 2.0))
        told(MapMode.LOCALISE)
        save_map("x80sv", where, str(saved))
        assert (saved / GRAPH).read_bytes() == content, "it was left as it is"
        change_mode("x80sv", where, MapMode.CONTINUE, None)
        told(MapMode.CONTINUE)
        change_mode("x80sv", where, MapMode.MAP, None)
        told(MapMode.MAP)
        load_map("x80sv", where, str(saved / "map.yaml"), MapMode.LOCALISE, (0.1, 0.0, 2.0))
        told(MapMode.LOCALISE)
    assert "localise: the robot is at" in capsys.readouterr().out


def test_zenav_up_begins_on_a_saved_map(tmp_path):
    saved = tmp_path / "office"
    write_saved_map(saved, made(0, 5))
    with free_stack() as claim:
        domain = claim.where.domain
    command = [sys.executable, "-m", "zenav", "up", "--world", "room", "--stack", str(domain)]
    command += ["--only", ",".join(NAMES), "--map", str(saved), "--at", "0", "0", "0"]
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=environment) as up:
        killer = threading.Timer(90, up.kill)
        killer.start()
        told = next((line for line in up.stderr if "the mapper has the map" in line), "")
        up.send_signal(signal.SIGINT)
        rest = up.stderr.read()
        killer.cancel()
    assert up.returncode == 0, rest
    assert told.rstrip().endswith(f"{saved}: localise")
