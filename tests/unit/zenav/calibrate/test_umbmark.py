# SPDX-License-Identifier: Apache-2.0
from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import UserError
from zenav.calibrate.rolling import WheelGeometry, WheelTravel
from zenav.calibrate.umbmark import angles, corrected, ends_at, errors, largest_error, square_runs, umbmark

NOMINAL = WheelGeometry(0.085, 0.085, 0.283)
DT = 20_000_000  # ns


def wheels_of(ratio: float, distance: float) -> WheelGeometry:
    left = 2 * 0.085 / (1 + ratio)
    return WheelGeometry(left, left * ratio, 0.283 * distance)


def drive(ways: str, side: float = 2.0, pause: float = 1.5) -> WheelTravel:
    """Squares by odometry with the nominal wheels: r clockwise, l counter-clockwise."""
    left, right = [0.0] * 80, [0.0] * 80
    for way in ways:
        turn = (-1 if way == "r" else 1) * pi / 2 * NOMINAL.distance / 2 / 60 / 0.085
        for _ in range(4):
            left += [side / 150 / 0.085] * 150 + [0.0] * 10 + [-turn] * 60 + [0.0] * 10
            right += [side / 150 / 0.085] * 150 + [0.0] * 10 + [turn] * 60 + [0.0] * 10
        left += [0.0] * round(pause / 0.02)
        right += [0.0] * round(pause / 0.02)
    stamps = 10**18 + np.arange(len(left) + 1) * DT
    return WheelTravel(
        stamps, np.concatenate(([0], np.cumsum(left))), np.concatenate(([0], np.cumsum(right))),
        np.zeros(len(stamps), bool),
    )  # fmt: skip


def truth(rolled: WheelTravel, found, wheels: WheelGeometry):
    return ends_at(rolled.stamps, rolled.poses(wheels), rolled, found)


@given(st.floats(0.97, 1.03), st.floats(0.96, 1.04), st.sampled_from([1.0, 2.0, 4.0]))
@settings(max_examples=25)
def test_ratio_and_distance_are_found(ratio, distance, side):
    side = min(side, 0.03 / max(abs(ratio - 1), 0.0075))  # the squares must end near their start
    side = max(side, 0.6)
    rolled = drive("rl", side)
    found = square_runs(rolled, NOMINAL)
    wheels = wheels_of(ratio, distance)
    true = truth(rolled, found, wheels)
    result = umbmark(true, rolled, found, NOMINAL)
    assert result.wheels.ratio == pytest.approx(ratio, abs=0.05 * abs(ratio - 1) + 0.03 * abs(distance - 1) + 1e-5)
    assert result.wheels.distance / 0.283 == pytest.approx(
        distance, abs=0.06 * (abs(ratio - 1) + abs(distance - 1)) + 1e-5
    )
    assert result.wheels.radius == pytest.approx(0.085)


def test_the_error_at_the_squares_ends_shrinks_by_an_order_as_the_paper_promises():
    rolled = drive("rlrl")
    found = square_runs(rolled, NOMINAL)
    true = truth(rolled, found, wheels_of(1.01, 1.02))
    result = umbmark(true, rolled, found, NOMINAL)
    before = largest_error(result.clockwise, result.counterclockwise)
    after = errors(true, rolled, found, result.wheels)
    clockwise = np.array([run.clockwise for run in found])
    assert before > 0.3
    assert largest_error(after[clockwise], after[~clockwise]) < before / 10


def test_a_longer_axle_alone_is_alpha_and_a_larger_wheel_alone_is_beta():
    rolled = drive("rl")
    found = square_runs(rolled, NOMINAL)
    for wheels, alpha, beta in (
        (wheels_of(1, 1.01), pi / 2 * 0.01 / 1.01, 0),
        (wheels_of(1.01, 1), 0, 0.01 * 2 / 0.283),
    ):
        result = umbmark(truth(rolled, found, wheels), rolled, found, NOMINAL)
        assert (result.alpha, result.beta) == pytest.approx((alpha, beta), abs=0.003)


def test_the_paper_s_equations():
    # errors (x, y) m of a 4 m square whose corners lack alpha, whose sides bend by beta: the paper's (8) to (12)
    side, alpha, beta = 4.0, 0.01, 0.02
    clockwise = np.array([(-2 * side * (alpha + beta), -2 * side * (alpha + beta))])
    counterclockwise = np.array([(-2 * side * (alpha - beta), 2 * side * (alpha - beta))])
    assert angles(clockwise, counterclockwise, side) == pytest.approx((alpha, beta))
    better = corrected(NOMINAL, alpha, beta, side)
    radius = side / 2 / np.sin(beta / 2)
    assert better.ratio == pytest.approx((radius + 0.283 / 2) / (radius - 0.283 / 2))
    assert better.distance == pytest.approx(0.283 * 90 / (90 - np.degrees(alpha)))


def test_squares_are_told_from_other_drives():
    rolled = drive("rll", side=1.0)
    found = square_runs(rolled, NOMINAL)
    assert [run.clockwise for run in found] == [True, False, False]
    assert [run.side for run in found] == pytest.approx([1.0] * 3)
    there = WheelTravel(rolled.stamps[:300], rolled.left[:300], rolled.right[:300], rolled.broken[:300])
    assert square_runs(there, NOMINAL) == []
    together = drive("rl", pause=0.3)
    assert square_runs(together, NOMINAL) == []


def test_a_square_with_a_hole_in_its_wheels_does_not_count():
    rolled = drive("rl")
    broken = rolled.broken.copy()
    broken[400] = True
    assert [run.clockwise for run in square_runs(rolled._replace(broken=broken), NOMINAL)] == [False]


def test_one_way_round_is_not_enough():
    rolled = drive("rr")
    found = square_runs(rolled, NOMINAL)
    with pytest.raises(UserError, match="no square counter-clockwise"):
        umbmark(truth(rolled, found, NOMINAL), rolled, found, NOMINAL)


def test_what_is_far_off_is_refused():
    rolled = drive("rl")
    found = square_runs(rolled, NOMINAL)
    true = truth(rolled, found, NOMINAL) + np.array((8.0, -8.0, 0.0))
    with pytest.raises(UserError, match=r"end 11\.3 m off"):
        umbmark(true, rolled, found, NOMINAL)


def test_scatter_gives_the_uncertainty_and_one_run_each_way_gives_none():
    rolled = drive("rl" * 4)
    found = square_runs(rolled, NOMINAL)
    rng = np.random.default_rng(0)
    wheels = wheels_of(1.005, 1.01)
    true = truth(rolled, found, wheels)
    off = []
    for _ in range(60):
        noisy = true + np.column_stack((0.02 * rng.normal(size=(8, 2)), np.zeros(8)))
        result = umbmark(noisy, rolled, found, NOMINAL)
        assert result.sigmas is not None
        off.append(
            (
                (result.wheels.ratio - 1.005) / result.sigmas[0],
                (result.wheels.distance - wheels.distance) / result.sigmas[1],
            )
        )
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert np.all((rms > 0.7) & (rms < 1.6)), rms
    assert umbmark(true[:2], rolled, found[:2], NOMINAL).sigmas is None
