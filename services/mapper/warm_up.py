# SPDX-License-Identifier: Apache-2.0
"""Warm-up of the mapper: scans of a made-up room compile all kernels before the robot moves."""

from typing import TYPE_CHECKING

import numpy as np

from services.mapper.back_end.back_end import BackEnd
from services.mapper.back_end.local_map import build_local_map
from services.mapper.back_end.loop_closure import match_loop_closure
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.back_end.solver.optimize import optimize
from services.mapper.grid.map_drawing import draw_slice
from shared import sample_messages as sample
from shared.geometry import Pose2
from shared.requests import LoadMap
from shared.service import Job
from shared.types import NS_PER_S

if TYPE_CHECKING:
    from services.mapper.service import MapperService

N_SCANS = 4


def warm_up(mapper: "MapperService") -> None:
    """Calls every kernel once. mapper: of no use afterwards."""
    laser = mapper.robot.laser
    angles = laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
    for i in range(N_SCANS):
        stamp = (i + 1) * NS_PER_S
        mapper.now = stamp + NS_PER_S
        ranges = np.minimum(2.0 + 0.01 * i, 1.0 / np.maximum(np.abs(np.cos(angles)), 0.2))  # two walls
        list(mapper.odometry(sample.odometry(stamp, Pose2(0.3 * i), v=0.3)))
        list(mapper.scan(sample.scan(stamp, laser, ranges)))
        mapper.front_end.aligner.searches_next = True
    beams = np.zeros((laser.n_beams, 2))
    mapper.slam.grid.contradicts(beams, beams)
    mapper.slam.grid.is_near_occupied(beams)
    points = np.ascontiguousarray(0.3 * np.argwhere(np.ones((60, 60))))  # so many that the point map grows
    mapper.front_end.submap.registrar.add_points(points, np.zeros((len(points), 2)))
    back_end, tracked = mapper.back_end, mapper.slam.tracked
    if tracked is not None and back_end.keyframes:
        back_end.add_keyframe(back_end.keyframes[0], tracked.match, mapper.front_end.odometry_error)
        warm_up_back_end(back_end)
    list(mapper.publish_map())
    load = LoadMap(mapper.now, mapper.slam.grid.all_tiles(mapper.now), Pose2())
    for item in mapper.load_map(load):
        if isinstance(item, Job):
            mapper.on_virtual_keyframes(item.function(*item.arguments))


def warm_up_back_end(back_end: BackEnd) -> None:
    """Calls every kernel of the back end once. back_end: with two keyframes or more, of no use afterwards."""
    graph, last = back_end.graph.snapshot(), len(back_end.keyframes) - 1
    covariances = relative_covariances(graph, int(graph.nodes[last]))
    match_loop_closure(graph, back_end.keyframes, 0, last, covariances[0], back_end.submaps, back_end.closure_config)
    wrong = back_end.graph.pose(0).inverse() @ back_end.graph.pose(last) @ Pose2(0.5, 0.0, 0.1)
    back_end.graph.add_edge(0, last, wrong, np.eye(3), loop=True)
    back_end.apply(optimize(*back_end.optimization_arguments()))
    draw_slice(back_end.new_drawing())
    build_local_map(*back_end.local_map_arguments())
