# SPDX-License-Identifier: Apache-2.0
"""A robot whose front end drifts drives round a ring: its loop closes, and nothing closes that is none."""

import sys
from dataclasses import fields, replace
from itertools import islice
from math import hypot, pi

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from services.mapper.back_end.back_end import BackEnd
from services.mapper.back_end.config import BackEndConfig
from services.mapper.back_end.constraint_search import FoundConstraints, search_constraints
from services.mapper.back_end.far_closures import FarSearch
from services.mapper.back_end.keyframe import Keyframe, Sweep
from services.mapper.back_end.local_map import MARGIN_M, PLACE_SIZE, build_local_map
from services.mapper.back_end.loop_closure import (
    Constraint,
    LoopClosureConfig,
    SubmapCache,
    earlier_visits,
    find_loop_closures,
    information_in_own_frame,
    match_loop_closure,
)
from services.mapper.back_end.map_jobs import MapJobs
from services.mapper.back_end.pairwise_constraints import PairwiseConfig
from services.mapper.back_end.pose_graph import OptimizationResult
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.back_end.solver.optimize import PoseGraphConfig
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import Match, RegistrationConfig
from services.mapper.front_end.surface_normals import sweep_normals, usable_beams
from services.mapper.grid.map_drawing import SLICE_KEYFRAMES
from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from shared.geometry import Pose2
from shared.types import NS_PER_S
from tests.unit.services.mapper.rooms import LAP, RING, START, STEP, TURN, laps, sweep

SURE = np.diag((1e4, 1e4, 1e5))
DRIFT = Pose2(0.003, 0.002, 0.0015)  # m, m, rad with every keyframe: after a lap, half a metre and more
BEFORE_THE_LOOP = LAP - 22  # the last step from which no keyframe closes it


