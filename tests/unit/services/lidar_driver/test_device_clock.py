# SPDX-License-Identifier: Apache-2.0
"""The device's clock is followed through jitter, drift, quantised ticks, restarts of it and jumps of ours."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.lidar_driver.device import unwrapped_ticks
from services.lidar_driver.device_clock import DeviceClock, DeviceClockConfig, slope_below_middle

START = 1_700_000_000_000_000_000
NONE = np.zeros(1)


def followed(
    clock: DeviceClock, seconds: float, drift: float, jitter: float, tick: float, seed: int, begin: float = 0.0
) -> float:
    """Observes packets 4 ms apart that are late by an exponential jitter; the largest error after 4 s, in s."""
    rng = np.random.default_rng(seed)
    worst = 0.0
    for k in range(int(seconds / 0.004)):
        true = begin + k * 0.004
        device = true * (1 + drift) + 17.0
        sent = np.floor(device / tick) * tick if tick else device
        late = rng.exponential(jitter)
        clock.observe(START + round((true + late) * 1e9), np.array([sent]), NONE)
        if k * 0.004 > 4:
            worst = max(worst, abs((clock.stack_time(device) - START) * 1e-9 - true))
    return worst


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4, 0.01, -0.01])
@pytest.mark.parametrize("jitter", [0.0, 0.003])
def test_a_drifting_clock_is_followed_through_jitter(drift, jitter):
    assert followed(DeviceClock(DeviceClockConfig()), 25, drift, jitter, 0.0, seed=1) < 5e-4 + jitter / 5


def test_ticks_of_a_ms_cost_less_than_one():
    assert followed(DeviceClock(DeviceClockConfig()), 15, 5e-5, 0.002, 1e-3, seed=2) < 1.5e-3


def test_the_line_lies_under_every_arrival_of_its_window():
    clock, rng = DeviceClock(DeviceClockConfig()), np.random.default_rng(4)
    arrivals = [(k * 0.01, k * 0.01 * 1.0001 + rng.exponential(0.01)) for k in range(2000)]
    for sent, arrived in arrivals:
        clock.observe(START + round(arrived * 1e9), np.array([sent]), NONE)
    early = [clock.stack_time(sent) - START - round(arrived * 1e9) for sent, arrived in arrivals[-900:]]
    assert max(early) < 2e5  # ns


def test_a_burst_after_a_stall_moves_nothing():
    clock = DeviceClock(DeviceClockConfig())
    followed(clock, 5, 0, 0.001, 0, seed=5)
    before = clock.stack_time(22.0)
    sent = 17 + 5 + np.arange(100) * 0.004
    clock.observe(START + round(5.4 * 1e9), sent, np.zeros(100))
    assert abs(clock.stack_time(22.0) - before) < 1e6
    assert clock.n_restarts == 0


@given(jump=st.floats(-1e4, 1e4).filter(lambda jump: abs(jump) > 0.1))
def test_a_jump_of_either_clock_is_followed_within_the_patience(jump):
    clock = DeviceClock(DeviceClockConfig())
    followed(clock, 3, 0, 0.001, 0, seed=6)
    rng = np.random.default_rng(7)
    for k in range(300):
        true = 3 + k * 0.005
        stamp = START + round((true + jump + rng.exponential(0.001)) * 1e9)
        clock.observe(stamp, np.array([true + 17.0]), NONE)
    assert abs((clock.stack_time(17.0 + true) - START) * 1e-9 - true - jump) < 2e-3
    assert 1 <= clock.n_restarts <= 3


def test_a_meeting_of_the_clocks_takes_the_bytes_delay_out():
    clock = DeviceClock(DeviceClockConfig())
    clock.add_clock_reading(0.5, START + 500_000_000 - 300_000, START + 500_000_000 + 300_000)
    for k in range(200):
        clock.observe(START + round((0.6 + k * 0.025 + 0.013) * 1e9), np.array([0.6 + k * 0.025]), NONE)
    assert abs(clock.stack_time(5.0) - START - 5_000_000_000) < 1e6


@given(
    points=st.lists(
        st.tuples(st.integers(0, 1000), st.integers(-50, 50)), min_size=2, max_size=12, unique_by=lambda p: p[0]
    )
)
def test_the_middle_slope_is_that_of_the_only_edge_under_the_middle(points):
    points = sorted((float(x), float(y)) for x, y in points)
    slope = slope_below_middle(points)
    middle = (points[0][0] + points[-1][0]) / 2
    # brute force: of all lines through two points with no point under them, one that spans the middle
    edges = [
        (b[1] - a[1]) / (b[0] - a[0])
        for i, a in enumerate(points)
        for b in points[i + 1 :]
        if a[0] <= middle <= b[0]
        and all(y >= a[1] + (b[1] - a[1]) / (b[0] - a[0]) * (x - a[0]) - 1e-9 for x, y in points)
    ]
    assert min(abs(slope - edge) for edge in edges) < 1e-9


@given(steps=st.lists(st.integers(0, 14_999), min_size=1, max_size=50), first=st.integers(0, 29_999))
def test_a_wrapping_counter_is_unwrapped(steps, first):
    true = first + np.cumsum([0, *steps])
    after, back = unwrapped_ticks(true % 30_000, None, 30_000, 0)
    assert not back
    assert (after == true - first).all()
    pieces = [
        unwrapped_ticks(true[i + 1 : i + 2] % 30_000, int(true[i] % 30_000), 30_000, 0)[0][0] for i in range(len(steps))
    ]
    assert pieces == [b - a for a, b in pairwise(true.tolist())]


def test_a_counter_that_goes_back_is_told():
    assert unwrapped_ticks(np.array([5]), 400, 30_000, 0)[1]
    assert not unwrapped_ticks(np.array([5]), 29_990, 30_000, 0)[1]
    assert not unwrapped_ticks(np.array([300]), 400, 1 << 24, 500)[1]
