# SPDX-License-Identifier: Apache-2.0
from math import hypot, pi

import numpy as np
import pytest
from numpy.testing import assert_allclose

from services.sim.rays import cast_ray
from services.sim.world_loader import load_world
from shared.config import UserError
from shared.geometry import Pose2
from tests.unit.services.sim.scenes import simulator, written

SQUARE = "walls:\n  - points: [[0, 0], [4, 0], [4, 4], [0, 4]]\n    closed: true\n"


def test_walls_have_thickness_square_corners_and_doors(tmp_path):
    world = load_world(str(written(tmp_path, SQUARE + "    thickness: 0.2\n    doors: [{at: [2, 0], width: 1}]\n")))
    inside = {"up": (0, 1), "left": (-1, 0), "right": (1, 0)}
    for c, s in inside.values():
        assert_allclose(cast_ray(world.cells, 2.0, 2.0, c, s, 9.0), 1.9)
    assert cast_ray(world.cells, 2.0, 2.0, 0.0, -1.0, 9.0) == np.inf
    assert_allclose(cast_ray(world.cells, 1.49, 2.0, 0.0, -1.0, 9.0), 1.9)
    assert_allclose(cast_ray(world.cells, -5.0, -5.0, 0.5**0.5, 0.5**0.5, 20.0), 4.9 * 2**0.5)
    assert world.bounds == pytest.approx((-0.1, -0.1, 4.1, 4.1))


def test_the_raster_is_every_cell_into_which_something_reaches(tmp_path):
    things = "boxes: [{x: 1, y: 1, size: [0.02, 0.02]}]\ncylinders: [{x: 3, y: 3, radius: 0.3}]\nstart: {x: 2, y: 2}\n"
    world = load_world(str(written(tmp_path, SQUARE + things)))
    occupied, x0, y0 = world.occupied(0.05)
    assert (x0, y0) == pytest.approx((-0.05, -0.05))
    assert occupied.shape == (82, 82)
    assert occupied[:2].all()
    assert not occupied[2, 2:-2].any()
    assert occupied[20:22, 20:22].all()  # the box lies on a corner of four cells
    assert_allclose(occupied[50:75, 50:75].sum() * 0.0025, pi * 0.3**2, rtol=0.25)
    reached, _, _ = world.reachable(0.05, 0.2)
    assert reached[40, 40]
    assert not (reached & occupied).any()
    assert reached.sum() > 0.9 * (~occupied).sum() - 200


def test_what_lies_behind_a_narrow_door_is_not_reachable(tmp_path):
    def world(width):
        wall = f"  - {{points: [[2, 0], [2, 4]], doors: [{{at: [2, 2], width: {width}}}]}}\n"
        return load_world(str(written(tmp_path, SQUARE + wall + "start: {x: 1, y: 1}\n")))

    for width, through in ((0.9, True), (0.3, False)):
        reached, x0, y0 = world(width).reachable(0.05, 0.217)
        assert reached[int((1 - y0) / 0.05), int((3 - x0) / 0.05)] == through


def test_outlines_enclose_what_is_solid():
    world = load_world("room")
    ends = world.outline()
    low_x, _, _, high_y = world.bounds
    assert ends.shape[1] == 4
    assert ends[:, ::2].min() == pytest.approx(low_x)
    assert ends[:, 1::2].max() == pytest.approx(high_y)


def test_loose_things_move_with_the_seed_and_others_stay(tmp_path):
    text = (
        "start: {x: 0, y: 0}\nboxes:\n  - {x: 2, y: 0, size: [0.4, 0.4], loose: true}\n  - {x: 5, y: 0, size: [1, 1]}\n"
        "cylinders: [{x: 0, y: 3, radius: 0.2, loose: true}]\n"
    )
    path = str(written(tmp_path, text))
    worlds = [load_world(path, seed, jitter=0.2) for seed in range(10)]
    places = np.array([w.polygons[0].mean(axis=0) for w in worlds])
    assert len(np.unique(places, axis=0)) == 10
    assert np.abs(places - (2, 0)).max() <= 0.2
    assert all(np.array_equal(w.polygons[1], worlds[0].polygons[1]) for w in worlds)
    assert np.array_equal(load_world(path, 3, 0.2).circles, worlds[3].circles)
    assert load_world(path, 3, 0.0).circles.tolist() == [[0, 3, 0.2]]