class DriftingRobot:
    """A back end with keyframes at true poses, and odometry that drifts. Jobs are done at once, unless `busy`."""

    def __init__(self, drift=DRIFT, segments=RING, **back_end):
        settings = RegistrationConfig(), OccupancyConfig(), 8.0
        self.back_end = BackEnd(
            BackEndConfig(**back_end), LoopClosureConfig(min_path_between=8.0), PoseGraphConfig(), *settings
        )
        self.map_jobs = MapJobs(self.back_end)
        self.drift, self.segments = drift, segments
        self.true, self.local, self.now = START, Pose2(), 0
        self.true_at: dict[int, Pose2] = {}  # by stamp
        self.jobs, self.busy, self.drawings, self.around = [], False, [], None
        self.odometry = OdometryError()

    def sweep(self):
        return sweep(self.segments, self.true, noise=0.01, seed=self.now // NS_PER_S)

    def keyframe(self):
        origins, ends = self.sweep()
        normals = sweep_normals(origins, ends)
        valid = usable_beams(origins, ends) | normals.any(axis=1)
        found = Sweep(origins, ends, normals, np.zeros(len(ends))).only(valid)
        self.true_at[self.now] = self.true
        return Keyframe.of(self.now, self.local, origins, ends, found.points, found.normals, ends[:0])

    def stands(self):
        match = Match(self.local, SURE, np.ones(1, bool), 1.0)
        self.take(self.map_jobs.add_keyframe(self.keyframe(), match, self.odometry))

    def drives(self, motions):
        if not self.back_end.keyframes:
            self.stands()
        for motion in motions:
            self.now += NS_PER_S
            self.true = self.true @ motion
            self.local = self.local @ motion @ self.drift
            self.stands()

    def take(self, jobs):
        self.jobs += list(jobs or ())
        while self.jobs and not self.busy:
            job = self.jobs.pop(0)
            result = job.function(*job.arguments)
            if job.done == "on_map_drawn":
                self.take(self.redrawn(result))
            elif job.done == "on_local_map":
                self.around = self.map_jobs.on_local_map(result)
            else:
                self.take(getattr(self.map_jobs, job.done)(result))

    def redrawn(self, result):
        grid = yield from self.map_jobs.on_map_drawn(result, self.now)
        if grid is not None:
            self.drawings.append(grid)

    @property
    def errors(self):
        """(n, 3) what is left between keyframes and truth, on the map that begins at the first."""
        rests = [
            (START.inverse() @ self.true_at[keyframe.stamp]).inverse() @ Pose2(*row)
            for keyframe, row in zip(self.back_end.keyframes, self.back_end.graph.poses.tolist())
        ]
        return np.array([(rest.x, rest.y, rest.yaw) for rest in rests])


@pytest.fixture(scope="module")
def round_once():
    robot = DriftingRobot()
    robot.drives(islice(laps(), LAP + 20))
    return robot


def test_a_loop_closes_and_takes_out_the_drift_of_the_whole_lap(round_once):
    drifted = (START.inverse() @ round_once.true).inverse() @ round_once.local
    assert hypot(drifted.x, drifted.y) > 1.0
    assert round_once.back_end.n_loops > 5
    assert np.hypot(*round_once.errors[:, :2].T).max() < 0.35
    poses, keyframes = round_once.back_end.graph.poses, round_once.back_end.keyframes
    now = round_once.true_at[keyframes[-1].stamp]
    for row in range(10, 25):  # of the first lap, about where the robot is again
        true = round_once.true_at[keyframes[row].stamp].inverse() @ now
        rest = true.inverse() @ (Pose2(*poses[row]).inverse() @ Pose2(*poses[-1]))
        assert hypot(rest.x, rest.y) < 0.05
        assert abs(rest.yaw) < 0.025


def test_matches_that_are_doubtful_close_no_loop():
    robot, motions = DriftingRobot(), laps()
    robot.odometry.match_error.doubt()
    robot.drives(islice(motions, LAP + 20))
    assert robot.back_end.n_loops == 0
    robot.odometry = OdometryError()
    robot.drives(islice(motions, 20))
    assert robot.back_end.n_loops > 5
    assert np.hypot(*robot.errors[:, :2].T).max() < 0.35


def test_where_the_front_end_is_on_the_map_follows_the_newest_keyframe(round_once):
    back_end = round_once.back_end
    pose = back_end.map_from_local @ round_once.local
    assert pose.distance(Pose2(*back_end.graph.poses[-1])) < 1e-9
    assert back_end.corrections()[-1].distance(back_end.map_from_local) < 1e-9


def test_the_map_is_drawn_again_from_where_the_keyframes_are_now(round_once):
    round_once.take(round_once.map_jobs.redraw(round_once.now + 10 * NS_PER_S))
    assert not list(round_once.map_jobs.redraw(round_once.now + 20 * NS_PER_S)), "nothing has moved since"
    grid = round_once.drawings[-1]
    _, ends = sweep(RING, START)
    near = START.inverse() @ (START @ ends[~np.isnan(ends[:, 0])])
    inwards = near * (1 - 0.25 / np.hypot(*near.T))[:, None]
    assert grid.is_free(np.ascontiguousarray(inwards), 0).mean() > 0.95, "no second wall before the first"


def test_without_drift_a_closure_moves_nothing_that_is_seen():
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), LAP + 20))
    assert robot.back_end.n_loops > 5
    assert np.abs(robot.errors).max() < 0.02


def test_in_a_corridor_that_looks_alike_everywhere_nothing_is_closed_at_another_place():
    corridor = np.array([(-60.0, -1.0, 60.0, -1.0), (-60.0, 1.0, 60.0, 1.0)])
    robot = DriftingRobot(drift=Pose2(), segments=corridor)
    robot.true = Pose2(0.0, 0.0, 0.0)
    robot.drives([Pose2(STEP, 0, 0)] * 40 + [Pose2(0, 0, pi / 6)] * 6 + [Pose2(STEP, 0, 0)] * 40)
    places = np.array([(k.local_from_base.x, k.local_from_base.y) for k in robot.back_end.keyframes])
    assert np.abs(robot.back_end.graph.poses[:, :2] - places).max() < 0.05


def test_what_was_looked_for_on_another_map_counts_no_more():
    robot = DriftingRobot()
    robot.busy = True
    robot.drives(islice(laps(), 10))
    assert robot.jobs
    robot.map_jobs.reset()
    robot.busy = False
    robot.take(())
    assert robot.back_end.n_loops == 0
    assert not robot.map_jobs.is_searching


def test_one_look_runs_at_a_time_and_what_comes_meanwhile_moves_along():
    robot = DriftingRobot()
    robot.drives(islice(laps(), LAP))
    robot.busy = True
    robot.drives(islice(laps(), 12))
    assert [job.done for job in robot.jobs].count("on_constraints") == 1
    robot.busy = False
    robot.take(())
    robot.drives([])
    last, before = robot.back_end.graph.poses[-1], robot.back_end.graph.poses[-2]
    step = Pose2(*before).inverse() @ Pose2(*last)
    told = robot.back_end.keyframes[-2].local_from_base.inverse() @ robot.back_end.keyframes[-1].local_from_base
    assert step.distance(told) < 0.02


