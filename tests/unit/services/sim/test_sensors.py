# SPDX-License-Identifier: Apache-2.0
from math import cos, inf, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.sim.rays import cast_ray
from services.sim.sensors import LaserNoise, RangeNoise, add_noise, cone_ranges, ray_range, sweep_ranges
from services.sim.world_loader import load_world
from shared.geometry import Pose2
from tests.unit.services.sim.scenes import PERFECT, START, X80SV, XV11, drive, laser, simulator, told, written

ROOM = load_world("room")


def history_of(pose_at, n, people=()):
    """Rows as dynamics.advance writes them: the pose at each step of 5 ms, then the people's discs."""
    return np.array([[*pose_at(k * 0.005), *(v for person in people for v in person(k * 0.005))] for k in range(n)])


@settings(deadline=None)
@given(st.floats(-6.28, 6.28), st.floats(-0.02, 0.02).filter(lambda v: abs(v) > 1e-3), st.integers(2, 300))
def test_each_beam_is_cast_from_where_the_moving_robot_was_at_its_time(angle_min, increment, n_beams):
    def pose_at(t):
        return 1.5 + 0.8 * t, 1.5 + 0.3 * t, 0.4 + 1.7 * t

    mount, scan_time, begin = (0.13, 0.05, -pi / 2), 0.2, 3.37
    history = history_of(pose_at, 60)
    beam_step = scan_time / (n_beams - 1) / 0.005
    ranges = sweep_ranges(ROOM.cells, history, begin, beam_step, mount, angle_min, increment, n_beams, 20.0)
    for i in range(0, n_beams, 7):
        t = begin * 0.005 + scan_time * i / (n_beams - 1)
        at = Pose2(*pose_at(t)) @ Pose2(*mount)
        angle = at.yaw + angle_min + i * increment
        assert_allclose(ranges[i], cast_ray(ROOM.cells, at.x, at.y, cos(angle), sin(angle), 20.0), atol=1e-3)


def test_people_are_seen_where_they_were_at_the_beams_time():
    walker = lambda t: (3.0 + t, 1.0, 0.25)  # noqa: E731
    history = history_of(lambda t: (1.0, 1.0, 0.0), 60, [walker])
    ranges = sweep_ranges(load_world("empty").cells, history, 0.0, 2.0, (0.0, 0.0, 0.0), 0.0, 1e-9, 20, 20.0)
    assert_allclose(ranges, 1.75 + 0.01 * np.arange(20), atol=1e-6)


def test_the_history_is_a_ring():
    history = history_of(lambda t: (1.0 + t, 1.5, 0.1), 64)
    later = history_of(lambda t: (1.0 + t, 1.5, 0.1), 100)
    ring = later[64:].copy()
    ring = np.concatenate((ring, later[36:64]))
    sweep_of = lambda rows, first: sweep_ranges(ROOM.cells, rows, first, 0.3, (0, 0, 0), -1.0, 0.02, 100, 9.0)  # noqa: E731
    assert_allclose(sweep_of(ring, 60.0), sweep_of(later, 60.0))
    assert not np.allclose(sweep_of(history, 10.0), sweep_of(later, 60.0))


fields_of_view = [(0.0, pi / 180, 360), (-2.356, 0.01, 471), (0.7, -0.01, 300), (-pi, 2 * pi / 512, 512), (2.0, 0.5, 2)]


@pytest.mark.parametrize(("angle_min", "increment", "n_beams"), fields_of_view)
def test_a_scan_shows_the_room_whatever_the_field_of_view(angle_min, increment, n_beams):
    robot = laser(X80SV, angle_min=angle_min, angle_increment=increment, n_beams=n_beams, range_max=20.0)
    service = simulator("room", robot, clutter_jitter=0, **PERFECT)
    scan = told(drive(service, 0.5, 0.0, 0.0), "scan")[0]
    assert (scan.angle_min, scan.angle_increment, len(scan.ranges)) == (angle_min, increment, n_beams)
    at = service.world.start @ Pose2(0.13, 0.0, -pi / 2)
    for i in range(n_beams):
        angle = at.yaw + angle_min + i * increment
        ray = cast_ray(service.cells, at.x, at.y, cos(angle), sin(angle), 30.0)
        assert_allclose(scan.ranges[i], ray, atol=1e-4)


