# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from importlib import import_module
from itertools import islice
from math import cos, hypot, sin
from pkgutil import walk_packages

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import services.mapper
from services.mapper.back_end.config import BackEndConfig
from services.mapper.back_end.loop_closure import LoopClosureConfig
from services.mapper.config import MapperConfig
from services.mapper.grid.occupancy import OccupancyConfig
from services.mapper.service import MapperService
from shared.geometry import Pose2, arc, wrapped
from shared.messages import Localization, Odometry
from shared.requests import LoadMap
from shared.types import NS_PER_S
from tests.unit.services.mapper.rooms import CORRIDOR, LAP, RING, ROBOT, ROOM, START, RoomDrive, laps

ROUND = [arc(0.06, 0.12 + 0.08 * sin(k / 3)) for k in range(40)]


def driven(motions=ROUND, config=None, noise=0.01, with_odometry=True, segments=ROOM):
    robot = RoomDrive(segments, config, noise)
    for motion in motions:
        robot.step(motion, with_odometry)
    return robot


def small(error, metres=0.03, radians=0.015):
    return hypot(error.x, error.y) < metres and abs(error.yaw) < radians


def kernels():
    """All that is compiled in the mapper, by name."""
    found = walk_packages(services.mapper.__path__, "services.mapper.")
    modules = [import_module(module.name) for module in found if not module.name.endswith("__main__")]
    return {
        f"{module.__name__}.{name}": kernel
        for module in modules
        for name, kernel in vars(module).items()
        if hasattr(kernel, "signatures")
    }


def test_the_pose_follows_the_robot_through_a_sweep_that_it_moves_in():
    robot = driven()
    assert small(robot.error)
    assert robot.poses[0].map_from_base == Pose2()
    assert robot.poses[0].state is Localization.STARTING
    assert all(pose.state is Localization.GOOD for pose in robot.poses[1:])
    assert robot.poses[-1].stamp == robot.now  # the sweep's end, not its start


def test_the_pose_in_odom_takes_odometry_to_the_pose_on_the_map():
    robot = driven()
    last = robot.poses[-1]
    odom_from_base = robot.odom_from_start @ robot.true
    back = (last.map_from_odom @ odom_from_base).inverse() @ last.map_from_base
    assert hypot(back.x, back.y) < 1e-6
    assert abs(back.yaw) < 1e-6


def test_the_same_events_give_the_same_bytes_twice():
    def run():
        robot = driven()
        robot.publish_map()
        return [repr(pose) for pose in robot.poses], [update.cells.tobytes() for update in robot.maps]

    assert run() == run()


def test_nothing_is_compiled_after_warming_up():
    MapperService(MapperConfig(), ROBOT).warm_up()
    before = {name: list(kernel.signatures) for name, kernel in kernels().items()}
    assert len(before) >= 30
    robot = driven(ROUND[:15], with_odometry=True)
    for _ in range(5):
        robot.step(arc(0.05, 0.1), with_odometry=False)
    robot.publish_map()
    often = BackEndConfig(urgent_error=0.0, redraw_interval=0.0)
    lap = RoomDrive(RING, MapperConfig(loop_closure=LoopClosureConfig(min_path_between=8.0), back_end=often))
    lap.true = START
    for motion in islice(laps(), LAP + 10):
        lap.step(motion)
        lap.publish_map()
    assert lap.mapper.back_end.n_loops > 0
    assert {name: list(kernel.signatures) for name, kernel in kernels().items()} == before


def test_warming_up_changes_nothing():
    cold, warm = MapperService(MapperConfig(), ROBOT), MapperService(MapperConfig(), ROBOT)
    warm.warm_up()
    assert warm.state() == cold.state()
    assert not warm.slam.grid.tile_index
    assert not warm.scan_queue.odometry.samples