def test_a_closure_found_while_the_graph_is_optimised_is_optimised_after_it():
    robot = DriftingRobot(urgent_error=0.0, urgent_turn_error=0.0)
    robot.drives(islice(laps(), LAP + 12))
    robot.back_end.is_inconsistent = True
    robot.back_end.n_pending_closures = 1
    (first,) = robot.map_jobs.optimize()
    far = Pose2(*robot.back_end.graph.poses[0]).inverse() @ Pose2(*robot.back_end.graph.poses[-1])
    found = Constraint(0, int(robot.back_end.graph.nodes[-1]), far @ Pose2(0.02, 0, 0), SURE)
    assert not list(
        robot.map_jobs.on_constraints((robot.map_jobs.epoch, FoundConstraints([found], [], FarSearch())))
    ), "one runs at a time"
    (second,) = robot.map_jobs.on_graph_optimized(first.function(*first.arguments))
    assert second.done == "on_graph_optimized"
    assert not list(robot.map_jobs.on_graph_optimized(second.function(*second.arguments))), "nothing is left to do"
    assert robot.back_end.is_optimized


def test_a_closure_of_a_keyframe_that_was_given_up_meanwhile_is_left_out():
    robot = DriftingRobot()
    robot.drives(islice(laps(), 12))
    robot.take(robot.map_jobs.optimize())
    edges = robot.back_end.graph.n_edges
    robot.back_end.add_closures([Constraint(5, 99, Pose2(), SURE)])
    robot.back_end.add_pairwise([Constraint(5, 99, Pose2(), SURE)])
    assert robot.back_end.graph.n_edges == edges
    assert robot.back_end.is_optimized


def test_a_keyframe_of_a_few_beams_fits_anywhere_and_closes_nothing():
    def closures(n, **settings):
        robot = DriftingRobot(drift=Pose2())
        robot.drives(islice(laps(), LAP + 4))
        graph, keyframes, driven, blocks, config, *_ = robot.back_end.search_arguments()
        covariances = relative_covariances(graph, int(graph.nodes[-1]))
        last = keyframes[-1]
        points, normals = (array[:: len(last.normals) // n][:n] for array in (last.points, last.normals))
        few = Keyframe.of(last.stamp, last.local_from_base, last.origins, last.ends, points, normals, last.silent)
        config = config.model_copy(update=settings)
        return find_loop_closures(graph, covariances, (*keyframes[:-1], few), driven, blocks, config)

    assert closures(14) == []
    assert closures(40)
    assert closures(40, enabled=False) == []


def test_where_nothing_is_known_of_the_way_a_guess_that_fits_nothing_closes_nothing():
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), LAP + 5))
    graph, keyframes, _, blocks, config, *_ = robot.back_end.search_arguments()
    poses, last = graph.poses.copy(), len(graph.nodes) - 1
    poses[last] += (100.0, 100.0, 1.0)
    unknown = np.diag((np.inf, np.inf, np.inf))
    assert match_loop_closure(replace(graph, poses=poses), keyframes, 5, last, unknown, blocks, config) is None
    assert match_loop_closure(graph, keyframes, 5, last, unknown, blocks, config) is not None


@pytest.mark.parametrize("drift", [(1.2, 1.2, -0.3), (-1.4, 1.4, 0.3)])
def test_a_loop_closes_where_the_heading_drifted_by_more_than_the_graph_believes(drift):
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), LAP + 5))
    graph, keyframes, _, blocks, config, *_ = robot.back_end.search_arguments()
    poses, last = graph.poses.copy(), len(graph.nodes) - 1
    poses[last] += drift
    covariance = np.diag((0.4**2, 0.4**2, 0.02**2))
    closure = match_loop_closure(replace(graph, poses=poses), keyframes, 5, last, covariance, blocks, config)
    assert closure is not None
    true = robot.true_at[keyframes[5].stamp].inverse() @ robot.true
    assert closure.i_from_j.distance(true) < 0.05


