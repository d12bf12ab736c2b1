# SPDX-License-Identifier: Apache-2.0
import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from services.mapper.service import MapperConfig
from shared.config import UserError
from shared.geometry import Pose2
from shared.ros_map import read_ros_map
from tests.unit.services.mapper.rooms import ROOM, cast
from zenav.__main__ import _status
from zenav.saved_map import read_saved_map, write_saved_map
from zenav.slam import slam

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where the machine keeps its logs


def lines(n=40, mount=Pose2(0.2, 0.0, 0.0), first=100.0):  # noqa: B008  # a pose is a value
    """A CARMEN log of a robot that circles in a made-up room; its odometry's wheels are 3 % too small."""
    angles = np.radians(np.arange(-90, 90))
    true, odom = Pose2(), Pose2()
    for k in range(n):
        step = Pose2(0.06, 0, 0.1)
        true, odom = true @ step, odom @ Pose2(0.062, 0, 0.1)
        stamp = first + 0.2 * k
        laser, seen = true @ mount, odom @ mount
        ranges = cast(ROOM, np.tile((laser.x, laser.y), (180, 1)), laser.yaw + angles)
        ranges[ranges > 30] = 81.83
        yield f"ODOM {odom.x:.6f} {odom.y:.6f} {odom.yaw:.6f} 0 0 0 {stamp - 0.1:.6f} host 0"
        yield (
            "FLASER 180 " + " ".join(f"{r:.2f}" for r in ranges)
            + f" {seen.x:.6f} {seen.y:.6f} {seen.yaw:.6f} {odom.x:.6f} {odom.y:.6f} {odom.yaw:.6f} {stamp:.6f} host 0"
        )  # fmt: skip


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "room.log"
    path.write_text("\n".join(lines()) + "\n")
    return path


def poses_of(folder):
    rows = np.loadtxt(folder / "trajectory.tum")
    return rows[:, 0], np.column_stack((rows[:, 1], rows[:, 2], 2 * np.arctan2(rows[:, 6], rows[:, 7])))


def test_a_log_becomes_a_trajectory_a_map_a_picture_and_a_report(log, tmp_path):
    shares = []
    report = slam(log, tmp_path / "out", shares.append)
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