def test_loose_things_leave_routes_goals_and_the_start_free(tmp_path):
    text = (
        "start: {x: 0, y: 0}\ncylinders:\n  - {x: 0.75, y: 0, radius: 0.2, loose: true}\n"
        "  - {x: 3, y: 0.5, radius: 0.2, loose: true}\npeople: [{route: [[1, 0], [5, 0]]}]\n"
    )
    path = str(written(tmp_path, text.replace("[1, 0]", "[1.4, 0]")))
    for seed in range(30):
        circles = load_world(path, seed, jitter=0.4).circles
        assert hypot(*circles[0, :2]) >= 0.7
        assert circles[1, 1] >= 0.46


BAD = [
    ("walls:\n  - {points: [[0, 0], [1, 0]], thicknes: 1}\n", ":2: walls.0.thicknes is not a setting", "thickness"),
    ("wall: []\n", ":1: wall is not a setting", "`walls`"),
    (SQUARE + "    doors:\n      - {at: [1, 1]}\n", ":5: the door", "middle line"),
    (SQUARE + "    doors:\n      - {at: [0.2, 0]}\n", ":5: the door", "corners"),
    ("cylinders:\n  - {x: 0, y: 0, radius: -1}\n", ":2: cylinders.0.radius", "m"),
    ("boxes:\n  - {x: 0, y: 0, size: [1, 0]}\n", ":2: boxes.0", "over 0"),
    (
        SQUARE + "people:\n  - route: [[1, 1], [3, 3]]\n  - route:\n      - [1, 1]\n      - [6, 1]\n",
        ":7: the way",
        "free",
    ),
    ("goals:\n  - {name: a, x: 1, y: 1}\n  - {name: a, x: 2, y: 1}\n", ":3: a second goal 'a'", "own name"),
    ("walls: [[\n", ": not valid YAML", ""),
    ("built: 2001-99-99\n", ": not valid YAML", "month must be in 1..12"),
    ("- 1\n", "not a mapping", ""),
    ("start: {x: .nan, y: 0}\n", ":1: start.x", ""),
    ("bounds: [4, 3, 0, 0]\n", "bounds: low x, low y, high x, high y", ""),
    ("bounds: [0, 0, 0, 3]\n", "bounds: low x, low y, high x, high y", ""),
    ("map: nowhere.yaml\n", "nowhere.yaml", ""),
]


@pytest.mark.parametrize(("text", "what", "hint"), BAD)
def test_a_bad_world_is_told_with_its_line_and_its_hint(tmp_path, text, what, hint):
    path = written(tmp_path, text)
    with pytest.raises(UserError) as error:
        load_world(str(path))
    assert what in error.value.what
    assert hint in error.value.hint or hint in error.value.what
    assert error.value.hint


def test_a_robot_that_starts_in_a_wall_or_inside_a_box_is_refused(tmp_path):
    path = written(tmp_path, SQUARE + "boxes: [{x: 2, y: 2, size: [1.5, 1.5]}]\nstart: {x: 0.1, y: 1}\n")
    with pytest.raises(UserError, match="does not fit at its start"):
        simulator(path)
    with pytest.raises(UserError, match="does not fit at its start"):
        simulator(path, start={"x": 2, "y": 2})
    assert simulator(path, start={"x": 0.6, "y": 0.6, "yaw": 1.0}).world.start == Pose2(0.6, 0.6, 1.0)
