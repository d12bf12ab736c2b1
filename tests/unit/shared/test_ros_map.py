# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal
from PIL import Image

from shared.config import UserError
from shared.ros_map import read_ros_map, ros_map_files, write_ros_map

SETTINGS = {
    "image": "map.pgm",
    "resolution": 0.1,
    "origin": "[-1.5, 2.0, 0.0]",
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
GREYS = np.array([[0, 254, 205], [89, 206, 255]], np.uint8)


def saved(folder, greys=GREYS, name="map.pgm", **changes):
    Image.fromarray(greys).save(folder / name)
    lines = [f"{key}: {value}" for key, value in {**SETTINGS, **changes}.items() if value is not None]
    (folder / "map.yaml").write_text("\n".join(lines) + "\n")
    return folder / "map.yaml"


@settings(max_examples=30)
@given(
    arrays(np.int8, st.tuples(st.integers(1, 30), st.integers(1, 30)), elements=st.sampled_from([-1, 0, 100])),
    st.floats(0.01, 1).map(lambda v: round(v, 4)),
    st.floats(-100, 100).map(lambda v: round(v, 3)),
    st.floats(-100, 100).map(lambda v: round(v, 3)),
)
def test_what_is_written_is_read(tmp_path_factory, cells, resolution, x0, y0):
    folder = tmp_path_factory.mktemp("map")
    found, *place = read_ros_map(write_ros_map(folder, cells, resolution, x0, y0))
    assert_array_equal(found, cells)
    assert found.dtype == np.int8
    assert place == [resolution, x0, y0]
    assert sorted(path.name for path in folder.iterdir()) == ["map.pgm", "map.yaml"]


def test_what_is_neither_free_nor_occupied_becomes_unknown(tmp_path):
    cells = np.array([[0, 25, 26, 50, 64, 65, 100, -1]], np.int8)
    found, *_ = read_ros_map(write_ros_map(tmp_path, cells, 0.05, 0, 0))
    assert_array_equal(found, [[0, 0, -1, -1, -1, 100, 100, -1]])


def test_the_pictures_first_row_is_the_top(tmp_path):
    cells = np.array([[0, 0], [100, -1]], np.int8)  # row 0 is the lowest y
    write_ros_map(tmp_path, cells, 0.05, 0, 0)
    assert_array_equal(np.asarray(Image.open(tmp_path / "map.pgm")), [[0, 205], [254, 254]])


def test_thresholds_and_greys_are_map_servers(tmp_path):
    """205 (map_saver's grey for unknown) is 0.196 occupied, between the thresholds; 89 is 0.651."""
    found, *place = read_ros_map(saved(tmp_path))
    assert_array_equal(found, [[100, 0, 0], [100, 0, -1]][::1])
    assert place == [0.1, -1.5, 2.0]


def test_a_negated_picture_is_the_same_map(tmp_path):
    found, *_ = read_ros_map(saved(tmp_path, 255 - GREYS, negate=1))
    assert_array_equal(found, [[100, 0, 0], [100, 0, -1]])


def test_scale_grades_and_raw_takes_the_numbers(tmp_path):
    greys = np.array([[0, 255, 148]], np.uint8)
    assert_array_equal(read_ros_map(saved(tmp_path, greys, mode="scale"))[0], [[100, 0, 48]])
    raw = np.array([[0, 100, 255, 42]], np.uint8)
    assert_array_equal(read_ros_map(saved(tmp_path, raw, mode="raw"))[0], [[0, 100, -1, 42]])


def test_a_transparent_png_is_unknown_where_one_sees_through_in_scale_mode(tmp_path):
    picture = np.array([[[128, 128, 128, 0], [0, 0, 0, 255]]], np.uint8)
    found, *_ = read_ros_map(saved(tmp_path, picture, "map.png", image="map.png", mode="scale"))
    assert_array_equal(found, [[-1, 100]])


def test_a_picture_of_sixteen_bits_has_the_same_greys(tmp_path):
    deep = GREYS.astype(np.uint16) * 257
    found, *_ = read_ros_map(saved(tmp_path, deep, "map.png", image="map.png"))
    assert_array_equal(found, read_ros_map(saved(tmp_path))[0])
    (tmp_path / "map.pgm").write_bytes(b"P5\n3 2\n65535\n" + deep.astype(">u2").tobytes())
    assert_array_equal(read_ros_map(tmp_path / "map.yaml")[0], found)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image": "elsewhere.pgm"}, "there is no picture"),
        ({"resolution": 0}, "resolution"),
        ({"resolution": -0.05}, "resolution"),
        ({"resolution": ".nan"}, "resolution"),
        ({"resolution": 1e-300}, "resolution"),
        ({"resolution": "big"}, "must be numbers"),
        ({"origin": "[1.0e12, 0, 0]"}, "too far away"),
        ({"resolution": "1" + "0" * 400}, "must be numbers"),
        ({"negate": ".inf"}, "must be numbers"),
        ({"origin": "[0, 0]"}, "must be numbers"),
        ({"origin": "[0, 0, 0.5]"}, "turned"),
        ({"free_thresh": 0.9}, "free_thresh"),
        ({"occupied_thresh": None}, "occupied_thresh"),
        ({"mode": "grey"}, "mode grey"),
    ],
)
def test_a_yaml_that_makes_no_sense_is_refused_with_a_hint(tmp_path, changes, says):
    with pytest.raises(UserError, match=says) as error:
        read_ros_map(saved(tmp_path, **changes))
    assert error.value.hint