def test_the_xv11s_beam_at_90_degrees_looks_ahead_from_0_13_m_before_the_axis(tmp_path):
    wall = "start: {x: 0, y: 0}\nboxes: [{x: 2.05, y: 0, size: [0.1, 0.2]}]\n"
    service = simulator(written(tmp_path, wall), XV11, **PERFECT)
    scan = told(drive(service, 0.3, 0.0, 0.0), "scan")[0]
    assert_allclose(scan.ranges[90], 2.0 - 0.13, atol=1e-6)
    assert np.isnan(scan.ranges[[0, 180, 270]]).all()


def test_a_scan_is_stamped_with_its_first_beam_and_comes_after_its_last():
    service = simulator("room")
    sent = []
    for publication in drive(service, 2.0, 0.3, 0.5):
        if publication.topic.key == "scan":
            sent.append((service.now, publication.message))
    sweep_ranges = round(X80SV.laser.scan_time * 1e9)
    assert [scan.stamp for _, scan in sent] == [START + k * 100_000_000 for k in range(len(sent))]
    assert len(sent) == 20
    assert all(0 <= now - scan.stamp - sweep_ranges < 20_000_000 for now, scan in sent)


def test_noise_grows_with_range_and_readings_come_in_steps():
    noise = LaserNoise(sigma=0.01, sigma_share=0.01, resolution=0.001, dropout=0.1)
    rng = np.random.default_rng(1)
    for true in (0.5, 4.0):
        read = add_noise(np.full(40_000, true), noise, 0.06, 5.0, rng).astype(float)
        heard = read[np.isfinite(read)]
        assert_allclose(len(heard) / len(read), 0.9, atol=0.01)
        assert_allclose(heard.std(), 0.01 + 0.01 * true, rtol=0.03)
        assert_allclose(heard.mean(), true, atol=0.001)
        assert_allclose(heard, np.round(heard, 3), atol=1e-6)


@settings(deadline=None)
@given(st.lists(st.one_of(st.floats(0, 20), st.just(inf)), min_size=1, max_size=50), st.integers(0, 99))
def test_a_reading_is_in_reach_or_nothing(true, seed):
    read = add_noise(np.array(true), LaserNoise(), 0.1, 5.0, np.random.default_rng(seed))
    near = read[np.isfinite(read)]
    assert near.size == 0 or (near.min() >= np.float32(0.1) and near.max() <= np.float32(5.0))
    assert np.isnan(read[np.array(true) > 5.5]).all()


@settings(deadline=None)
@given(st.floats(-1, 1), st.floats(0.4, 2.0), st.floats(0.05, 0.6))
def test_a_cone_reads_the_shortest_of_its_rays(yaw, view, reach):
    sensors = np.array([[0.1, 0.05, yaw, view, reach]])
    row = np.array([4.0, 3.4, 0.3, 4.5, 2.9, 0.2])
    at = Pose2(*row[:3]) @ Pose2(0.1, 0.05, yaw)
    fine = [ray_range(ROOM.cells, row[3:], at.x, at.y, at.yaw + a, reach) for a in np.linspace(-view / 2, view / 2, 9)]
    assert_allclose(cone_ranges(ROOM.cells, row, sensors, 9)[0], min(fine), rtol=1e-9)


def test_ultrasonic_and_infrared_come_in_the_boards_order_with_nothing_as_nan(tmp_path):
    ahead = "start: {x: 0, y: 0}\nboxes: [{x: 0.7415, y: 0, size: [0.1, 0.1]}, {x: 0, y: -0.421, size: [0.1, 0.2]}]\n"
    service = simulator(written(tmp_path, ahead), **PERFECT)
    report = told(drive(service, 0.1, 0.0, 0.0), "hardware/board")[-1]
    assert report.ultrasonic.shape == (3,)
    assert report.infrared.shape == (7,)
    assert_allclose(report.ultrasonic[1], 0.5, atol=1e-3)
    assert np.isnan(report.ultrasonic[[0, 2]]).all()
    assert_allclose(report.infrared[4], 0.2, atol=1e-3)
    assert np.isnan(report.infrared[[0, 3, 5, 6]]).all()


def test_range_noise_has_its_own_size():
    read = add_noise(
        np.full(20_000, 0.5), RangeNoise(sigma=0.02, resolution=0), 0.0, np.full(20_000, 0.8), np.random.default_rng(0)
    )
    assert_allclose(read.std(), 0.02, rtol=0.03)
