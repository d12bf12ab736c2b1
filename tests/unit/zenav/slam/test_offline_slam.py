# SPDX-License-Identifier: Apache-2.0
import gzip
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from services.mapper.config import MapperConfig
from shared.codec import decode
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import Odometry
from shared.recording import Recording
from shared.ros_map import read_ros_map
from tests.unit.zenav.logs import room_log
from zenav.__main__ import _status
from zenav.maps.saved_map import read_saved_map, write_saved_map
from zenav.slam.offline_slam import offline_slam


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "room.log"
    path.write_text("\n".join(room_log()) + "\n")
    return path


def poses_of(folder):
    rows = np.loadtxt(folder / "trajectory.tum")
    return rows[:, 0], np.column_stack((rows[:, 1], rows[:, 2], 2 * np.arctan2(rows[:, 6], rows[:, 7])))


def test_a_log_becomes_a_trajectory_a_map_a_picture_and_a_report(log, tmp_path):
    shares = []
    report = offline_slam(log, tmp_path / "out", shares.append)
    stamps, poses = poses_of(tmp_path / "out")
    assert len(stamps) == 80
    assert stamps[0] == pytest.approx(99.9)
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    cells, resolution, _, _ = read_ros_map(tmp_path / "out" / "map.yaml")
    assert resolution == 0.05
    assert (cells == 100).sum() > 200
    assert (cells == 0).sum() > 5000
    with Image.open(tmp_path / "out" / "map.png") as picture:
        assert min(picture.size) > 100
    assert report == json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["scans"], report["scans_placed"], report["bad_lines"]) == (40, 40, 0)

    true = [Pose2()]
    for _ in range(39):
        true.append(true[-1] @ Pose2(0.06, 0, 0.1))
    found = [Pose2(*row) for row in poses[stamps > 99.95][::2]]  # at the scans
    error = [(found[0].inverse() @ b).distance(true[0].inverse() @ a) for a, b in zip(true, found)]
    assert max(error) < 0.03


def test_a_recording_s_trajectory_is_in_the_order_of_time_and_as_long_as_the_drive(tmp_path):
    recording = Path(__file__).parents[3] / "replay" / "recordings" / "driving.mcap"
    report = offline_slam(recording, tmp_path)
    stamps, _ = poses_of(tmp_path)
    assert (np.diff(stamps) >= 0).all()
    odometry = [decode(Odometry, e.payload)[0].odom_from_base for e in Recording(recording).entries(["odom"])]
    driven = sum(a.distance(b) for a, b in pairwise(odometry))
    assert report["length_m"] == pytest.approx(driven, rel=0.05)


def test_the_same_log_gives_the_same_bytes_twice(log, tmp_path):
    for name in ("a", "b"):
        offline_slam(log, tmp_path / name)
    for name in ("trajectory.tum", "map.pgm", "map.yaml", "map.png", "graph.msgpack"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_its_map_loads_and_is_saved_again_to_the_same_bytes(log, tmp_path):
    report = offline_slam(log, tmp_path / "out")
    saved = read_saved_map(tmp_path / "out")
    assert len(saved.keyframes) == report["keyframes"] > 3
    write_saved_map(tmp_path / "again", saved)
    write_saved_map(tmp_path / "third", read_saved_map(tmp_path / "again"))
    for name in ("map.pgm", "map.yaml", "graph.msgpack"):
        content = (tmp_path / "out" / name).read_bytes()
        assert content == (tmp_path / "again" / name).read_bytes() == (tmp_path / "third" / name).read_bytes()


@pytest.mark.parametrize("name", ["", "nowhere"])
def test_a_folder_without_a_saved_map_is_an_error_with_a_hint(tmp_path, name):
    with pytest.raises(UserError, match="cannot read") as error:
        read_saved_map(tmp_path / name)
    assert error.value.hint


def test_damaged_lines_are_skipped_and_told(log, tmp_path):
    whole = log.read_text().splitlines()
    log.write_text("\n".join([*whole[:20], "FLASER 180 1 2", "ODOM x", *whole[20:], whole[-1][:300]]))
    report = offline_slam(log, tmp_path / "out")
    assert report["bad_lines"] == 3
    assert report["scans_placed"] == 40


def test_a_cut_archive_gives_the_map_up_to_there(log, tmp_path):
    whole = gzip.compress(log.read_bytes())
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(whole[: len(whole) // 2])
    report = offline_slam(cut, tmp_path / "out")
    assert report["truncated"]
    assert 5 < report["scans_placed"] < 40


def test_what_a_log_lacks_is_told_to_the_one_who_asked(log, tmp_path, capsys):
    text = log.read_text() + "FLASER 180 1 2\n"
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(gzip.compress(text.encode())[:-10])
    assert _status(["slam", str(cut), "--out", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert "scans" in out
    assert "cut.log.gz ends early" in err
    log.write_text(text)
    assert _status(["slam", str(log), "--out", str(tmp_path / "out")]) == 0
    assert "1 lines could not be read" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["# nothing\n", "ODOM 1 2 0 0 0 0 1 host 1\n", "FLASER 180 1 2 3\n"])
def test_a_log_without_scans_is_refused_with_a_hint(tmp_path, text):
    path = tmp_path / "bare.log"
    path.write_text(text)
    with pytest.raises(UserError, match="no FLASER") as error:
        offline_slam(path, tmp_path / "out")
    assert error.value.hint
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_is_refused(log, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        offline_slam(log, tmp_path / "file")


@pytest.mark.parametrize(("mode", "folder"), [("localise", None), ("continue", None), ("map", "somewhere")])
def test_a_mode_says_which_map_it_lacks_or_does_not_take(log, tmp_path, mode, folder):
    with pytest.raises(UserError, match="map") as error:
        offline_slam(log, tmp_path / "out", mode=mode, saved_map=folder and tmp_path / folder)
    assert "--map" in error.value.hint


def test_a_map_of_other_cells_is_not_continued(log, tmp_path):
    offline_slam(log, tmp_path / "out")
    config = MapperConfig.model_validate({"occupancy": {"resolution": 0.1}})
    with pytest.raises(UserError, match=r"cells of 0.05 m"):
        offline_slam(log, tmp_path / "more", config=config, mode="continue", saved_map=tmp_path / "out")