def test_a_yaml_that_is_not_there_and_a_picture_that_is_cut_are_refused(tmp_path):
    with pytest.raises(UserError, match="cannot read"):
        read_ros_map(tmp_path / "nothing.yaml")
    path = saved(tmp_path, np.zeros((50, 50), np.uint8))
    (tmp_path / "map.pgm").write_bytes((tmp_path / "map.pgm").read_bytes()[:200])
    with pytest.raises(UserError, match="not a whole picture"):
        read_ros_map(path)


def test_a_picture_whose_path_the_system_refuses_is_refused_with_a_hint(tmp_path):
    with pytest.raises(UserError, match="not a whole picture") as error:
        read_ros_map(saved(tmp_path, image="x" * 5000))
    assert error.value.hint


def test_a_write_that_fails_leaves_the_old_map_whole(tmp_path, monkeypatch):
    path = write_ros_map(tmp_path, np.zeros((3, 3), np.int8), 0.05, 0, 0)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(UserError, match="No space left"):
        write_ros_map(tmp_path, np.full((3, 3), 100, np.int8), 0.05, 0, 0)
    assert_array_equal(read_ros_map(path)[0], np.zeros((3, 3)))
    assert len(list(tmp_path.iterdir())) == 2


percents = arrays(np.int8, st.tuples(st.integers(1, 30), st.integers(1, 30)), elements=st.integers(-1, 100))


@settings(max_examples=30)
@given(percents, st.sampled_from(["scale", "raw"]), st.booleans())
def test_scale_and_raw_keep_every_percent(tmp_path_factory, cells, mode, negate):
    folder = tmp_path_factory.mktemp("map")
    for name, content in ros_map_files(cells, 0.05, -1.0, 2.0, mode=mode, negate=negate).items():
        (folder / name).write_bytes(content)
    found, *place = read_ros_map(folder / "map.yaml")
    assert_array_equal(found, np.where(cells == 99, 98, cells) if mode == "scale" else cells)
    assert place == [0.05, -1.0, 2.0]


@settings(max_examples=20)
@given(percents)
def test_a_negated_map_reads_as_the_same_map(tmp_path_factory, cells):
    plain, negated = tmp_path_factory.mktemp("plain"), tmp_path_factory.mktemp("negated")
    for folder, negate in ((plain, False), (negated, True)):
        for name, content in ros_map_files(cells, 0.05, 0, 0, negate=negate).items():
            (folder / name).write_bytes(content)
    assert_array_equal(read_ros_map(plain / "map.yaml")[0], read_ros_map(negated / "map.yaml")[0])
    assert (plain / "map.pgm").read_bytes() != (negated / "map.pgm").read_bytes()
