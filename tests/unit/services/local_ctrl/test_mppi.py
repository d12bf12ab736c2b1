# SPDX-License-Identifier: Apache-2.0
"""What MPPI returns can be driven, is free, comes nearer, and is the same for the same scene."""

from math import cos, hypot, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from services.local_ctrl import mppi
from services.local_ctrl.controller import ControlScene, ControlSolution
from services.local_ctrl.cost_to_go import CostToGoConfig, cost_to_go
from services.local_ctrl.footprint import Footprint, collides, footprint_of
from services.local_ctrl.mppi import MAX_EXCESS, Mppi, MppiConfig
from services.local_ctrl.rollout import DT, Limits, arc_step, limits_of
from shared.config import load_robot
from shared.distance_field import distance_field

ROBOT = load_robot("x80sv").robot
LIMITS: Limits = limits_of(ROBOT.drive, 10.0, 0.15)
SHAPE: Footprint = footprint_of(ROBOT, 0.03)
N, RESOLUTION = 120, 0.05
START = 3.0, 3.0


def scene(
    occupied: NDArray[np.bool_],
    heading: float = 0.0,
    yaw: float = 0.0,
    v: float = 0.0,
    w: float = 0.0,
    left: float = 2.5,
) -> ControlScene:
    """The robot in the middle, the path straight away from it by `left` m."""
    along = np.linspace(0, left, max(2, round(left / 0.05)))
    path = np.column_stack((START[0] + along * cos(heading), START[1] + along * sin(heading)))
    field = np.minimum(distance_field(occupied, RESOLUTION), np.float32(20))
    unknown = np.zeros_like(occupied)
    to_go = cost_to_go(field, unknown, RESOLUTION, path, START, SHAPE.inscribed, CostToGoConfig()).field
    end = float(path[-1, 0]), float(path[-1, 1])
    return ControlScene(field, occupied, RESOLUTION, to_go, *end, True, *START, yaw, v, w, path)


def places(scene: ControlScene, velocities: NDArray[np.float64]) -> list[tuple[float, float, float]]:
    x, y, yaw, found = scene.x, scene.y, scene.yaw, []
    for v, w in velocities:
        chord, _, _, half = arc_step(v, w, DT)
        x, y, yaw = x + chord * cos(yaw + half), y + chord * sin(yaw + half), yaw + 2 * half
        found.append((x, y, yaw))
    return found


def clutter(seed: int, share: float) -> NDArray[np.bool_]:
    rng = np.random.default_rng(seed)
    occupied = rng.random((N, N)) < share
    rows, columns = np.indices(occupied.shape)
    occupied[np.hypot(rows - START[1] / RESOLUTION, columns - START[0] / RESOLUTION) < 0.35 / RESOLUTION] = False
    return occupied


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 1000), st.sampled_from([0.0, 0.003, 0.02]), st.floats(-3, 3), st.floats(-0.15, 0.8), st.floats(-2, 2)
)
def test_the_solution_keeps_every_limit(seed: int, share: float, heading: float, v: float, w: float) -> None:
    solution = Mppi(MppiConfig(rollouts=200), LIMITS).solve(scene(clutter(seed, share), heading, v=v, w=w), SHAPE, 0)
    speeds = np.concatenate(([v], solution.velocities[:, 0]))
    rates = np.concatenate(([w], solution.velocities[:, 1]))
    assert (speeds <= LIMITS.v_max + 1e-6).all()
    assert (speeds >= LIMITS.v_min - 1e-6).all()
    assert (abs(rates) <= LIMITS.w_max + 1e-6).all()
    faster = np.diff(abs(speeds))
    if not solution.collides:  # what comes after a collision is not driven
        assert (faster <= LIMITS.acceleration * DT + 1e-6).all()
        assert (faster >= -LIMITS.braking * DT - 1e-6).all()
        assert (abs(np.diff(rates)) <= LIMITS.turn_acceleration * DT + 1e-6).all()


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 1000), st.sampled_from([0.003, 0.01]), st.floats(-3, 3))
def test_a_solution_that_does_not_collide_touches_nothing(seed: int, share: float, heading: float) -> None:
    met = scene(clutter(seed, share), heading)
    solution = Mppi(MppiConfig(rollouts=200), LIMITS).solve(met, SHAPE, 0)
    assert not solution.collides  # standing still is always possible here
    for x, y, yaw in places(met, solution.velocities):
        assert not collides(met.field, met.occupied, RESOLUTION, x, y, cos(yaw), sin(yaw), SHAPE)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.0, 3.1])
def test_in_the_open_it_gains_ground(heading: float) -> None:
    controller = Mppi(MppiConfig(), LIMITS)
    met = scene(np.zeros((N, N), bool), heading)
    for _ in range(4):
        solution = controller.solve(met, SHAPE, 0)
    assert solution.gain > 0.4
    x, y, _ = places(met, solution.velocities)[-1]
    assert (x - START[0]) * cos(heading) + (y - START[1]) * sin(heading) > 0.4


