# SPDX-License-Identifier: Apache-2.0
"""What a relative error must be, whatever the trajectory; and that it is the one that the benchmark's tool computes."""

import importlib.util
import json
import os
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from shared.config import UserError
from shared.geometry import Pose2
from zenav.slam.offline_slam import tum_text
from zenav.slam.slam_error import (
    PosePairs,
    loop_pairs,
    neighbour_pairs,
    pair_errors,
    pairs_of,
    read_tum,
    relative_poses,
    slam_errors,
)

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where the machine keeps its logs
TOOL = Path(DATA).parent / "tools" / "slam_eval.py" if DATA else None

motions = st.builds(Pose2, *[st.floats(-50, 50)] * 2, st.floats(-3, 3))
steps = st.lists(st.builds(Pose2, *[st.floats(-2, 2)] * 2, st.floats(-3, 3)), min_size=2, max_size=30)


def driven(steps):
    """(stamps, poses) of a robot that moves by steps, one a second."""
    way = [Pose2()]
    for step in steps:
        way.append(way[-1] @ step)
    return 10.0 + np.arange(len(way)), rows(way)


def rows(way):
    return np.array([(pose.x, pose.y, pose.yaw) for pose in way])


def laps(n, per_lap=100, radius=4.0):
    """(n, 3) poses on a circle."""
    turned = 2 * np.pi * np.arange(n) / per_lap
    return np.column_stack((radius * np.cos(turned), radius * np.sin(turned), turned + np.pi / 2))


def all_pairs(stamps, poses):
    i, j = np.triu_indices(len(poses), 1)
    return PosePairs(stamps[i], stamps[j], relative_poses(poses[i], poses[j]))


@given(steps)
def test_a_perfect_trajectory_has_no_error(steps):
    stamps, poses = driven(steps)
    found = pair_errors(stamps, poses, all_pairs(stamps, poses))
    assert_allclose(found.metres, 0, atol=1e-9)
    assert_allclose(found.degrees, 0, atol=1e-9)


@given(steps, steps, motions)
def test_a_rigid_motion_of_the_whole_changes_nothing(steps, others, motion):
    n = min(len(steps), len(others))
    (stamps, poses), (_, reference) = driven(steps[:n]), driven(others[:n])
    moved = rows([motion @ Pose2(*pose) for pose in poses])
    pairs = all_pairs(stamps, reference)
    before, after = pair_errors(stamps, poses, pairs), pair_errors(stamps, moved, pairs)
    assert_allclose(after.metres, before.metres, atol=1e-6)
    turned = np.abs(after.degrees - before.degrees)
    assert_allclose(np.minimum(turned, 360 - turned), 0, atol=1e-6)


@given(steps, motions)
def test_a_pair_costs_the_motion_that_its_end_is_off(steps, slip):
    """Composed by Pose2: an independent way to the same metres and degrees."""
    stamps, poses = driven(steps)
    off = poses.copy()
    off[-1] = rows([Pose2(*poses[-1]) @ slip])[0]
    found = pair_errors(stamps, off, PosePairs(stamps[:1], stamps[-1:], relative_poses(poses[:1], poses[-1:])))
    assert_allclose(found.metres, np.hypot(slip.x, slip.y), atol=1e-9)
    assert_allclose(found.degrees, np.degrees(abs(slip.yaw)), atol=1e-9)


def test_one_early_turn_is_one_error_not_one_in_every_later_pose():
    stamps, poses = driven([Pose2(1, 0, 0)] * 20)
    _, bent = driven([Pose2(1, 0, 0.1 if k == 5 else 0) for k in range(20)])
    i, j = np.arange(20), np.arange(1, 21)
    found = pair_errors(stamps, bent, PosePairs(stamps[i], stamps[j], relative_poses(poses[i], poses[j])))
    assert_allclose(found.metres, 0, atol=1e-12)
    assert (found.degrees > 1).sum() == 1


def test_poses_between_two_stamps_are_interpolated_the_short_way_round():
    stamps, poses = np.array([0.0, 1.0]), np.array([(0, 0, 3.1), (2, 0, -3.1)])
    turn = 2 * np.pi - 6.2
    pairs = PosePairs(
        np.array([0.0]), np.array([0.25]), relative_poses(poses[:1], np.array([(0.5, 0, 3.1 + turn / 4)]))
    )
    assert_allclose(pair_errors(stamps, poses, pairs).metres, 0, atol=1e-12)
    assert_allclose(pair_errors(stamps, poses, pairs).degrees, 0, atol=1e-9)


def test_figures_are_of_the_errors():
    stamps, poses = driven([Pose2(1, 0, 0)] * 3)
    off = np.tile((0.1, 0.0, 0.0), (3, 1)) * np.array([[1.0], [2.0], [6.0]])
    pairs = PosePairs(stamps[:3], stamps[1:], relative_poses(poses[:3], poses[1:]) + off)
    figures = pair_errors(stamps, poses, pairs).figures()
    wanted = {"n": 3, "trans_mean_m": 0.3, "trans_std_m": np.std([0.1, 0.2, 0.6]), "trans_median_m": 0.2}
    assert figures == pytest.approx({**wanted, "trans_max_m": 0.6, "rot_mean_deg": 0.0})