def test_the_same_log_gives_the_same_bytes_twice(log, tmp_path):
    for name in ("a", "b"):
        slam(log, tmp_path / name)
    for name in ("trajectory.tum", "map.pgm", "map.yaml", "map.png", "graph.msgpack"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_its_map_loads_and_is_saved_again_to_the_same_bytes(log, tmp_path):
    report = slam(log, tmp_path / "out")
    saved = read_saved_map(tmp_path / "out")
    assert len(saved.keyframes) == report["keyframes"] > 3
    write_saved_map(tmp_path / "again", saved)
    write_saved_map(tmp_path / "third", read_saved_map(tmp_path / "again"))
    for name in ("map.pgm", "map.yaml", "graph.msgpack"):
        content = (tmp_path / "out" / name).read_bytes()
        assert content == (tmp_path / "again" / name).read_bytes() == (tmp_path / "third" / name).read_bytes()


@pytest.mark.parametrize("name", ["", "nowhere"])
def test_a_folder_without_a_saved_map_is_an_error_with_a_mend(tmp_path, name):
    with pytest.raises(UserError, match="cannot read") as error:
        read_saved_map(tmp_path / name)
    assert error.value.mend


def test_damaged_lines_are_skipped_and_told(log, tmp_path):
    whole = log.read_text().splitlines()
    log.write_text("\n".join([*whole[:20], "FLASER 180 1 2", "ODOM x", *whole[20:], whole[-1][:300]]))
    report = slam(log, tmp_path / "out")
    assert report["bad_lines"] == 3
    assert report["scans_placed"] == 40


def test_a_cut_archive_gives_the_map_up_to_there(log, tmp_path):
    whole = gzip.compress(log.read_bytes())
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(whole[: len(whole) // 2])
    report = slam(cut, tmp_path / "out")
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


@pytest.mark.parametrize("text", ["", "ODOM 1 2 0 0 0 0 1 host 1\n", "FLASER 180 1 2 3\n"])
def test_a_log_without_scans_is_refused_with_a_mend(tmp_path, text):
    path = tmp_path / "bare.log"
    path.write_text(text)
    with pytest.raises(UserError, match="no FLASER") as error:
        slam(path, tmp_path / "out")
    assert error.value.mend
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_is_refused(log, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        slam(log, tmp_path / "file")


@pytest.mark.skipif(DATA is None, reason="ZENAV_DATA is not set: the real logs are not on this machine")
def test_a_slice_of_a_real_log_agrees_with_its_reference(tmp_path):
    """The first minutes of the Intel log against the hand-checked displacements in them (noise: 0.014 m)."""
    folder = Path(str(DATA)) / "slam"
    with gzip.open(folder / "intel.log.gz", "rt") as whole:
        head = [line for _, line in zip(range(4500), whole)]
    (tmp_path / "slice.log").write_text("".join(head))
    report = slam(tmp_path / "slice.log", tmp_path / "out")
    assert report["states"].get("lost", 0) == 0
    stamps, poses = poses_of(tmp_path / "out")
    pairs = np.loadtxt(folder / "intel.relations")
    pairs = pairs[(pairs[:, :2] > stamps[0]).all(axis=1) & (pairs[:, :2] < stamps[-1]).all(axis=1)]
    assert len(pairs) > 30
    poses[:, 2] = np.unwrap(poses[:, 2])
    at = np.column_stack([np.interp(pairs[:, :2].ravel(), stamps, column) for column in poses.T])
    errors = [
        (Pose2(*a).inverse() @ Pose2(*b)).distance(Pose2(*relation[2:5]))
        for a, b, relation in zip(at[::2], at[1::2], pairs)
    ]
    assert np.median(errors) < 0.03


@pytest.fixture(scope="module")
def intel_in_two(tmp_path_factory):
    """The map of the first half of a real log, and what the robot drove then."""
    if DATA is None:
        pytest.skip("ZENAV_DATA is not set: the real logs are not on this machine")
    folder = tmp_path_factory.mktemp("intel")
    with gzip.open(Path(DATA) / "slam" / "intel-sparse.log.gz", "rt") as whole:
        lines = whole.read().splitlines()
    scans = [i for i, line in enumerate(lines) if line.startswith("FLASER")]
    (folder / "first.log").write_text("\n".join(lines[: scans[455]]) + "\n")
    (folder / "second.log").write_text("\n".join(lines[scans[455] : scans[605]]) + "\n")
    slam(folder / "first.log", folder / "map")
    return folder


def off_the_reference(folder, name):
    """m from each scan's place to the reference's, the map laid onto that by its own drive."""
    rows = np.loadtxt(Path(str(DATA)) / "slam" / "intel-sparse.ref.tum")

    def pairs(of):
        stamps, poses = poses_of(folder / of)
        at = np.clip(np.searchsorted(rows[:, 0], stamps - 1e-3), 0, len(rows) - 1)
        same = np.abs(rows[at, 0] - stamps) < 2e-3
        return poses[same, :2], rows[at[same], 1:3]

    mine, theirs = pairs("map")
    u, _, v = np.linalg.svd((mine - mine.mean(axis=0)).T @ (theirs - theirs.mean(axis=0)))
    turn = u @ np.diag((1, np.linalg.det(u @ v))) @ v
    found, wanted = pairs(name)
    return np.hypot(*((found - mine.mean(axis=0)) @ turn + theirs.mean(axis=0) - wanted).T)


def test_the_next_lap_of_a_real_log_is_localised_on_the_map_of_the_first(intel_in_two):
    before = {path.name: path.read_bytes() for path in (intel_in_two / "map").iterdir()}
    report = slam(intel_in_two / "second.log", intel_in_two / "there", mode="localise", saved_map=intel_in_two / "map")
    assert report["log_lines"][0].startswith("found on the map")
    assert report["states"]["starting"] < 20
    assert "lost" not in report["states"]
    off = off_the_reference(intel_in_two, "there")
    assert np.median(off) < 0.15
    assert off.max() < 0.7, "the reference's own error, and its map's, are in this"
    assert {path.name: path.read_bytes() for path in (intel_in_two / "map").iterdir()} == before
    for name in ("map.pgm", "map.yaml", "graph.msgpack"):
        assert (intel_in_two / "there" / name).read_bytes() == before[name]


def test_a_real_map_goes_on_and_is_one_with_the_old_one(intel_in_two):
    report = slam(intel_in_two / "second.log", intel_in_two / "both", mode="continue", saved_map=intel_in_two / "map")
    assert report["loops"] > 30
    off = off_the_reference(intel_in_two, "both")
    assert np.median(off) < 0.15
    assert off.max() < 0.7
    old, new = read_saved_map(intel_in_two / "map"), read_saved_map(intel_in_two / "both")
    assert len(new.keyframes) > len(old.keyframes)
    assert np.abs(new.graph.poses[0] - old.graph.poses[0]).max() == 0, "it holds the map"


def test_a_robot_that_is_not_on_the_saved_map_is_an_error_and_no_place(log, intel_in_two, tmp_path):
    with pytest.raises(UserError, match="not found on the map") as error:
        slam(log, tmp_path / "out", mode="localise", saved_map=intel_in_two / "map")
    assert error.value.mend
    assert not (tmp_path / "out" / "trajectory.tum").exists()


@pytest.mark.parametrize(("mode", "folder"), [("localise", None), ("continue", None), ("map", "somewhere")])
def test_a_mode_says_which_map_it_lacks_or_does_not_take(log, tmp_path, mode, folder):
    with pytest.raises(UserError, match="map") as error:
        slam(log, tmp_path / "out", mode=mode, saved_map=folder and tmp_path / folder)
    assert "--map" in error.value.mend


def test_a_map_of_other_cells_is_not_continued(log, tmp_path):
    slam(log, tmp_path / "out")
    config = MapperConfig.model_validate({"occupancy": {"resolution": 0.1}})
    with pytest.raises(UserError, match=r"cells of 0.05 m"):
        slam(log, tmp_path / "more", config=config, mode="continue", saved_map=tmp_path / "out")
