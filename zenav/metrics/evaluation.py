# SPDX-License-Identifier: Apache-2.0
"""How well a run went, against what only the simulator knows: pose, map, floor, contacts."""

from dataclasses import dataclass, field
from math import pi
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from services.sim.sensors import sweep_ranges
from services.sim.world import World
from shared.geometry import Pose2, wrapped_all
from shared.grid import OccupancyGrid
from shared.messages import MapUpdate, Message, Odometry, PoseEstimate, Truth
from shared.types import Float64s
from zenav.metrics.stability import Ride

TRACK_TOPICS = ("sim/truth", "odom", "pose", "map", "plan", "nav/status")
"""The topics that a score needs."""

FLOOR_CELL = 0.05  # m: side of the cells in which the floor is counted
OUTLINE_STEP = 0.01  # m between the points that stand for the true outline
MAX_WALL_ERROR_M = 0.05  # m: a wall that is drawn this near to a true one is where it should be
VIEW_STEP = 0.4  # m between the places from which surfaces are looked at
N_VIEW_BEAMS = 720  # beams of a full turn at each: 0.5 degrees
BESIDE_BEAM = 0.025  # m: a point of a surface this near to a beam's end is seen; walls are twice as thick
MOVING = 0.02  # m/s, or rad/s times a tenth: faster than that is motion


@dataclass
class RunTrack:
    """What was heard during a run. `take` is fast enough for a transport's thread."""

    truths: list[tuple[int, float, float, float]] = field(default_factory=list)  # stamp, world_from_base
    odoms: list[tuple[int, int, float, float, float]] = field(default_factory=list)  # sent, stamp, odom_from_base
    poses: list[tuple[int, int, Pose2, Pose2]] = field(default_factory=list)  # sent, stamp, from_base, from_odom
    grid: OccupancyGrid = field(default_factory=OccupancyGrid)
    truth: Truth | None = None
    first_motion: int | None = None  # ns on the stack's clock
    ride: Ride = field(default_factory=Ride)

    def add(self, message: Message, sent: int) -> None:
        """Takes a message of one of KEYS; `sent` ns on the stack's clock."""
        self.ride.add(message)
        if isinstance(message, Truth):
            self.truth, at = message, message.world_from_base
            self.truths.append((message.stamp, at.x, at.y, at.yaw))
            if self.first_motion is None and abs(message.v) + 0.1 * abs(message.w) > MOVING:
                self.first_motion = message.stamp
        elif isinstance(message, Odometry):
            at = message.odom_from_base
            self.odoms.append((sent, message.stamp, at.x, at.y, at.yaw))
        elif isinstance(message, PoseEstimate):
            self.poses.append((sent, message.stamp, message.map_from_base, message.map_from_odom))
        elif isinstance(message, MapUpdate):
            self.grid.apply(message)

    @property
    def world_from_map(self) -> Pose2:
        return self.truth.start if self.truth is not None else Pose2()

    @property
    def true_trajectory(self) -> Float64s:
        """(n, 3) world_from_base."""
        return np.array([row[1:] for row in self.truths]).reshape(-1, 3)

    @property
    def estimated_trajectory(self) -> Float64s:
        """(n, 3) the mapper's poses, in the world."""
        poses = (self.world_from_map @ pose for _, _, pose, _ in self.poses)
        return np.array([(p.x, p.y, p.yaw) for p in poses]).reshape(-1, 3)


