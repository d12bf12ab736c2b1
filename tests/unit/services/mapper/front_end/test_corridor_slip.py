# SPDX-License-Identifier: Apache-2.0
"""In a corridor door frames show how far the robot moved, where its wheels slip; nothing else moves its pose."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.corridor_slip import CorridorSlip, open_direction
from services.mapper.front_end.registration import RegistrationConfig
from services.mapper.front_end.scan_alignment import Prediction, UnmatchedMotion
from services.mapper.front_end.submap import Submap
from services.mapper.front_end.surface_normals import sweep_normals
from services.mapper.grid.occupancy import OccupancyConfig
from shared.geometry import Pose2
from tests.unit.services.mapper import rooms
from tests.unit.services.mapper.hardships import BARE, DOORS, Hardship, course, laser

STEP = Pose2(0.1, 0, 0)
PREDICTION = Prediction(
    local_from_base=Pose2(), motion=STEP, smoothed=Pose2(), step=STEP, seconds=0.2, sigma_factor=1.0, skew=0.0,
    unmatched=UnmatchedMotion(),
)  # fmt: skip


def sweep_at(pose, segments, n=360):
    """The beams with an echo, with noise of 1 cm."""
    origins, ends = rooms.sweep(segments, pose, n, 0.01, seed=round(1000 * pose.x))
    seen = ~np.isnan(ends[:, 0])
    return Sweep(origins[seen], ends[seen], sweep_normals(origins, ends)[seen], np.zeros(int(seen.sum())))


def submap_of(segments, x0, x1):
    """What a robot has mapped on its way from x0 to x1."""
    submap = Submap(RegistrationConfig(), OccupancyConfig(), 8.0)
    for x in np.arange(x0, x1, 0.3).tolist():
        sweep = sweep_at(Pose2(x), segments)
        submap.add_points(Pose2(x), sweep.points, sweep.normals)
    return submap


SUBMAP, BARE_SUBMAP = submap_of(DOORS, 0.0, 16.0), submap_of(rooms.CORRIDOR, 0.0, 16.0)


def corrected(slip, true, matched, submap=SUBMAP, segments=DOORS, prediction=PREDICTION):
    """The pose after a scan at `true` that was matched at `matched`."""
    sweep = sweep_at(true, segments)
    match = submap.registrar.evaluate(sweep.points, sweep.normals, matched)
    return slip.corrected_pose(submap, sweep, match, prediction)


def driven(submap=SUBMAP, segments=DOORS):
    """After 4 m of matches without an error."""
    slip = CorridorSlip()
    for x in np.arange(1.0, 5.0, 0.1).tolist():
        assert corrected(slip, Pose2(x), Pose2(x), submap, segments) is None
    return slip


@given(slips=st.lists(st.floats(0.02, 0.09), min_size=3, max_size=9), sign=st.sampled_from([-1, 1]))
def test_a_pose_that_wheels_carried_along_a_corridor_comes_back_within_a_few_scans(slips, sign):
    slip, off = driven(), 0.0
    for i, more in enumerate(slips):
        true = Pose2(5.0 + 0.1 * i)
        off += sign * more
        pose = corrected(slip, true, Pose2(off) @ true)
        if pose is not None:
            assert true.distance(pose) < 0.06
            off = pose.x - true.x
        assert abs(off) < 0.3


@given(off=st.floats(-0.6, 0.6))
def test_a_bare_corridor_says_nothing_of_slip(off):
    slip = driven(BARE_SUBMAP, rooms.CORRIDOR)
    assert corrected(slip, Pose2(5.0), Pose2(5.0 + off), BARE_SUBMAP, rooms.CORRIDOR) is None


def test_new_ground_is_no_slip():
    """The robot sees doors that are not mapped yet. More of its beams would lie on the map farther back."""
    slip, submap = driven(), submap_of(DOORS, 0.0, 4.0)
    for x in np.arange(5.0, 9.0, 0.1).tolist():
        assert corrected(slip, Pose2(x), Pose2(x), submap) is None


@pytest.mark.parametrize("off", [-1.7, -1.0, 0.8, 1.0, 1.7, 2.5])
def test_a_robot_does_not_slip_farther_than_it_drives(off):
    """The scan that fits far off, after a step of 0.1 m, is one of a place that looks alike. Later it may be slip."""
    slip, true = driven(), Pose2(6.0)
    for i in range(60):
        pose = corrected(slip, true, Pose2(6.0 + off))
        assert pose is None or (0.1 * (i + 1) > abs(off) - 0.25 and pose.distance(true) < 0.1)


@pytest.mark.parametrize(("yaw", "step", "slips"), [(0.0, STEP, True), (0.6, STEP, False), (0.0, Pose2(), False)])
def test_wheels_slip_ahead_and_only_while_they_turn(yaw, step, slips):
    """A robot that turns beside a wall, with a narrow view, sees one wall as well: its pose along it may be late."""
    slip, prediction = driven(), replace(PREDICTION, step=step)
    poses = [corrected(slip, Pose2(5, 0, yaw), Pose2(5.2, 0, yaw), prediction=prediction) for _ in range(5)]
    assert any(pose is not None for pose in poses) == slips


def test_where_scans_fit_unevenly_none_of_them_shows_slip():
    """People hide the walls now and then."""
    slip, rng = CorridorSlip(), np.random.default_rng(1)
    for x in np.arange(1.0, 5.0, 0.1).tolist():
        off = Pose2(0.3 * rng.integers(-1, 2), 0.15 * rng.integers(-1, 2))
        corrected(slip, Pose2(x), off @ Pose2(x))
    assert corrected(slip, Pose2(5.0), Pose2(5.25)) is None


def test_a_direction_is_open_along_a_corridor_and_not_in_a_room():
    sweep = sweep_at(Pose2(0.3, 0.2, 0.4), rooms.ROOM)
    submap = Submap(RegistrationConfig(), OccupancyConfig(), 8.0)
    submap.add_points(Pose2(0.3, 0.2, 0.4), sweep.points, sweep.normals)
    in_room = submap.registrar.evaluate(sweep.points, sweep.normals, Pose2(0.3, 0.2, 0.4))
    assert open_direction(in_room.information) is None
    assert open_direction(np.zeros((3, 3))) is None
    sweep = sweep_at(Pose2(5.0), DOORS)
    x, y = open_direction(SUBMAP.registrar.evaluate(sweep.points, sweep.normals, Pose2(5.0)).information)
    assert abs(x) == pytest.approx(1.0, abs=0.01)
    assert abs(y) < 0.1


@pytest.mark.parametrize("rate", [5, 20])
@pytest.mark.parametrize(("share", "far"), [(0.2, 0.25), (2.0, 0.7)])
def test_a_robot_whose_wheels_slip_in_a_corridor_finds_its_pose_by_door_frames(share, far, rate):
    """Odometry is 1.6 m too short, or 2 m too long. Without the frames the pose is, too."""

    def told(k, motion):
        return Pose2(share * motion.x, 0, motion.yaw) if 6 * rate <= k < 10 * rate else motion

    row = Hardship(laser(rate=rate), (Pose2(0.5 / rate, 0, 0),) * (14 * rate), Pose2(1.0), DOORS, told)
    assert course(row).away.max() < far
    assert course(replace(row, segments=BARE.segments)).away.max() > 1.4