def test_it_brakes_for_the_end_of_the_path() -> None:
    controller = Mppi(MppiConfig(), LIMITS)
    met = scene(np.zeros((N, N), bool), v=0.8, left=0.6)
    for _ in range(3):
        solution = controller.solve(met, SHAPE, 0)
    ends = places(met, solution.velocities)
    assert abs(solution.velocities[-1, 0]) < 0.1
    assert hypot(ends[-1][0] - START[0] - 0.6, ends[-1][1] - START[1]) < 0.12


def test_where_even_standing_still_collides_it_says_so() -> None:
    occupied = np.zeros((N, N), bool)
    occupied[60 - 4 : 60 + 5, 60 + 4] = True  # 0.2 m ahead, and the robot drives at it
    solution = Mppi(MppiConfig(), LIMITS).solve(scene(occupied, v=0.8), SHAPE, 0)
    assert solution.collides


def test_who_stands_too_near_may_leave() -> None:
    occupied = np.zeros((N, N), bool)
    occupied[50:71, 60 + 4] = True  # inside the padding, ahead; the path leads back
    solution = Mppi(MppiConfig(), LIMITS).solve(scene(occupied, heading=3.14, yaw=3.14), SHAPE, 0)
    assert not solution.collides
    assert solution.gain > 0.3


def test_the_same_calls_give_the_same_bytes() -> None:
    scenes = [scene(clutter(seed, 0.003), heading=0.3 * seed, v=0.3) for seed in range(5)]
    one, again = Mppi(MppiConfig(), LIMITS), Mppi(MppiConfig(), LIMITS)
    found = [one.solve(s, SHAPE, 1).velocities.tobytes() for s in scenes]
    assert found == [again.solve(s, SHAPE, 1).velocities.tobytes() for s in scenes]
    other = Mppi(MppiConfig(seed=2), LIMITS)
    assert found != [other.solve(s, SHAPE, 1).velocities.tobytes() for s in scenes]


def moving(seed: int) -> NDArray[np.float64]:
    """(6, 6) x, y, v, heading, turn rate, radius of dynamic obstacles about the robot; see ControlScene."""
    rng = np.random.default_rng(seed)
    low, high = (1.5, 1.5, -0.8, -0.8, -1.0, 0.1), (4.5, 4.5, 0.8, 0.8, 1.0, 0.3)
    return rng.uniform(low, high, (6, 6))


@settings(max_examples=60)
@given(
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.003, 0.01, 0.03, 0.1]),
    st.floats(-3.1, 3.1),
    st.floats(-0.15, 0.8),
    st.sampled_from([0.2, 0.6, 2.5]),
    st.booleans(),
    st.sampled_from([0.001, 0.03, 1.0]),
)
def test_rollouts_that_are_not_scored_to_their_end_change_no_solution(
    seed: int, share: float, heading: float, v: float, left: float, crowd: bool, temperature: float
) -> None:
    met = scene(clutter(seed, share), heading=heading, v=v, left=left)
    if crowd:
        met = met._replace(dynamic_obstacles=moving(seed))
    quick, whole = (Mppi(MppiConfig(temperature=temperature), LIMITS) for _ in range(2))
    for _ in range(3):
        found, scored = quick.solve(met, SHAPE, 1), _scored_to_their_ends(whole, met)
        assert found.velocities.tobytes() == scored.velocities.tobytes()
        assert (found.cost, found.collides, found.gain) == (scored.cost, scored.collides, scored.gain)
        without_weight = quick.costs > whole.costs.min() + MAX_EXCESS * temperature
        assert ((quick.costs == whole.costs) | without_weight).all()


def test_most_rollouts_that_explore_are_not_scored_to_their_end() -> None:
    quick, whole = (Mppi(MppiConfig(polish=1.0), LIMITS) for _ in range(2))
    met = scene(clutter(3, 0.003), v=0.5)
    quick.solve(met, SHAPE, 0)
    _scored_to_their_ends(whole, met)
    assert np.mean(quick.costs < whole.costs) > 0.5


def _scored_to_their_ends(controller: Mppi, met: ControlScene) -> ControlSolution:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mppi, "MAX_EXCESS", np.inf)  # for `_best_solution`; compiled code keeps the value
        return controller.solve(met, SHAPE, 1)


def test_after_a_reset_it_solves_as_if_new() -> None:
    met = scene(clutter(3, 0.003))
    controller = Mppi(MppiConfig(), LIMITS)
    first = controller.solve(met, SHAPE, 0).velocities
    controller.solve(met, SHAPE, 1)
    controller.reset()
    assert_array_equal(controller.solve(met, SHAPE, 0).velocities, first)


def test_without_leave_to_reverse_it_never_does() -> None:
    limits = limits_of(ROBOT.drive, 10.0, 0.0)
    solution = Mppi(MppiConfig(), limits).solve(scene(clutter(3, 0.01), heading=3.1), SHAPE, 0)
    assert (solution.velocities[:, 0] >= 0).all()
