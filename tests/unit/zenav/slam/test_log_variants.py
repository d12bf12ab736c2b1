# SPDX-License-Identifier: Apache-2.0
"""A variant of a log differs from it in what its kind says, and in nothing else."""

import gzip
from itertools import pairwise
from math import hypot

import numpy as np
import pytest

from shared.geometry import Pose2
from tests.unit.zenav.slam.log_variants import LASERS, RANGES, STEPS, jumping, write_variants

LOG = (
    "# a comment\n"
    "ODOM 1.000 2.000 0.5 0.1 0.0 0 1.0 robot 1.0\n"
    "FLASER 5 1.00 2.00 9.00 7.00 81.91 1.1 2.2 0.6 1.1 2.2 0.6 1.5 robot 1.5\n"
    "ROBOTLASER1 0 -1.57 3.14 1.57 50 0.01 0 3 1.00 9.00 50.00 1 8 1.2 2.3 0.5 1.2 2.3 0.5 0 0 0 0 0 1.6 robot 1.6\n"
)
RANGE_WORDS = {"1.00", "2.00", "9.00", "7.00", "81.91", "50.00"}
POSES = [(1.0, 2.0, 0.5), (1.1, 2.2, 0.6), (1.2, 2.3, 0.5)]  # by odometry, line by line


def variants(kind, tmp_path, n=3):
    """The copies' text, by their seed."""
    log = tmp_path / "hall.log.gz"
    log.write_bytes(gzip.compress(LOG.encode()))
    (tmp_path / "hall.relations").write_text("1 2 0 0 0\n")
    out = tmp_path / "out"
    write_variants(log, out, kind, n)
    assert {path.name for path in out.iterdir()} == {
        f"hall-{kind}-{k}{suffix}" for k in range(1, n + 1) for suffix in (".log.gz", ".relations")
    }
    return [gzip.decompress((out / f"hall-{kind}-{k}.log.gz").read_bytes()).decode() for k in range(1, n + 1)]


def changed_words(copy):
    """The words that differ: (before, after)."""
    return [(a, b) for a, b in zip(LOG.split(" "), copy.split(" "), strict=True) if a != b]


def odometry(copy):
    """The poses of odometry, line by line; the laser's pose is the same."""
    lines = [line.split(" ") for line in copy.splitlines()[1:]]
    words = [lines[0][1:4], lines[1][10:13], lines[2][17:20]]
    assert lines[1][7:10] == words[1]
    assert lines[2][14:17] == words[2]
    return [Pose2(*(float(word) for word in row)) for row in words]


@pytest.mark.parametrize(("kind", "most"), [("noise", 0.02), ("coarse", 0.1)])
def test_ranges_have_noise_and_nothing_else_changes(kind, most, tmp_path):
    copies = variants(kind, tmp_path)
    assert len(set(copies)) == len(copies)
    for copy in copies:
        changed = changed_words(copy)
        assert {a for a, _ in changed} == RANGE_WORDS - {"81.91", "50.00"}
        assert all(abs(float(a) - float(b)) < most for a, b in changed)


def test_a_short_laser_sees_nothing_beyond_its_range(tmp_path):
    far = [{a for a, b in changed_words(copy) if b == "81.830"} for copy in variants("short", tmp_path)]
    assert far == [{"9.00", "81.91", "50.00"}, {"81.91", "50.00"}, {"9.00", "7.00", "81.91", "50.00"}]


def test_a_narrow_laser_has_no_outer_beams(tmp_path):
    for copy in variants("narrow", tmp_path):
        words = copy.splitlines()[2].split(" ")
        assert (words[2], words[4], words[6]) == ("0.000", "9.00", "0.000")
        assert {b for _, b in changed_words(copy)} == {"0.000"}


@pytest.mark.parametrize("kind", STEPS)
def test_odometry_changes_and_nothing_else(kind, tmp_path):
    for copy in variants(kind, tmp_path, 8):
        poses = odometry(copy)
        assert all(a not in RANGE_WORDS for a, _ in changed_words(copy))
        assert (poses[0].x, poses[0].y, poses[0].yaw) == POSES[0]
        steps = [a.inverse() @ b for a, b in pairwise(poses)]
        true = [Pose2(*a).inverse() @ Pose2(*b) for a, b in pairwise(POSES)]
        for step, own in zip(steps, true):  # these are too short for a jump
            off = own.inverse() @ step
            assert hypot(off.x, off.y) < 0.1
            assert abs(off.yaw) < 0.1


def test_a_jump_is_as_long_as_it_says_in_any_direction_and_turns_little():
    step, rng = Pose2(40, 0, 1), np.random.default_rng(1)
    offs = [step.inverse() @ jumping(step, rng) for _ in range(200)]
    assert [hypot(off.x, off.y) for off in offs] == pytest.approx([0.8] * 200)
    assert max(abs(off.yaw) for off in offs) < 1
    assert {(off.x > 0, off.y > 0) for off in offs} == {(a, b) for a in (False, True) for b in (False, True)}


def test_late_odometry_has_the_pose_of_some_time_before(tmp_path):
    copies = [odometry(copy) for copy in variants("late", tmp_path)]
    assert [pose.x for poses in copies for pose in poses] == pytest.approx(
        [1.0, 1.0 + 0.1 * (1.5 - 0.3 - 1.0) / 0.5, 1.0 + 0.1 * (1.6 - 0.3 - 1.0) / 0.5] + [1.0] * 6
    )


def test_a_laser_is_not_where_the_log_has_it(tmp_path):
    """The wheels turn about another point than the laser: it drives on where the original's laser did."""
    for copy, laser in zip(variants("mount", tmp_path), LASERS, strict=True):
        assert all(a not in RANGE_WORDS for a, _ in changed_words(copy))
        lasers = [pose @ laser for pose in odometry(copy)]
        assert [value for p in lasers for value in (p.x, p.y, p.yaw)] == pytest.approx(
            [value for pose in POSES for value in pose], abs=1e-5
        )


def test_every_kind_is_tested():
    assert set(RANGES) | set(STEPS) == {"noise", "coarse", "short", "narrow", "odometry", "jumps"}
