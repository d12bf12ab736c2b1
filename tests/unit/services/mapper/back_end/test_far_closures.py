# SPDX-License-Identifier: Apache-2.0
"""After a drift of many metres the robot is found on its own map, but not where another place looks the same."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from services.mapper.back_end import far_closures
from services.mapper.back_end.back_end import BackEnd
from services.mapper.back_end.constraint_search import AGAIN_SPACING_M, ConstraintSearch
from services.mapper.back_end.far_closures import (
    MIN_AGREEING_PATH_M,
    MIN_PATH_PER_OFFSET,
    FarClosures,
    FarSearch,
    by_odometry,
    distant_places,
    drift_limits,
    find_far_closure,
)
from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import Constraint, LoopClosureConfig, match_place
from services.mapper.back_end.map_parts import MIN_FAR_JOINTS, OdometryGap
from services.mapper.back_end.pose_graph import PoseGraph
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.back_end.solver.optimize import optimize
from shared.geometry import Pose2, wrapped
from tests.unit.services.mapper.hardships import LONG_CORRIDOR, TO_ITS_END, wall
from tests.unit.services.mapper.rooms import LAP, RING, START, RoomDrive, laps

CONFIG = LoopClosureConfig()
SURE = np.diag((1e4, 1e4, 1e5))
OFF = Pose2(4.6, -2.0, 0.25)  # by which odometry was off while no scan fitted; the ordinary window ends at 3 m


def begin_part(driven: RoomDrive, off: Pose2, **closures) -> None:
    """Begins a part that is off by a motion, and leaves it to closures to find it on the rest."""
    mapper = driven.mapper
    motion = mapper.back_end.keyframes[-1].local_from_base.inverse() @ mapper.front_end.local_from_base
    mapper.back_end.begin_part(OdometryGap(motion @ off, 10.0, 3.0))
    mapper.front_end.start(mapper.back_end.keyframes[-1].local_from_base @ motion @ off)
    configure(driven, **closures)
    mapper.slam.localizer.config = mapper.slam.localizer.config.model_copy(update={"min_inlier_ratio": 2.0})


def configure(driven: RoomDrive, **closures) -> None:
    back_end = driven.mapper.back_end
    back_end.closure_config = back_end.closure_config.model_copy(update=closures)


def round_the_ring(n: int) -> RoomDrive:
    driven = RoomDrive(RING, noise=0.01)
    driven.true = START
    drive(driven, n)
    return driven


def drive(driven: RoomDrive, n: int) -> None:
    motions = laps()
    for _ in range(len(driven.poses) % LAP):
        next(motions)
    for _ in range(n):
        driven.step(next(motions))


def test_a_part_that_is_many_metres_off_is_found_on_the_rest():
    driven = round_the_ring(2 * LAP)
    begin_part(driven, OFF)
    wrongly = 0
    for _ in range(LAP):
        drive(driven, 1)
        wrongly += driven.mapper.back_end.is_joined and driven.error.distance(Pose2()) > 0.3
    assert wrongly <= 1  # the scan before the optimum
    assert driven.mapper.back_end.is_joined
    assert driven.error.distance(Pose2()) < 0.1


def test_a_part_beyond_the_drift_is_found_where_odometry_alone_leads():
    driven = round_the_ring(2 * LAP)
    begin_part(driven, Pose2(14.0, -9.0, 1.0))
    drive(driven, LAP)
    assert driven.mapper.back_end.is_joined
    assert driven.error.distance(Pose2()) < 0.1


def test_keyframes_that_were_too_far_off_for_closures_get_theirs_afterwards():
    driven = round_the_ring(2 * LAP)
    begin_part(driven, OFF, enabled=False)
    drive(driven, LAP // 2)
    back_end = driven.mapper.back_end
    part, newest = back_end.first_node, int(back_end.graph.nodes[-1])
    configure(driven, enabled=True)
    drive(driven, LAP)
    graph = back_end.graph.snapshot()
    assert back_end.is_joined
    assert not back_end.search.again
    late = graph.loop & graph.on & (graph.i < part) & (graph.j >= part) & (graph.j <= newest)
    assert len(np.unique(graph.j[late])) > 10


@pytest.mark.parametrize("off", [-4.0, 4.0])
def test_a_stretch_of_corridor_that_looks_like_the_next_joins_nothing(off):
    driven = RoomDrive(LONG_CORRIDOR, noise=0.01)
    driven.true = Pose2(2.0, 1.2, 0.0)
    half = len(TO_ITS_END) // 2
    for motion in TO_ITS_END[: half + 150]:
        driven.step(motion)
    begin_part(driven, Pose2(off, 0, 0))
    n = 0
    for motion in TO_ITS_END[half + 150 : half + 350]:
        driven.step(motion)
        n += driven.mapper.back_end.is_joined and driven.error.distance(Pose2()) > 0.3
    assert n == 0


def corridor(rng: np.random.Generator, y: float) -> list[tuple[float, float, float, float]]:
    """40 m of corridor along x with a niche about every 4 m on both sides."""
    segments = [(0, y, 0, y + 2.4), (40, y, 40, y + 2.4)]
    for side, depth in ((y, -0.3), (y + 2.4, 0.3)):
        niches = tuple(1.5 + 4 * k + float(rng.uniform(-0.5, 0.5)) for k in range(10))
        segments += wall(0, 40, side, niches)
        for x in niches:
            segments += [(x, side, x, side + depth), (x + 0.9, side, x + 0.9, side + depth)]
            segments += [(x, side + depth, x + 0.9, side + depth)]
    return segments


@pytest.mark.parametrize("seed", [1, 3])
def test_new_ground_that_looks_like_another_place_is_not_taken_for_it(seed):
    rng = np.random.default_rng(seed)
    driven = RoomDrive(np.array([*corridor(rng, 0.0), *corridor(rng, 30.0)]), noise=0.01)
    driven.rng, driven.true = np.random.default_rng(seed), Pose2(2.0, 1.2, 0.0)
    for _ in range(120):
        driven.step(Pose2(0.3, 0, 0))
    begin_part(driven, Pose2(-20.0, 4.0, 0.0))
    driven.true = Pose2(2.0, 31.2, 0.0)  # of the other corridor, which the robot has not seen yet
    for _ in range(120):
        driven.step(Pose2(0.3, 0, 0))
        assert not driven.mapper.back_end.is_joined


def test_a_newest_keyframe_that_sees_nothing_does_not_hinder_the_best_match_so_far():
    driven = round_the_ring(2 * LAP)
    begin_part(driven, OFF)
    back_end = driven.mapper.back_end
    far, hypothesis = back_end.search.far_closures, None
    while hypothesis is None or hypothesis.best is None:
        drive(driven, 1)
        hypothesis = far.hypothesis(back_end.graph, back_end.driven)
    graph, newest, nothing = back_end.graph.snapshot(), back_end.keyframes[-1], np.zeros((0, 2))
    blind = Keyframe.of(newest.stamp, newest.local_from_base, nothing, nothing, nothing, nothing, nothing)
    covariances = relative_covariances(graph, int(graph.nodes[-1]))
    visits = graph, covariances, (*back_end.keyframes[:-1], blind), np.array(back_end.driven), back_end.submaps
    found = find_far_closure(*visits, back_end.closure_config, hypothesis)
    assert found.has_missed
    assert found.is_unique
    assert found.compared == hypothesis.best.j != graph.nodes[-1]


@pytest.mark.parametrize(
    ("best", "rival", "is_unique"), [(0.65, 0.3, True), (0.65, 0.5, False), (0.97, 0.75, True), (0.97, 0.9, False)]
)
def test_a_match_of_plants_is_unique_where_no_other_place_fits_well_enough_to_follow(
    monkeypatch, best, rival, is_unique
):
    """Outdoors a third of the beams do not agree at the right place, and a third of them agree at any other one."""
    driven = round_the_ring(2 * LAP)
    begin_part(driven, OFF)
    back_end = driven.mapper.back_end
    hypothesis = None
    while hypothesis is None or hypothesis.best is None:
        drive(driven, 1)
        hypothesis = back_end.search.far_closures.hypothesis(back_end.graph, back_end.driven)
    graph = back_end.graph.snapshot()
    away = Pose2(*graph.poses[0].tolist()) @ Pose2(0, 100, 0)

    def match_of_plants(graph, keyframes, row, last, window, submaps, config):
        found = match_place(graph, keyframes, row, last, window, submaps, config)
        margin = rival if window.is_even else best
        rivals = [(away, margin)] if window.is_even else []
        return found and replace(found, margin=margin, rivals=rivals)

    monkeypatch.setattr(far_closures, "match_place", match_of_plants)
    covariances = relative_covariances(graph, int(graph.nodes[-1]))
    visits = graph, covariances, back_end.keyframes, np.array(back_end.driven), back_end.submaps
    assert find_far_closure(*visits, back_end.closure_config, hypothesis).is_unique == is_unique


coordinates = st.floats(-30, 30)
rows = st.lists(
    st.tuples(coordinates, coordinates, st.floats(0, 20), st.floats(0, 2), coordinates, coordinates),
    min_size=2,
    max_size=80,
)


@given(rows)
@example(
    [(0.0, 0.0, 1.5, 0.0, 0.0, 0.0), *[(0.0, 0.0, 0.0, 1.0, 0.0, 0.0)] * 3]
)  # between two and three standard deviations
def test_each_place_within_the_drift_is_searched_once_and_no_other(drawn):
    x, y, sigma, step, *guess = np.array(drawn).T
    poses, map_from_last = (np.column_stack((*position, np.zeros_like(x))) for position in ((x, y), guess))
    covariances = np.zeros((len(x), 3, 3))
    covariances[:, 0, 0] = sigma**2
    driven = np.cumsum(step) * 5
    limits = drift_limits(covariances, driven, CONFIG)
    places = distant_places(poses, map_from_last, limits, CONFIG)
    path, distance = driven[-1] - driven, np.hypot(*(poses[:, :2] - map_from_last[:, :2]).T)
    drift = np.minimum(3 * sigma, CONFIG.max_window + CONFIG.max_drift_ratio * path)
    is_far = CONFIG.window_sigmas * sigma > CONFIG.max_window
    wanted = (path > CONFIG.min_path_between) & is_far & (distance < 3.0 + drift)
    assert wanted[places].all()
    assert (np.diff(distance[places]) >= 0).all()
    apart = np.hypot(*(poses[places, None, :2] - poses[None, :, :2]).T)  # (n, k)
    between = apart[places] + np.diag(np.full(len(places), np.inf))
    assert (between > CONFIG.view_radius).all()
    assert not wanted.any() or (apart[wanted].min(axis=1) <= CONFIG.view_radius).all()


def test_by_odometry_the_newest_pose_is_that_of_each_node_and_the_motion_since():
    rng = np.random.default_rng(4)
    graph, keyframes, nothing = PoseGraph(), [], np.zeros((0, 2))
    for k in range(6):
        graph.add_node(Pose2(*rng.uniform(-3, 3, 3).tolist()))
        pose = None if k == 2 else Pose2(*rng.uniform(-3, 3, 3).tolist())
        keyframes.append(Keyframe.of(k, Pose2(), nothing, nothing, nothing, nothing, nothing, by_odometry=pose))
    guesses = by_odometry(graph.snapshot(), keyframes)
    for k, keyframe in enumerate(keyframes):
        if keyframe.by_odometry is None:
            assert np.isnan(guesses[k]).all()
        else:
            expected = graph.pose(k) @ keyframe.by_odometry.inverse() @ keyframes[-1].by_odometry
            assert expected.distance(Pose2(*guesses[k].tolist())) < 1e-9
            assert abs(wrapped(expected.yaw - guesses[k, 2])) < 1e-9
    unknown = [*keyframes[:-1], Keyframe.of(9, Pose2(), nothing, nothing, nothing, nothing, nothing)]
    assert np.isnan(by_odometry(graph.snapshot(), unknown)).all()


def straight(n: int) -> tuple[PoseGraph, list[float]]:
    """A graph of two passes side by side, n nodes each, 1 m from node to node; the second is 20 m off."""
    graph = PoseGraph()
    for k in range(2 * n):
        graph.add_node(Pose2(k % n, 20.0 * (k >= n), 0.0))
    return graph, [float(k) for k in range(2 * n)]


def closure(k: int, n: int, dx: float = 0.0) -> FarSearch:
    return FarSearch(Constraint(k, n + k, Pose2(dx, 0, 0), SURE))


def test_closures_count_once_enough_agree_over_a_path_that_is_long_for_what_they_move():
    n = 30
    far = FarClosures()
    ripe = []
    for k in range(12):
        graph, driven = straight(n)
        assert not far.add(closure(k, n), graph)
        ripe.append(far.hypothesis(graph, driven).best is not None)
    assert ripe == [k >= max(MIN_FAR_JOINTS - 1, MIN_AGREEING_PATH_M + 20 * MIN_PATH_PER_OFFSET) for k in range(12)]
    graph, driven = straight(n)
    assert far.hypothesis(graph, driven).map_from_base.distance(Pose2(n - 1, 0, 0)) < 1e-9
    found = closure(12, n).closure
    counted = far.add(FarSearch(found, is_unique=True), graph)
    assert [c.j for c in counted] == list(range(n, n + 13))
    assert far.hypothesis(graph, driven) is None


def test_the_best_matches_are_compared_with_all_places_first_and_each_once():
    n, margins = 30, (0.5, 0.7, 0.6, 0.9, 0.5, 0.6, 0.55, 0.8)
    graph, driven = straight(n)
    far = FarClosures()
    for k, margin in enumerate(margins):
        far.add(FarSearch(closure(k, n, dx=1.0 if k == 3 else 0.0).closure, margin), graph)
    compared = []
    for _ in range(3):
        compared.append(far.hypothesis(graph, driven).best.j - n)
        far.add(FarSearch(compared=n + compared[-1]), graph)
    assert compared == [7, 1, 2]


def test_a_closure_that_disagrees_does_not_count_with_the_others():
    n = 30
    graph, _ = straight(n)
    far = FarClosures()
    for k in range(10):
        far.add(closure(k, n, dx=1.0 if k == 4 else 0.0), graph)
    counted = far.add(FarSearch(closure(10, n).closure, is_unique=True), graph)
    assert len(counted) == 10
    assert n + 4 not in [c.j for c in counted]


@pytest.mark.parametrize(("found", "n_until"), [(FarSearch(has_missed=True), 12), (FarSearch(is_ambiguous=True), 3)])
def test_a_hypothesis_that_fits_no_more_or_not_alone_is_given_up(found, n_until):
    n = 30
    graph, driven = straight(n)
    far = FarClosures()
    for k in range(8):
        far.add(closure(k, n), graph)
    for _ in range(n_until - 1):
        far.add(found, graph)
        assert far.hypothesis(graph, driven) is not None
    far.add(found, graph)
    assert far.hypothesis(graph, driven) is None


@given(st.lists(st.booleans(), min_size=1, max_size=6))
def test_closures_count_once_more_of_them_have_no_rival_than_have_one(has_rival):
    """In a building of similar corridors one in three wrong matches fits nowhere else as well, by chance."""
    n = 30
    graph, _ = straight(n)
    far, ahead = FarClosures(), 0
    for k in range(25):
        far.add(closure(k, n), graph)
    for is_ambiguous in has_rival:
        counted = far.add(FarSearch(is_unique=not is_ambiguous, is_ambiguous=is_ambiguous), graph)
        ahead += -1 if is_ambiguous else 1
        assert bool(counted) == (ahead > 0)
        if counted:
            return


def test_removed_keyframes_take_their_closures_with_them():
    n = 30
    graph, driven = straight(n)
    far = FarClosures()
    far.add(closure(3, n), graph)
    graph.remove_node(3)
    del driven[3]
    assert far.hypothesis(graph, driven) is None


def close(back_end: BackEnd, off: float) -> None:
    """Adds a closure that moves the newest keyframe by `off`, m."""
    first, newest = (int(node) for node in back_end.graph.nodes[[0, -1]])
    first_from_newest = back_end.graph.pose(first).inverse() @ back_end.graph.pose(newest) @ Pose2(off, 0, 0)
    back_end.add_closures([Constraint(first, newest, first_from_newest, SURE)])


@pytest.mark.parametrize(("off", "is_drift"), [(0.5, False), (1.0, True)])
def test_keyframes_before_a_closure_that_moves_the_robot_far_are_searched_again(off, is_drift):
    back_end = round_the_ring(LAP // 2).mapper.back_end
    assert back_end.closed_at == 0
    close(back_end, off)
    back_end.apply(optimize(*back_end.optimization_arguments()))
    again = np.searchsorted(back_end.graph.nodes, back_end.search.again)
    places = {int(path / AGAIN_SPACING_M) for path in back_end.driven if path > 0}
    assert {int(back_end.driven[row] / AGAIN_SPACING_M) for row in again} == (places if is_drift else set())
    assert len(again) <= len(places)


def test_a_drift_is_searched_once_and_after_the_optimum_that_corrects_it():
    back_end = round_the_ring(LAP // 2).mapper.back_end
    before = back_end.optimization_arguments()
    close(back_end, 1.0)
    back_end.apply(optimize(*before))
    assert not back_end.search.again
    back_end.apply(optimize(*back_end.optimization_arguments()))
    assert back_end.search.again
    back_end.search.again = []
    back_end.apply(optimize(*back_end.optimization_arguments()))
    assert not back_end.search.again


def test_only_nodes_that_were_off_are_searched_again_newest_first_and_a_metre_apart():
    graph, _ = straight(20)
    driven = [0.4 * k for k in range(40)]
    for k in range(39):
        graph.add_edge(k, k + 1, Pose2(1, 0, 0), SURE, loop=k == 24)
    search = ConstraintSearch()
    search.search_again(graph.snapshot(), driven, frozenset({(24, 25)}), closed_at=14.0)
    order = [search.again.pop() for _ in range(len(search.again))]
    assert order == sorted(order, reverse=True)
    assert min(order) == 25
    paths = [int(driven[node] / AGAIN_SPACING_M) for node in order]
    assert len(set(paths)) == len(paths)
    search.search_again(graph.snapshot(), driven, frozenset(), closed_at=14.0)
    assert all(driven[node] > 14.0 for node in search.again)


def test_far_closures_are_searched_once_a_metre_and_with_a_hypothesis_each_time():
    graph, driven = straight(30)
    search = ConstraintSearch()

    def orders():
        begin = search.searched_at
        orders = (search.next_order(graph, [*driven, begin + 0.5 * k], 0, False, True) for k in range(1, 9))
        return [order.searches_far for order in orders]

    search.searched_at = search.searched_far_at = 60.0
    assert orders() == [False, True] * 4
    search.far_closures.add(closure(5, 30), graph)
    assert orders() == [True] * 8
