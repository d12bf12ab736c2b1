# SPDX-License-Identifier: Apache-2.0
"""Beams become sweeps: binned, cut at the first angle, lost ones NaN, in time order whatever way the device turns."""

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.lidar_driver.device import Returns
from services.lidar_driver.sweep_assembly import SweepAssembler
from shared.config import Laser

N = 360
TURN = 0.1  # s


def laser(angle_min: float = 0.0, increment: float = 2 * pi / N, n: int = N) -> Laser:
    return Laser(
        angle_min=angle_min, angle_increment=increment, n_beams=n, scan_time=TURN, rate=10, range_min=0.1, range_max=12
    )


def turning(turns: float, direction: int = 1, n: int = N, first: float = 0.0) -> Returns:
    """Beams of a steady device from an angle on; the range encodes the angle: 1 m + degrees (0 to 359.99) in mm."""
    k = np.arange(int(turns * n))
    angles = first + direction * 2 * pi * k / n
    degrees = np.degrees(angles + 1e-9) % 360
    ranges = (1 + degrees * 1e-3).astype(np.float32)
    times = k * TURN / n
    return Returns(angles, ranges, ranges * 10, times, times[-1:], np.zeros(1))


def pieces(returns: Returns, sizes: list[int]) -> list[Returns]:
    edges = np.cumsum(sizes)
    parts = [np.split(a, edges) for a in (returns.angles, returns.ranges, returns.intensities, returns.times)]
    return [Returns(a, r, i, t, t[-1:], np.zeros(1)) for a, r, i, t in zip(*parts) if len(a)]


def degrees_of(sweeps: SweepAssembler) -> np.ndarray:
    return np.degrees(sweeps.angle_min + sweeps.increment * np.arange(sweeps.n) + 1e-9) % 360


@given(sizes=st.lists(st.integers(0, 200), max_size=40), first=st.floats(0, 2 * pi))
def test_pieces_of_any_size_give_the_same_sweeps(sizes, first):
    returns = turning(4, first=first)
    whole, cut = SweepAssembler(laser(), False, False), SweepAssembler(laser(), False, False)
    at_once = whole.add(returns)
    one_by_one = [sweep for piece in pieces(returns, sizes) for sweep in cut.add(piece)]
    assert 3 <= len(at_once) == len(one_by_one) <= 4
    for a, b in zip(at_once, one_by_one):
        np.testing.assert_array_equal(a.ranges, b.ranges)
        assert (a.first, a.last) == pytest.approx((b.first, b.last), abs=2e-4)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("increment", [2 * pi / N, -2 * pi / N])
@pytest.mark.parametrize("angle_min", [0.0, -pi, 1.0])
def test_a_sweep_follows_time_and_each_range_stands_at_its_angle(clockwise, inverted, increment, angle_min):
    sweeps = SweepAssembler(laser(angle_min, increment), clockwise, inverted)
    found = sweeps.add(turning(3, -1 if clockwise else 1, first=0.3))
    assert len(found) >= 2
    assert np.sign(sweeps.increment) == (-1 if clockwise != inverted else 1)
    told = (found[1].ranges - 1) * 1e3
    expected = (-degrees_of(sweeps) if inverted else degrees_of(sweeps)) % 360
    assert np.max(np.abs((told - expected + 180) % 360 - 180)) <= 0.51  # half a beam
    assert found[1].last - found[1].first == pytest.approx(TURN * (N - 1) / N, rel=1e-3)


def test_the_stamps_are_the_first_and_the_last_beams():
    found = SweepAssembler(laser(), False, False).add(turning(3))
    for number, sweep in enumerate(found):
        assert sweep.first == pytest.approx(number * TURN, abs=1e-9)
        assert sweep.last == pytest.approx(number * TURN + TURN * (N - 1) / N, abs=1e-9)