def test_blocks_are_kept_within_their_memory_and_are_the_same_when_made_again(monkeypatch):
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), LAP))
    graph, keyframes, _, blocks, *_ = robot.back_end.search_arguments()
    rows = range(5, 120, 10)
    kept = [blocks.around(graph, keyframes, row) for row in rows]
    taken = memory(graph, keyframes)
    for least, most in ((blocks.n_bytes // 3, 0), (0, taken + blocks.n_bytes // 3)):
        monkeypatch.setattr(SubmapCache, "MIN_BYTES", least)
        monkeypatch.setattr(SubmapCache, "MAX_BYTES", most)
        for row, (submap, pyramid) in zip(rows, kept):
            again, drawn_again = blocks.around(graph, keyframes, row)
            assert_array_equal(again.registrar.map.points, submap.registrar.map.points)
            assert_array_equal(drawn_again.levels, pyramid.levels)
            assert blocks.n_bytes <= max(least, 1.05 * (most - taken))
        assert blocks.n_bytes > 0


def test_the_memory_of_a_map_stays_when_its_keyframes_become_more(monkeypatch):
    monkeypatch.setattr(SubmapCache, "MIN_BYTES", 0)
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), LAP))
    graph, keyframes, _, blocks, *_ = robot.back_end.search_arguments()
    monkeypatch.setattr(SubmapCache, "MAX_BYTES", memory(graph, keyframes) + blocks.n_bytes)
    sums = []
    for n in range(60, len(keyframes), 20):
        part = graph.subgraph_before(int(graph.nodes[n]))
        for row in range(5, n - 25, 10):
            blocks.around(part, keyframes[:n], row)
        sums.append(blocks.n_bytes + memory(part, keyframes[:n]))
    assert max(sums) <= 1.05 * SubmapCache.MAX_BYTES


def test_the_memory_of_a_keyframe_is_that_of_all_its_objects():
    keyframe = DriftingRobot().keyframe()
    values = [getattr(keyframe, field.name) for field in fields(keyframe)]
    whole = sys.getsizeof(keyframe) + sum(sys.getsizeof(value) for value in values)
    for pose in (keyframe.local_from_base, keyframe.odometry_residual):
        whole += sum(sys.getsizeof(value) for value in (pose.x, pose.y, pose.yaw))
    block = 4 * 2 * (2 * len(keyframe.ends) + len(keyframe.normals))  # points are some of the ends
    assert keyframe.n_bytes == pytest.approx(whole, rel=0.03)
    assert keyframe.n_bytes > block + 500
    print(whole - block, len(keyframe.ends))


def memory(graph, keyframes):
    """Bytes of a graph that grows by doubling, and of its keyframes."""
    arrays = sum(getattr(graph, field.name).nbytes for field in fields(graph))
    return 1.5 * arrays + sum(keyframe.n_bytes for keyframe in keyframes)


def test_who_turns_on_the_spot_for_ever_keeps_a_graph_of_one_size():
    robot = DriftingRobot(drift=Pose2())
    robot.drives([Pose2(0, 0, TURN)] * 300)
    n = len(robot.back_end.keyframes)
    robot.drives([Pose2(0, 0, TURN)] * 50)
    assert len(robot.back_end.keyframes) <= n < 200
    assert len(robot.back_end.keyframes) == len(robot.back_end.graph.nodes) == len(robot.back_end.driven)


def test_without_odometry_an_edge_is_as_unsure_as_the_beams_are():
    sure = []
    for doubt in (1.0, 5.0):
        robot = DriftingRobot()
        robot.stands()
        robot.local = Pose2(STEP, 0, 0)
        seen_across = Match(robot.local, np.diag((0.0, 1e4, 1e5)), np.ones(1, bool), 1.0)
        robot.back_end.add_keyframe(robot.keyframe(), seen_across, OdometryError(), doubt)
        sure.append(np.linalg.inv(robot.back_end.graph.snapshot().information[0]))
    assert sure[1][0, 0] > 15 * sure[0][0, 0]
    assert sure[1][1, 1] < 2 * sure[0][1, 1]