def pose_errors(track: RunTrack) -> tuple[Float64s, Float64s]:
    """(n,) m and (n,) rad: the pose that control drives by (newest map_from_odom @ odom_from_base) against the truth.

    One value an odometry message, at its stamp; the truth is interpolated there.
    """
    if not track.poses or not track.odoms or len(track.truths) < 2:
        return np.zeros(0), np.zeros(0)
    truth, odom = np.array(track.truths), np.array(track.odoms)
    epoch = track.truths[0][0]
    true_stamps = np.array([row[0] - epoch for row in track.truths], float)
    stamps = np.array([row[1] - epoch for row in track.odoms], float)
    i_pose = np.searchsorted([row[0] for row in track.poses], [row[0] for row in track.odoms], side="right") - 1
    used = (i_pose >= 0) & (stamps >= true_stamps[0]) & (stamps <= true_stamps[-1])
    corrections = [track.world_from_map @ row[3] for row in track.poses]
    world_from_odom = np.array([(p.x, p.y, p.yaw) for p in corrections])[i_pose[used]]
    c, s = np.cos(world_from_odom[:, 2]), np.sin(world_from_odom[:, 2])
    x = world_from_odom[:, 0] + c * odom[used, 2] - s * odom[used, 3]
    y = world_from_odom[:, 1] + s * odom[used, 2] + c * odom[used, 3]
    yaw = world_from_odom[:, 2] + odom[used, 4]
    at = stamps[used]
    true_x, true_y = (np.interp(at, true_stamps, truth[:, i]) for i in (1, 2))
    true_yaw = np.interp(at, true_stamps, np.unwrap(truth[:, 3]))
    return np.hypot(x - true_x, y - true_y), np.abs(wrapped_all(yaw - true_yaw))


def explored_share(grid: OccupancyGrid, world: World, world_from_map: Pose2, radius: float) -> float:
    """Share of the floor that a disc of `radius` m can cover from the start, whose cells the map knows."""
    floor, x0, y0 = world.reachable(FLOOR_CELL, radius)
    rows, columns = np.nonzero(floor)
    if not len(rows) or grid.empty:
        return 0.0
    in_world = np.column_stack((x0 + (columns + 0.5) * FLOOR_CELL, y0 + (rows + 0.5) * FLOOR_CELL))
    cells = grid.cells_of(world_from_map.inverse() @ in_world)
    h, w = grid.cells.shape
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < h) & (cells[:, 1] < w)
    known = np.zeros(len(cells), bool)
    known[inside] = grid.cells[cells[inside, 0], cells[inside, 1]] >= 0
    return float(known.mean())


def occupied_middles(grid: OccupancyGrid, world_from_map: Pose2) -> Float64s:
    """(n, 2) m in the world: the middles of the map's occupied cells."""
    rows, columns = np.nonzero(grid.occupied)
    middle = (columns + 0.5) * grid.resolution + grid.x0, (rows + 0.5) * grid.resolution + grid.y0
    return world_from_map @ np.column_stack(middle)


def map_errors(grid: OccupancyGrid, world: World, world_from_map: Pose2) -> Float64s:
    """(n,) m: from the middle of each occupied cell of the map to the nearest true surface."""
    middles, outline = occupied_middles(grid, world_from_map), _points_on(world.outline())
    if not len(middles) or not len(outline):
        return np.zeros(0)
    return np.asarray(cKDTree(outline).query(middles)[0], float)


def aligned_map_errors(grid: OccupancyGrid, world: World, world_from_map: Pose2) -> tuple[Float64s, Pose2]:
    """`map_errors` after the small rigid motion, in the world, that fits the map best; and that motion.

    What is left of the errors then is the map's own; what went was its frame, which the first scan alone has placed.
    """
    from scipy.optimize import least_squares  # 7 MB and 0.1 s, which a launcher does not need

    middles, outline = occupied_middles(grid, world_from_map), _points_on(world.outline())
    if not len(middles) or not len(outline):
        return np.zeros(0), Pose2()
    tree, centre = cKDTree(outline), middles.mean(axis=0)
    apart = middles - centre

    def about_centre(row: Float64s) -> Pose2:
        return Pose2(float(row[0] + centre[0]), float(row[1] + centre[1]), float(row[2]))

    def rest(row: Float64s) -> Float64s:
        return np.asarray(np.minimum(tree.query(about_centre(row) @ apart)[0], 3 * MAX_WALL_ERROR_M), float)

    best = about_centre(least_squares(rest, np.zeros(3), x_scale=(0.01, 0.01, 0.001), diff_step=0.01).x)
    return np.asarray(tree.query(best @ apart)[0], float), best @ Pose2(-float(centre[0]), -float(centre[1]))