def test_a_restarted_odometry_does_not_move_the_pose_on_the_map():
    robot = driven(ROUND[:20])
    robot.odom_from_start = robot.true.inverse()  # the publisher starts again at 0
    for motion in ROUND[20:]:
        robot.step(motion)
    assert small(robot.error)
    assert any("jumped" in line for line in robot.logs)
    last = robot.poses[-1]
    assert small((last.map_from_odom @ robot.odom_from_start @ robot.true).inverse() @ last.map_from_base, 1e-6, 1e-6)


def test_without_odometry_scan_matching_goes_on_alone_and_says_so():
    robot = driven(ROUND[:10])
    for motion in ROUND[10:]:
        robot.step(motion, with_odometry=False)
    assert "no odometry" in robot.mapper.state()
    assert small(robot.error, 0.06, 0.03)
    for motion in ROUND[:10]:
        robot.step(motion)
    assert "no odometry" not in robot.mapper.state()
    assert small(robot.error, 0.06, 0.03)


def test_a_robot_that_never_had_odometry_is_followed():
    robot = driven([arc(0.04, 0.02)] * 30, with_odometry=False)
    assert small(robot.error, 0.06, 0.03)


def test_odometry_ten_percent_wrong_is_made_good():
    robot = RoomDrive(ROOM, noise=0.01)
    wrong, true = Pose2(), robot.true
    for motion in ROUND * 2:
        begin, start = robot.now, robot.true
        for k in range(1, 21):
            robot.now = begin + k * NS_PER_S // 100
            pose = wrong @ Pose2(motion.x * 1.1 * k / 20, motion.y * 1.1 * k / 20, motion.yaw * 0.9 * k / 20)
            robot.mapper.now = robot.now
            robot.take(robot.mapper.odometry(Odometry(robot.now, pose, 0.0, 0.0, np.zeros(9))))
        wrong = pose
        parts = [start @ Pose2(motion.x * k / 20, motion.y * k / 20, motion.yaw * k / 20) for k in range(10, 21)]
        robot.true = start @ motion
        robot.take(robot.mapper.scan(robot.scan(parts, robot.now - NS_PER_S // 10)))
        if len(robot.poses) == 1:
            robot.first = robot.true
    assert true != robot.true
    assert small(robot.error)
    assert robot.mapper.front_end.odometry_error.forward_scale.value == pytest.approx(1 / 1.1, abs=0.04)


def test_in_a_corridor_the_covariance_grows_along_it_alone():
    robot = driven([Pose2(0.1, 0, 0)] * 40, segments=CORRIDOR)
    covariance = robot.poses[-1].covariance.reshape(3, 3)
    assert covariance[0, 0] > 20 * covariance[1, 1]
    room = driven().poses[-1].covariance.reshape(3, 3)
    assert covariance[0, 0] > 10 * room[0, 0]
    assert np.linalg.eigvalsh(room)[0] > 0


def test_in_a_corridor_without_odometry_the_graph_is_unsure_along_it():
    along = []
    for with_odometry in (True, False):
        robot = driven([Pose2()], MapperConfig(), 0.01, with_odometry, CORRIDOR)
        robot.mapper.scan_queue.velocity = Pose2(0.5, 0.0, 0.0)  # it comes from where it could see how fast it is
        for _ in range(12):
            robot.step(arc(0.1, 0.0), with_odometry)
        graph = robot.mapper.back_end.graph.snapshot()
        along.append(np.linalg.inv(graph.information[~graph.loop][-1])[0, 0])
    assert along[1] > 15 * along[0]


def test_a_scan_waits_for_odometry_to_cover_its_end_but_not_for_ever():
    robot = driven(ROUND[:5])
    n = len(robot.poses)
    scan = robot.scan([robot.true, robot.true], robot.now)
    robot.now += NS_PER_S // 10
    robot.mapper.now = robot.now
    robot.take(robot.mapper.scan(scan))
    assert len(robot.poses) == n
    robot.odometry(robot.now, robot.true)
    assert len(robot.poses) == n + 1
    late = robot.scan([robot.true, robot.true], robot.now)
    robot.now += NS_PER_S // 10
    robot.mapper.now = robot.now
    robot.take(robot.mapper.scan(late))
    robot.take(robot.mapper.release())
    assert len(robot.poses) == n + 1
    robot.mapper.now += NS_PER_S // 10
    robot.take(robot.mapper.release())
    assert len(robot.poses) == n + 2


@pytest.mark.parametrize(
    ("shift", "why"), [(-NS_PER_S // 5, "sequence"), (0, "sequence"), (-5 * NS_PER_S, "old"), (5 * NS_PER_S, "ahead")]
)
def test_scans_from_another_time_are_dropped_and_counted(shift, why):
    robot = driven(ROUND[:5])
    n = len(robot.poses)
    stamp = robot.poses[-1].stamp - NS_PER_S // 10
    robot.take(robot.mapper.scan(robot.scan([robot.true, robot.true], stamp + shift)))
    assert len(robot.poses) == n
    assert robot.mapper.scan_queue.n_dropped[why] == 1
    assert any("dropped" in line for line in robot.logs)


def test_a_burst_of_stale_scans_is_dropped():
    robot = driven(ROUND[:5])
    robot.now += 10 * NS_PER_S
    robot.mapper.now = robot.now
    robot.take(robot.mapper.scan(robot.scan([robot.true, robot.true], robot.now - 5 * NS_PER_S)))
    assert robot.mapper.scan_queue.n_dropped["old"] == 1


def test_a_clock_that_is_set_back_stops_nothing():
    robot = driven(ROUND[:20])
    robot.now = NS_PER_S
    n = len(robot.poses)
    for motion in ROUND[20:]:
        robot.step(motion)
    assert len(robot.poses) == n + 20
    assert small(robot.error)


@pytest.mark.parametrize("bad", [np.nan, 0.0, 100.0])
def test_scans_that_measure_nothing_leave_the_pose_to_odometry(bad):
    robot = driven(ROUND[:20])
    whole, n = robot.scan, ROBOT.laser.n_beams
    robot.scan = lambda poses, stamp: replace(whole(poses, stamp), ranges=np.full(n, bad, np.float32))
    for motion in ROUND[20:30]:
        robot.step(motion)
    assert small(robot.error, 0.1, 0.1)
    assert robot.poses[-1].state is Localization.POOR
    robot.scan = whole
    for motion in ROUND[30:]:
        robot.step(motion)
    assert small(robot.error)
    assert robot.poses[-1].state is Localization.GOOD


def test_a_robot_that_is_carried_away_is_lost_and_does_not_spoil_the_map():
    robot = driven(ROUND)
    robot.publish_map()
    before = robot.grid.cells
    elsewhere = RoomDrive(np.array([(-1.0, -9.0, -0.4, 9.0), (0.8, -9.0, 1.6, 9.0), (-2, 0.7, 2, 0.8)]))
    elsewhere.mapper, elsewhere.now, elsewhere.poses = robot.mapper, robot.now, robot.poses
    elsewhere.odom_from_start = robot.odom_from_start @ robot.true
    for _ in range(30):
        elsewhere.step(Pose2(0, 0, 0.01))
    assert robot.poses[-1].state is Localization.LOST
    elsewhere.publish_map()
    robot.maps += elsewhere.maps
    changed = np.mean((robot.grid.cells[: before.shape[0], : before.shape[1]] >= 65) != (before >= 65))
    assert changed < 0.01


def test_the_map_shows_the_room():
    robot = driven()
    robot.publish_map()
    grid = robot.grid
    start = robot.first
    walls = []
    for x0, y0, x1, y1 in ROOM[:4]:
        for share in np.linspace(0.05, 0.95, 30):
            walls.append((x0 + share * (x1 - x0), y0 + share * (y1 - y0)))
    points = start.inverse() @ np.array(walls)
    near = []
    for x, y in points:
        row, column = grid.cell(x, y)
        near.append(grid.occupied[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].any())
    assert np.mean(near) > 0.75  # the rest hides behind the furniture
    row, column = grid.cell(*(robot.first.inverse() @ np.array([(robot.true.x, robot.true.y)]))[0])
    assert grid.free[row, column]


def test_a_loaded_map_is_localised_in_and_extended():
    robot = driven()
    robot.publish_map()
    saved = robot.mapper.slam.grid.all_tiles(robot.now)
    cells = robot.grid.cells
    fresh = RoomDrive(ROOM, noise=0.01)
    fresh.now, fresh.true = robot.now, robot.true
    fresh.odom_from_start = Pose2(-7, 2, 1)
    fresh.step(Pose2())
    true = robot.first.inverse() @ robot.true
    wrong = Pose2(true.x + 0.25, true.y - 0.2, true.yaw + 0.2)
    fresh.maps.clear()
    answer = fresh.mapper.load_map(LoadMap(fresh.now, saved, wrong))
    reply = None
    while reply is None:
        try:
            fresh.take([next(answer)])
        except StopIteration as end:
            reply = end.value
    assert reply.accepted
    assert_array_equal(fresh.grid.cells, cells)
    for motion in ROUND[:20]:
        fresh.step(motion)
    fresh.first = robot.first
    assert small(fresh.error, 0.05, 0.02)
    assert fresh.poses[-1].state is Localization.GOOD


@pytest.mark.parametrize("what", ["empty", "apart"])
def test_a_map_that_cannot_be_used_is_refused_and_changes_nothing(what):
    robot = driven(ROUND[:3])
    robot.publish_map()
    saved = robot.mapper.slam.grid.all_tiles(robot.now)
    if what == "empty":
        saved = replace(saved, cells=np.zeros_like(saved.cells))
    else:
        saved = replace(saved, rows=np.linspace(-30000, 30000, len(saved.rows)).astype(np.int32))
        saved = replace(saved, columns=saved.rows)
    grid = robot.mapper.slam.grid
    with pytest.raises(StopIteration) as end:
        next(robot.mapper.load_map(LoadMap(robot.now, saved, Pose2())))
    assert not end.value.value.accepted
    assert robot.mapper.slam.grid is grid


def test_a_laser_that_knows_no_echo_may_carve_free_space():
    config = MapperConfig(occupancy=OccupancyConfig(no_echo_free=0.9))
    hall = np.array([(-1.0, -30.0, -1.0, 30.0)])
    silent, carving = RoomDrive(hall, None), RoomDrive(hall, config)
    for robot in (silent, carving):
        for _ in range(3):
            robot.step(Pose2())
        robot.publish_map()
    laser = 0.1, -0.02
    ahead = laser[0] + 4 * cos(0.1), laser[1] + 4 * sin(0.1)
    assert not silent.grid.holds(*silent.grid.cell(*ahead)) or silent.grid.unknown[silent.grid.cell(*ahead)]
    assert carving.grid.free[carving.grid.cell(*ahead)]
    for _ in range(8):
        carving.step(Pose2(0.15, 0.0, 0.0))
    carving.mapper.back_end.map_shift = 1.0  # redrawn from five keyframes, it says the same
    carving.publish_map()
    carving.publish_map()
    assert not carving.mapper.back_end.needs_redraw
    assert carving.grid.free[carving.grid.cell(*ahead)]


def test_someone_who_walks_down_a_corridor_does_not_pull_the_robot_along():
    robot = RoomDrive(CORRIDOR, noise=0.01)
    for _ in range(25):
        robot.step(Pose2(0.1, 0, 0))
    for k in range(20):  # overtakes the robot at 0.6 m/s, an arm's length away
        x = robot.true.x - 1 + 0.22 * k
        robot.segments = np.concatenate(
            (CORRIDOR, [(x, 0.4, x + 0.25, 0.4), (x, 0.4, x, 0.6), (x + 0.25, 0.4, x + 0.25, 0.6)])
        )
        robot.step(Pose2(0.1, 0, 0))
    assert abs(robot.error.x) < 0.12
    assert abs(wrapped(robot.error.yaw)) < 0.01