@pytest.mark.parametrize("kind", ["on_constraints", "on_graph_optimized", "on_map_drawn"])
def test_what_a_job_finds_for_another_map_is_thrown_away(kind):
    robot = DriftingRobot()
    robot.drives(islice(laps(), 12))
    robot.back_end.n_pending_closures, robot.back_end.map_shift = 1, 1.0
    orders = {
        "on_constraints": lambda: [
            robot.map_jobs._job(search_constraints, robot.back_end.search_arguments(), "on_constraints", 0.1)
        ],
        "on_graph_optimized": robot.map_jobs.optimize,
        "on_map_drawn": lambda: robot.map_jobs.redraw(robot.now),
    }
    (job,) = orders[kind]()
    robot.map_jobs.reset()
    robot.drives(islice(laps(), 3))
    before = robot.back_end.graph.snapshot()
    robot.jobs = [job]
    robot.take(())
    assert not robot.drawings
    assert_array_equal(robot.back_end.graph.poses, before.poses)
    assert robot.back_end.graph.n_edges == len(before.edges)


def test_small_corrections_add_up_until_the_map_is_drawn_again():
    robot = DriftingRobot()
    robot.drives(islice(laps(), 12))
    for n in range(3):
        assert not robot.back_end.needs_redraw, n
        graph = robot.back_end.graph.snapshot()
        moved = graph.poses + np.array((0.008, 0, 0))
        on = np.ones(len(graph.edges))
        robot.back_end.apply(OptimizationResult(graph.nodes, moved, graph.edges, on, on, 0, 0, 1, Pose2(0.008, 0, 0)))
    assert robot.back_end.needs_redraw
    robot.back_end.new_drawing()
    assert not robot.back_end.needs_redraw


def test_the_map_is_drawn_in_slices_that_let_others_by_and_shows_what_one_drawing_shows():
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), LAP + 60))
    assert len(robot.back_end.keyframes) > 2 * SLICE_KEYFRAMES
    robot.back_end.map_shift, robot.busy = 1.0, True
    robot.jobs = list(robot.map_jobs.redraw(100 * NS_PER_S))
    n_slices = 0
    while not robot.drawings:
        (job,) = (job for job in robot.jobs if job.done == "on_map_drawn")
        n_slices += 1
        robot.jobs = list(robot.redrawn(job.function(*job.arguments)))
        if n_slices == 1:
            robot.drives(islice(laps(), 5))  # meanwhile
    assert n_slices >= 4
    once = Occupancy(OccupancyConfig(), 0)
    for keyframe, correction in zip(robot.back_end.keyframes, robot.back_end.corrections()):
        keyframe.draw(once, correction @ keyframe.local_from_base)
    grid = robot.drawings[-1]
    assert grid.tile_index == once.tile_index
    assert_array_equal(grid.log_odds[: len(grid.tile_index)], once.log_odds[: len(grid.tile_index)])


def test_a_clock_that_is_set_back_does_not_keep_the_map_from_being_drawn():
    robot = DriftingRobot(drift=Pose2())
    robot.drives(islice(laps(), 5))
    for now in (1000 * NS_PER_S, 10 * NS_PER_S):
        robot.back_end.map_shift, robot.now = 1.0, now
        robot.take(robot.map_jobs.redraw(now))
        assert not robot.map_jobs.is_drawing
    assert len(robot.drawings) == 2
    robot.back_end.map_shift = 1.0
    assert not list(robot.map_jobs.redraw(11 * NS_PER_S)), "it rests between two drawings"


def test_who_drives_the_same_ring_for_ever_keeps_a_graph_of_one_size():
    robot = DriftingRobot(max_keyframes_per_place=3)
    motions = laps()
    robot.drives(islice(motions, 4 * LAP))
    assert len(robot.back_end.keyframes) < 1.6 * LAP
    edges = PairwiseConfig().n_partners + 3  # its ties, one to the next, and closures
    assert robot.back_end.graph.n_edges < edges * len(robot.back_end.keyframes)
    assert len(robot.back_end.keyframes) == len(robot.back_end.graph.nodes) == len(robot.back_end.driven)
    assert np.hypot(*robot.errors[:, :2].T).max() < 0.35