def test_a_sweep_is_told_with_its_last_beam():
    returns = turning(1)
    sweeps = SweepAssembler(laser(), False, False)
    *before, last = pieces(returns, [100, 100, 100, 59])
    assert [sweep for piece in before for sweep in sweeps.add(piece)] == []
    assert len(sweeps.add(last)) == 1


def test_a_narrow_field_of_view_ends_with_its_own_last_beam():
    sweeps = SweepAssembler(laser(-1.0, 2 * pi / N, 100), False, False)
    found = sweeps.add(turning(2.5, first=-pi))
    assert len(found) == 2
    assert found[0].last - found[0].first == pytest.approx(TURN * 99 / N, rel=1e-6)
    assert not np.isnan(found[0].ranges).any()


@given(lost=st.integers(10, 170), at=st.integers(0, 359))
def test_lost_beams_are_nan_and_shift_no_other(lost, at):
    returns = turning(4)
    keep = np.ones(4 * N, bool)
    keep[N + at : N + at + lost] = False
    heard = Returns(
        returns.angles[keep], returns.ranges[keep], None, returns.times[keep], returns.times[-1:], np.zeros(1)
    )
    found = SweepAssembler(laser(), False, False).add(heard)
    assert len(found) == 4
    expected = np.where(keep, returns.ranges, np.nan).reshape(4, N)
    assert_allclose(np.array([sweep.ranges for sweep in found]), expected)
    assert_allclose([sweep.first for sweep in found], np.arange(4) * TURN, atol=1e-9)


@pytest.mark.parametrize("lost_turns", [0.9, 1.0, 1.6, 3.3])
def test_whole_turns_that_were_lost_are_counted_by_time(lost_turns):
    returns = turning(8)
    lost = int(lost_turns * N)
    keep = np.ones(8 * N, bool)
    keep[2 * N + 50 : 2 * N + 50 + lost] = False
    sweeps = SweepAssembler(laser(), False, False)
    heard = Returns(
        returns.angles[keep], returns.ranges[keep], None, returns.times[keep], returns.times[-1:], np.zeros(1)
    )
    for sweep in sweeps.add(heard):
        assert sweep.first / TURN == pytest.approx(round(sweep.first / TURN), abs=1e-6)
        good = ~np.isnan(sweep.ranges)
        assert_allclose(sweep.ranges[good], (1 + np.arange(N) * 1e-3)[good], atol=1e-6)
        assert good.mean() >= 0.5


def test_beams_off_the_grid_go_to_the_nearest_and_the_nearest_wins():
    sweeps = SweepAssembler(laser(), False, False)
    found = sweeps.add(turning(3, n=1000))
    k = np.arange(1000) * 360 / 1000
    nearest = np.array([k[np.argmin(np.abs(k - degree))] for degree in range(1, N)])
    assert_allclose((found[0].ranges[1:] - 1) * 1e3, nearest, atol=0.181)


def test_a_beam_without_echo_does_not_hide_one_with():
    returns = turning(3, n=2 * N, first=np.radians(0.1))
    ranges = returns.ranges.copy()
    ranges[::2] = np.nan
    found = SweepAssembler(laser(), False, False).add(
        Returns(returns.angles, ranges, None, returns.times, returns.times[-1:], np.zeros(1))
    )
    assert not np.isnan(found[1].ranges).any()


def test_the_rest_of_a_sweep_is_not_told_for_a_whole_one():
    sweeps = SweepAssembler(laser(), False, False)
    found = sweeps.add(turning(1.3, first=1.4 * pi))
    assert len(found) == 1
    assert not np.isnan(found[0].ranges).any()
    assert sweeps.n_lost == 1


def test_a_device_that_stands_fills_no_memory_and_tells_nothing():
    sweeps = SweepAssembler(laser(), False, False)
    for k in range(600):
        times = k * 0.05 + np.arange(500) * 1e-4
        angles = np.full(500, 1.0)
        assert sweeps.add(Returns(angles, np.ones(500, np.float32), None, times, times[-1:], np.zeros(1))) == []
        assert sweeps.n_stored <= 100_500
