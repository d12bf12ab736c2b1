# SPDX-License-Identifier: Apache-2.0
import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from services.sim.rays import cast_ray
from services.sim.world_loader import load_world
from shared.config import UserError
from shared.geometry import Pose2
from tests.unit.services.sim.scenes import JACKAL, drive, simulator, told, written

needs_data = pytest.mark.skipif("ZENAV_DATA" not in os.environ, reason="ZENAV_DATA is not set")  # noqa: TID251
MAP = "image: m.pgm\nresolution: 0.1\norigin: [-1, -2, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
CYLINDERS = {
    "cylinder_radius_m": 0.1,
    "start": [0, 0, 1.57],
    "goal": [0, 5],
    "worlds": {"1": {"cylinders": [[1, 0], [-1, 0], [0, 2]], "optimal_length_m": 5.2}, "7": {"cylinders": []}},
}


def ros_map(folder, text=MAP):
    """12 x 10 cells: free inside a border of occupied ones, one occupied and one unknown in the middle."""
    image = np.full((10, 12), 254, np.uint8)
    image[0], image[-1], image[:, 0], image[:, -1] = 0, 0, 0, 0
    image[2, 4], image[7, 9] = 0, 205  # from the top
    Image.fromarray(image).save(folder / "m.pgm")
    return str(written(folder, text, "m.yaml"))


def test_a_ros_map_lies_where_its_origin_says_with_its_first_row_on_top(tmp_path):
    world = load_world(ros_map(tmp_path))
    assert world.bounds == pytest.approx((-1, -2, 0.2, -1))
    solid, x0, y0 = world.occupied(0.1)
    assert (x0, y0) == pytest.approx((-1, -2))
    assert solid.sum() == 2 * 12 + 2 * 8 + 2
    assert solid[7, 4]
    assert solid[2, 9]
    assert_allclose(cast_ray(world.cells, -0.85, -1.25, 1.0, 0.0, 9.0), 0.25)
    assert_allclose(cast_ray(world.cells, -0.85, -1.85, 1.0, 0.0, 9.0), 0.95)


def test_a_small_map_without_a_start_starts_at_its_freest_place(tmp_path):
    world = load_world(ros_map(tmp_path))
    occupied, x0, y0 = world.occupied(0.1)
    rows, columns = np.nonzero(occupied)
    solid = np.column_stack((x0 + (columns + 0.5) * 0.1, y0 + (rows + 0.5) * 0.1))
    free = np.column_stack(np.nonzero(~occupied))[:, ::-1] * 0.1 + (x0 + 0.05, y0 + 0.05)
    room = [np.hypot(*(solid - p).T).min() for p in free]
    assert_allclose(np.hypot(*(solid - (world.start.x, world.start.y)).T).min(), max(room))
    assert load_world(ros_map(tmp_path), start=Pose2(-0.5, -1.5, 1.0)).start == Pose2(-0.5, -1.5, 1.0)


def test_a_world_may_stand_on_a_ros_map(tmp_path):
    ros_map(tmp_path)
    world = load_world(
        str(written(tmp_path, "map: m.yaml\nstart: {x: -0.5, y: -1.5}\ncylinders: [{x: 1, y: 0, radius: 0.2}]"))
    )
    assert world.bounds == pytest.approx((-1, -2, 1.2, 0.2))
    assert_allclose(cast_ray(world.cells, -0.85, -1.25, 1.0, 0.0, 9.0), 0.25)
    assert_allclose(cast_ray(world.cells, 1.0, -2.0, 0.0, 1.0, 9.0), 1.8)


def test_a_list_of_cylinders_gives_its_worlds_by_number(tmp_path):
    for name, content in (("w.json", json.dumps(CYLINDERS).encode()), ("w.json.gz", None)):
        (tmp_path / name).write_bytes(content or gzip.compress(json.dumps(CYLINDERS).encode()))
        world = load_world("barn:1", barn_file=str(tmp_path / name))
        assert world.start == Pose2(0, 0, 1.57)
        assert world.goals["goal"].y == 5
        assert_allclose(cast_ray(world.cells, 0.0, 0.0, 0.0, 1.0, 9.0), 1.9)
    assert load_world("barn:7", barn_file=str(tmp_path / "w.json")).circles.shape == (0, 3)


def test_what_is_missing_or_broken_is_told_with_its_hint(tmp_path):
    (tmp_path / "w.json").write_text(json.dumps(CYLINDERS))
    (tmp_path / "half.json.gz").write_bytes(gzip.compress(b"{}" * 99)[:20])
    (tmp_path / "no.json.gz").write_bytes(b"no gzip")
    (tmp_path / "damaged.json.gz").write_bytes(gzip.compress(b"{}" * 99)[:10] + b"\xff" * 20)
    (tmp_path / "list.json").write_text("[]")
    cases = [
        ("ofice", "", "did you mean `office`"),
        ("nowhere.yaml", "", "known"),
        ("barn:1", "", "barn_file"),
        ("barn:2", "w.json", "1"),
        ("barn:1", "w", "barn_file"),
        ("barn:1", "half.json.gz", ""),
        ("barn:1", "no.json.gz", ""),
        ("barn:1", "damaged.json.gz", ""),
        ("barn:1", "list.json", ""),
        (ros_map(tmp_path, MAP.replace("m.pgm", "x.pgm")), "", ""),
        (ros_map(tmp_path, MAP.replace("-2, 0]", "-2, 1]")), "", ""),
    ]
    for world, file, hint in cases:
        with pytest.raises(UserError) as error:
            load_world(world, barn_file=str(tmp_path / file) if file else "")
        assert hint in error.value.hint
        assert error.value.hint


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("bounds: [0, 0, 1.0e6, 1.0e6]", "limit is 5000 m"),
        ("boxes: [{x: 0, y: 0, size: [1, 1]}, {x: 1.0e9, y: 0, size: [1, 1]}]", "limit is 5000 m"),
        ("bounds: [0, 0, 4000, 4000]", "too large to look for a start"),
    ],
)
def test_a_world_that_no_memory_holds_is_refused(tmp_path, text, words):
    with pytest.raises(UserError, match=words):
        load_world(str(written(tmp_path, text)))


@needs_data
def test_the_barn_worlds_hold_the_jackal_at_their_start_and_goal():
    file = Path(os.environ["ZENAV_DATA"]) / "barn" / "barn_worlds.json.gz"  # noqa: TID251
    for number in (1, 17, 299):
        service = simulator(f"barn:{number}", JACKAL, barn_file=str(file))
        truth = told(drive(service, 1.0, 0.5, 0.0), "sim/truth")[-1]
        assert truth.n_contacts == 0
        assert service.world.reachable(0.05, 0.2)[0].any()


@needs_data
@pytest.mark.parametrize("name", ["willow_garage", "depot", "turtlebot3_world"])
def test_real_maps_can_be_driven_in(name):
    path = Path(os.environ["ZENAV_DATA"]) / "planning" / "ros_maps" / f"{name}.yaml"  # noqa: TID251
    service = simulator(path)
    messages = list(drive(service, 1.0, 0.2, 0.0))
    assert told(messages, "sim/truth")[-1].distance > 0.1
    assert np.isfinite(told(messages, "scan")[-1].ranges).mean() > 0.3