def visited(poses, sigma=0.05, **config):
    poses = np.array(poses, float)
    covariances = np.tile(np.diag((sigma**2, sigma**2, 1e-4)), (len(poses), 1, 1))
    driven = np.concatenate(([0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    return earlier_visits(poses, covariances, driven, LoopClosureConfig(**config), np.zeros(len(poses), np.bool_))


@pytest.mark.parametrize(("drift", "sure"), [(DRIFT, 0.2), (Pose2(), 2.0)])
def test_what_is_matched_with_holds_each_place_that_is_well_known_within_reach_and_nothing_else(
    drift, sure, monkeypatch
):
    """After each gathering, drawn or not, by the graph as it was then."""
    robot = DriftingRobot(drift, max_local_sigma=sure)
    drawn = []

    def gathered(graph, *arguments):
        found = build_local_map(graph, *arguments)
        sigma = np.sqrt(relative_covariances(graph, int(graph.nodes[-1]))[:, (0, 1), (0, 1)].max(axis=1))
        away = np.hypot(*(graph.poses[:, :2] - graph.poses[-1, :2]).T)
        known, held = sigma < robot.back_end.config.max_local_sigma, np.isin(graph.nodes, found.content.nodes)
        for pose in graph.poses[known & (away < robot.back_end._local_radius)]:
            off = np.abs(graph.poses[held] - pose)
            off[:, 2] = np.minimum(off[:, 2], 2 * pi - off[:, 2])
            assert (off < 2 * PLACE_SIZE).all(axis=1).any()
        assert known[held & (away < robot.back_end._local_radius + MARGIN_M)].all()
        drawn.append(found.submap is not None)
        return found

    monkeypatch.setattr("services.mapper.back_end.map_jobs.build_local_map", gathered)
    robot.drives(islice(laps(), 2 * LAP))
    assert any(drawn)
    if drift != DRIFT:
        assert len(drawn) - sum(drawn) > 2, "what is there will do"


def test_an_earlier_visit_is_one_near_place_a_pass_and_not_the_way_just_driven():
    there_and_back = [(x, 0, 0) for x in range(20)] + [(x, 1, pi) for x in range(19, 4, -1)]
    assert visited(there_and_back, min_path_between=12.0, view_radius=3.0) == [5]
    assert visited(there_and_back, min_path_between=100.0, view_radius=3.0) == []
    assert visited([(x, 0, 0) for x in range(20)], min_path_between=12.0, view_radius=3.0) == []


def test_how_far_around_is_looked_grows_with_doubt():
    ring = [(x, 0, 0) for x in range(20)] + [(x, 5, pi) for x in range(19, 4, -1)]
    assert visited(ring, sigma=0.05, view_radius=3.0) == []
    assert visited(ring, sigma=1.5, view_radius=3.0) == [5]


def test_information_is_turned_into_the_pose_s_own_axes_and_never_surer_than_the_noise():
    along = information_in_own_frame(np.diag((1e6, 1e-3, 1e6)), pi / 2, 1e-2 * np.eye(3), 0.02, 0.005)
    covariance = np.linalg.inv(along)
    assert covariance[0, 0] > 10, "along its own x, which is the map's y, nothing is known"
    assert covariance[1, 1] == pytest.approx(0.02**2, rel=0.05)
    assert covariance[2, 2] == pytest.approx(0.005**2, rel=0.1)


def test_ties_take_out_the_drift_before_any_loop_closes():
    left = []
    for partners in (3, 0):
        robot = DriftingRobot(pairwise=PairwiseConfig(n_partners=partners))
        robot.drives(islice(laps(), BEFORE_THE_LOOP))
        robot.take(robot.map_jobs.optimize())
        assert robot.back_end.n_loops == 0
        left.append(np.hypot(*robot.errors[:, :2].T).max())
    assert left[0] < 0.15 * left[1]


def test_a_wrong_closure_that_made_the_graph_sure_is_outvoted():
    robot = DriftingRobot(pairwise=PairwiseConfig(n_partners=0))  # they would not let it in
    robot.drives(islice(laps(), BEFORE_THE_LOOP))
    assert robot.back_end.n_loops == 0
    nodes = robot.back_end.graph.nodes
    true = (START.inverse() @ robot.true_at[robot.back_end.keyframes[0].stamp]).inverse() @ START.inverse() @ robot.true
    wrong = Pose2(true.x, true.y + 1.2, true.yaw)  # along the side of the ring that it comes down
    robot.back_end.add_closures([Constraint(int(nodes[0]), int(nodes[-1]), wrong, np.diag((2500.0, 2500.0, 4e4)))])
    robot.take(robot.map_jobs.optimize())
    assert np.hypot(*robot.errors[-1, :2]) > 0.8, "it took the wrong one"
    robot.drives(islice(laps(), BEFORE_THE_LOOP, LAP + 25))
    robot.take(robot.map_jobs.optimize())
    assert np.hypot(*robot.errors[-20:, :2].T).max() < 0.35