def visible_surface(world: World, radius: float, reach: float) -> Float64s:
    """(n, 2) m, points OUTLINE_STEP apart on all true surfaces that a laser on the robot's middle could see.

    It looks around from all over the floor: each place, VIEW_STEP apart, to which a disc of `radius` m gets from the
    start; `reach` m far. People and what the robot itself hides are left out.
    """
    centres, x0, y0 = world.centres(FLOOR_CELL, radius)
    step = round(VIEW_STEP / FLOOR_CELL)
    rows, columns = np.nonzero(centres[::step, ::step])
    places = np.column_stack((x0 + (columns * step + 0.5) * FLOOR_CELL, y0 + (rows * step + 0.5) * FLOOR_CELL))
    outline = _points_on(world.outline())
    places = np.vstack((places, (world.start.x, world.start.y)))
    if not centres.any() or not len(outline):
        return np.zeros((0, 2))
    turn = 2 * pi / N_VIEW_BEAMS
    angles = np.arange(N_VIEW_BEAMS) * turn
    unit = np.column_stack((np.cos(angles), np.sin(angles)))
    ends = []
    for place in places:
        standing = np.array([(*place, 0.0)] * 2)
        ranges = sweep_ranges(world.cells, standing, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, turn, N_VIEW_BEAMS, reach)
        hit = np.isfinite(ranges)
        ends.append(place + ranges[hit, None] * unit[hit])
    x, y = np.rint(np.concatenate(ends).T / OUTLINE_STEP)
    once = np.unique(x + 1j * y) * OUTLINE_STEP
    visible_points = np.column_stack((once.real, once.imag))
    away, _ = cKDTree(visible_points).query(outline, distance_upper_bound=BESIDE_BEAM)
    return np.asarray(outline[np.isfinite(away)])


def completeness(grid: OccupancyGrid, world: World, world_from_map: Pose2, radius: float, reach: float) -> float:
    """Share of the visible true surfaces within NEAR m of the middle of an occupied cell of the map.

    `map_errors` asks how much of the map is true, this how much of the truth is in the map: recall beside precision
    (Knapitsch et al. 2017, "Tanks and Temples", section 4). radius, reach: as for `visible_surface`.
    """
    middles, surface = occupied_middles(grid, world_from_map), visible_surface(world, radius, reach)
    if not len(middles) or not len(surface):
        return 0.0
    return float(np.isfinite(cKDTree(middles).query(surface, distance_upper_bound=MAX_WALL_ERROR_M)[0]).mean())


def _points_on(segments: Float64s) -> Float64s:
    """Points along segments (n, 4), at most OUTLINE_STEP m apart: (m, 2)."""
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    counts = np.ceil(lengths / OUTLINE_STEP).astype(int) + 1
    owner = np.repeat(np.arange(len(segments)), counts)
    nth = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (nth / np.maximum(counts[owner] - 1, 1))[:, None]
    return np.asarray(segments[owner, :2] * (1 - share) + segments[owner, 2:] * share)


def evaluation_summary(track: RunTrack, world: World, radius: float, reach: float) -> dict[str, Any]:
    """The figures of a run. radius: m, of the circle around the footprint; reach: m, the laser's largest range."""
    metres, radians = pose_errors(track)
    walls = map_errors(track.grid, world, track.world_from_map)
    truth = track.truth
    seconds = (track.truths[-1][0] - track.truths[0][0]) / 1e9 if track.truths else 0.0
    return {
        "explored_share": round(explored_share(track.grid, world, track.world_from_map, radius), 4),
        "map_within_5_cm": round(float((walls <= MAX_WALL_ERROR_M).mean()), 4) if len(walls) else 0.0,
        "map_completeness": round(completeness(track.grid, world, track.world_from_map, radius, reach), 4),
        "map_error_mean_m": round(float(walls.mean()), 4) if len(walls) else None,
        "pose_error_mean_m": round(float(metres.mean()), 4) if len(metres) else None,
        "pose_error_max_m": round(float(metres.max()), 4) if len(metres) else None,
        "pose_error_mean_deg": round(float(np.degrees(radians.mean())), 3) if len(radians) else None,
        "pose_error_max_deg": round(float(np.degrees(radians.max())), 3) if len(radians) else None,
        "collisions": truth.n_contacts if truth is not None else 0,
        "distance_m": round(truth.distance, 2) if truth is not None else 0.0,
        "seconds": round(seconds, 1),
        **track.ride.figures(),
    }
