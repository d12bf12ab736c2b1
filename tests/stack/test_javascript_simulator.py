# SPDX-License-Identifier: Apache-2.0
"""A simulator in another language, with its own Zenoh and messages by docs/wire.md: the stack maps its room."""

import shutil
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from tests.stack.test_examples import EXAMPLES, Program
from zenav.client import connect
from zenav.stack.launch import ROOT, free_stack

ROBOT = "turtlebot3_burger"
# of examples/simulator.mjs: x0 y0 x1 y1, m; the map begins at the robot's start, as the room does
BOXES = (
    (-1.5, -2, 3.5, -2), (-1.5, 2, 3.5, 2), (-1.5, -2, -1.5, 2), (3.5, -2, 3.5, 2),
    (1.4, 0.5, 1.9, 1.1), (-0.4, -1.3, 0.1, -0.9),
)  # fmt: skip
MODULES, NODE = ROOT / "web" / "node_modules", shutil.which("node")
pytestmark = [
    pytest.mark.timeout(400),
    pytest.mark.skipif(
        NODE is None or not (MODULES / "@msgpack" / "msgpack").exists(), reason="no Node with @msgpack/msgpack"
    ),
]


@pytest.fixture
def stack(tmp_path) -> Iterator[str]:
    """A stack whose simulator is examples/simulator.mjs: its number."""
    for name in ("simulator.mjs", "wire.mjs", "zenoh_tcp.mjs"):
        shutil.copy(EXAMPLES / name, tmp_path)
    (tmp_path / "node_modules").symlink_to(MODULES)
    with free_stack() as claim:
        domain = claim.where.domain
    page = f"dashboard.port.device=web://127.0.0.1:{9600 + domain}"
    command = [sys.executable, "-m", "zenav", "up", "--robot", ROBOT, "--external", "sim", "--no-browser"]
    up = Program([*command, "--stack", str(domain), "--set", page], tmp_path, domain)
    simulator = None
    try:
        up.until(lambda: up.said("nothing usable comes on"))
        simulator = Program([str(NODE), "simulator.mjs"], tmp_path, domain)
        for words in ("every service runs", "hardware/odometry passes", "scan passes"):
            up.until(lambda words=words: up.said(words), 60)
        yield str(domain)
    finally:
        for program in (simulator, up):
            if program is not None:
                program.end()


def test_the_stack_explores_and_maps_the_room_of_a_simulator_in_javascript(stack):
    with connect(robot=ROBOT, stack=stack) as robot:
        result = robot.explore()
        assert result.good, result.text
        assert robot.pose().state == "good"
        grid = robot.map()
    known = (grid.cells >= 0).sum() * grid.resolution**2
    assert 17 < known < 22, "m^2 of a room of 5 x 4 m with two boxes"
    rows, columns = np.nonzero(grid.cells > 65)
    x, y = grid.x + (columns + 0.5) * grid.resolution, grid.y + (rows + 0.5) * grid.resolution
    errors = np.min([distance_to_outline(x, y, box) for box in BOXES], axis=0)
    assert len(errors) > 300
    assert np.percentile(errors, 95) < 0.08, "m from the walls of the map to those of the room"


def distance_to_outline(x: np.ndarray, y: np.ndarray, box: tuple[float, float, float, float]) -> np.ndarray:
    """(n,) m from points to the outline of a box."""
    x0, y0, x1, y1 = box
    outside = np.hypot(np.maximum(np.maximum(x0 - x, x - x1), 0), np.maximum(np.maximum(y0 - y, y - y1), 0))
    inside = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
    return np.where(outside > 0, outside, np.maximum(inside, 0))