@pytest.mark.parametrize("n", [1, 2, 5, 6, 21, 50])
def test_neighbours_are_all_pairs_1_5_or_20_apart(n):
    early, late = neighbour_pairs(n)
    assert sorted(zip(early, late)) == [(i, j) for i in range(n) for j in range(i, n) if j - i in (1, 5, 20)]


def test_loops_are_places_seen_again_after_a_long_way():
    poses = laps(330)
    i, j = loop_pairs(poses)
    assert len(i) > 100
    assert (np.hypot(*(poses[i, :2] - poses[j, :2]).T) < 2.0).all()
    lap = 2 * np.pi * 4.0
    assert ((j - i) * lap / 100 > 20.0 - 0.1).all()
    assert set(i) == set(range(max(i) + 1))  # from every place that the robot came back to
    assert all(b - a >= 5 for k in set(i) for a, b in pairwise(j[i == k]))
    assert len(loop_pairs(laps(70))[0]) == 0


def test_a_pair_that_the_trajectory_does_not_cover_is_no_excuse():
    stamps, poses = driven([Pose2(1, 0, 0)] * 200)
    pairs = all_pairs(stamps, poses)
    with pytest.raises(UserError, match="outside the trajectory's time"):
        pair_errors(stamps[:-20], poses[:-20], pairs)
    assert 0.98 <= len(pair_errors(stamps[:-2], poses[:-2], pairs).metres) / len(pairs.early) < 1


@pytest.mark.parametrize("text", ["", "# nothing\n", "1 2 3\n", "1 2 3 4 x\n", "1 2 3 4 nan\n", "1 2 3 4 5\n1 2\n"])
@pytest.mark.parametrize("name", ["a.relations", "a.ref.tum"])
def test_a_reference_of_anything_else_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=name.replace(".", r"\.")) as error:
        pairs_of(tmp_path / name)
    assert error.value.hint
    with pytest.raises(UserError, match="cannot read"):
        pairs_of(tmp_path / f"no-{name}")


def test_a_trajectory_is_read_in_the_order_of_its_stamps(tmp_path):
    stamps, poses = np.array([3.0, 1.0, 2.0]), np.array([(3, 0, 1.0), (1, 0, -3.0), (2, 5, 0.5)])
    (tmp_path / "a.tum").write_text("# by hand\n" + tum_text(stamps, poses))
    found, at = read_tum(tmp_path / "a.tum")
    assert_allclose(found, (1, 2, 3))
    assert_allclose(at, poses[[1, 2, 0]], atol=1e-6)


def noisy(poses, rng):
    """A trajectory that drifts away from the reference."""
    return poses + np.cumsum(rng.normal(0, 0.01, poses.shape), axis=0)


@pytest.mark.skipif(TOOL is None or not TOOL.exists(), reason="slam_eval.py, which made the table, is not here")
@pytest.mark.parametrize("name", ["made-up", "intel-sparse.ref.tum", "edmonton.ref.tum", "aces.relations"])
def test_the_figures_are_those_of_the_tool(tmp_path, name, monkeypatch, capsys):
    spec = importlib.util.spec_from_file_location("slam_eval", TOOL)
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    rng = np.random.default_rng(0)
    reference = Path(str(DATA)) / "slam" / name
    if name == "made-up":
        reference = tmp_path / "laps.ref.tum"
        reference.write_text(tum_text(np.arange(3100) * 0.3, laps(3100, per_lap=700, radius=6.0)))
    if name.endswith(".relations"):
        ends = pairs_of(reference)["relations"]
        stamps = np.unique(np.concatenate((ends.early, ends.late)))
        poses = laps(len(stamps))
    else:
        stamps, poses = read_tum(reference)
    trajectory = tmp_path / "found.tum"
    trajectory.write_text(tum_text(stamps, noisy(poses, rng)))

    theirs, ours = tool.pairs_of(str(reference)), pairs_of(reference)
    assert list(ours) == list(theirs)
    at, where = tool.read_tum(str(trajectory))
    for kind, (early, late, relative) in theirs.items():
        assert_allclose(ours[kind].early, early, atol=1e-9)
        assert_allclose(ours[kind].late, late, atol=1e-9)
        assert_allclose(ours[kind].early_from_late, relative, atol=1e-9)
        left = tool.between(relative, tool.between(tool.at(at, where, early), tool.at(at, where, late)))
        found = pair_errors(*read_tum(trajectory), ours[kind])
        assert_allclose(found.metres, np.hypot(left[:, 0], left[:, 1]), atol=1e-9)
        assert_allclose(found.degrees, np.abs(np.degrees(left[:, 2])), atol=1e-9)

    monkeypatch.setattr(sys, "argv", ["slam_eval.py", str(trajectory), str(reference)])
    tool.main()
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    figures = slam_errors(trajectory, reference)
    assert list(figures) == list(told)
    for kind, row in told.items():
        assert figures[kind] == pytest.approx(row, abs=6e-5)  # it rounds
