# SPDX-License-Identifier: Apache-2.0
import gzip
from math import pi, radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import Odometry
from zenav.convert.carmen import read_carmen
from zenav.convert.content import content_of
from zenav.convert.records import DriveLog, LoggedPose, LoggedScan

ODOM = "ODOM 1.0 2.0 0.5 0.3 -0.1 0 12.5 host 12.6"
FLASER = "FLASER 180 " + "2.5 " * 180 + "1.1 2.0 0.5 1.0 2.0 0.5 13.5 host 13.6"
ROBOTLASER = (
    "ROBOTLASER1 0 -1.5707 3.1415 0.0174533 20.0 0.01 0 4 1.0 2.0 3.0 4.0 2 0 0 "
    "1.1 2.0 0.5 1.0 2.0 0.5 0.2 0.1 0 0 0 14.5 host 14.6"
)


def log(folder, *lines, name="a.log"):
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    return path


def test_each_line_is_read_as_carmen_wrote_it(tmp_path):
    found = read_carmen(log(tmp_path, "# a comment", "PARAM x 1", ODOM, FLASER, ROBOTLASER))
    pose, scan, other = found.records
    assert (found.n_bad, found.truncated) == (0, False)
    assert pose == LoggedPose(12_500_000_000, Pose2(1, 2, 0.5), 0.3, -0.1)
    assert isinstance(scan, LoggedScan)
    assert (scan.stamp, scan.odom_from_base, scan.odom_from_laser) == (
        13_500_000_000,
        Pose2(1, 2, 0.5),
        Pose2(1.1, 2, 0.5),
    )
    assert (scan.angle_min, scan.angle_increment, len(scan.ranges)) == (-pi / 2, radians(1), 180)
    assert (other.stamp, other.angle_min, other.angle_increment, other.range_max) == (
        14_500_000_000,
        -1.5707,
        0.0174533,
        20.0,
    )
    assert_allclose(other.ranges, (1, 2, 3, 4))
    assert other.odom_from_base == Pose2(1, 2, 0.5)


@pytest.mark.parametrize(("n", "degrees"), [(180, 1), (181, 1), (360, 0.5), (361, 0.5), (91, 2)])
def test_beams_cover_half_a_circle(tmp_path, n, degrees):
    line = f"FLASER {n} " + "1 " * n + "0 0 0 0 0 0 1.0 host 1.0"
    (scan,) = read_carmen(log(tmp_path, line)).records
    assert scan.angle_increment == pytest.approx(radians(degrees))


def test_a_zipped_log_reads_the_same(tmp_path):
    plain = read_carmen(log(tmp_path, ODOM, FLASER))
    with gzip.open(tmp_path / "a.log.gz", "wt") as file:
        file.write(f"{ODOM}\n{FLASER}\n")
    zipped = read_carmen(tmp_path / "a.log.gz")
    assert zipped.records[0] == plain.records[0]
    assert_allclose(zipped.records[1].ranges, plain.records[1].ranges)


@pytest.mark.parametrize(
    "bad",
    [
        "ODOM",
        "ODOM 1 2",
        "ODOM 1 2 x 0 0 0 1 host 1",
        "ODOM nan 2 0 0 0 0 1 host 1",
        "ODOM 1 2 0 0 0 0 inf host 1",
        "ODOM 1 2 0 0 0 0 -5 host 1",
        "FLASER 180 1 2 3",
        "FLASER -3 1 2 3 0 0 0 0 0 0 1 host 1",
        "FLASER 9999999999 1 2 3",
        "FLASER 3 1 2 x 0 0 0 0 0 0 1 host 1",
        FLASER[:500],
        ROBOTLASER.replace(" 0.0174533 ", " 0 "),
        ROBOTLASER.replace(" -1.5707 ", " 900000 "),
        ROBOTLASER[:90],
    ],
)
def test_a_damaged_line_is_skipped_and_counted(tmp_path, bad):
    found = read_carmen(log(tmp_path, ODOM, bad, FLASER))
    assert len(found.records) == 2
    assert found.n_bad == 1


def test_a_range_that_is_no_number_costs_its_beam_alone(tmp_path):
    (scan,) = read_carmen(log(tmp_path, FLASER.replace("2.5 2.5", "nan -1", 1))).records
    assert np.isnan(scan.ranges[:2]).all()
    assert_allclose(scan.ranges[2:], 2.5)


def test_a_zipped_log_that_ends_early_gives_what_it_holds(tmp_path):
    rng = np.random.default_rng(0)
    lines = [f"ODOM {x:.9f} {y:.9f} 0 0 0 0 {i}.0 host 0" for i, (x, y) in enumerate(rng.normal(size=(5000, 2)))]
    whole = gzip.compress("\n".join(lines).encode())
    path = tmp_path / "cut.log.gz"
    path.write_bytes(whole[: len(whole) // 2])
    found = read_carmen(path)
    assert found.truncated
    assert 500 < len(found.records) < 5000


def test_a_log_that_ends_early_is_noted_in_its_conversion():
    assert content_of(DriveLog([])).notes == []
    (note,) = content_of(DriveLog([], truncated=True)).notes
    assert "ends early" in note


def test_messages_of_a_log_are_in_the_order_of_their_stamps_and_scans_keep_the_speed(tmp_path):
    late = ODOM.replace(" 12.5 ", " 14.0 ").replace(" 0.3 -0.1 ", " 0.7 0.2 ")
    messages = [message for _, message in content_of(read_carmen(log(tmp_path, late, FLASER, ODOM))).messages]
    assert [message.stamp for message in messages] == [12_500_000_000, 13_500_000_000, 13_500_000_000, 14_000_000_000]
    speeds = [(message.v, message.w) for message in messages if isinstance(message, Odometry)]
    assert speeds == [(0.3, -0.1), (0.3, -0.1), (0.7, 0.2)]


def test_a_log_of_scans_alone_has_their_speeds(tmp_path):
    messages = [message for _, message in content_of(read_carmen(log(tmp_path, ROBOTLASER))).messages]
    assert [(message.v, message.w) for message in messages if isinstance(message, Odometry)] == [(0.2, 0.1)]


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(UserError, match="cannot read") as error:
        read_carmen(tmp_path / "nothing.log")
    assert error.value.hint


@settings(max_examples=60)
@given(st.lists(st.one_of(st.binary(max_size=80), st.sampled_from([ODOM.encode(), FLASER.encode()])), max_size=12))
def test_any_bytes_are_survived(tmp_path_factory, chunks):
    path = tmp_path_factory.mktemp("log") / "any.log"
    path.write_bytes(b"\n".join(chunks))
    read_carmen(path)
