# SPDX-License-Identifier: Apache-2.0
"""Made-up messages of each kind, with which services warm up: their kernels compile before the robot moves.

stamp: ns, of each message.
"""

from math import pi

import numpy as np

from shared import messages as m
from shared.config import Laser
from shared.geometry import Pose2
from shared.messages import TILE_CELLS
from shared.types import Float64s, Int8s

ORIGIN = Pose2()


def odometry(stamp: int, odom_from_base: Pose2 = ORIGIN, v: float = 0.0) -> m.Odometry:
    """Odometry without turn rate and covariance. v: m/s."""
    return m.Odometry(stamp, odom_from_base, v, 0.0, np.zeros(9))


def base_odometry(stamp: int, odom_from_base: Pose2 = ORIGIN, v: float = 0.0) -> m.BaseOdometry:
    """Pose and twist of a base that does its own odometry, with a covariance of 1 mm and 1 mrad. v: m/s."""
    square = np.diag([1e-6, 1e-6, 1e-6]).ravel()
    return m.BaseOdometry(
        stamp=stamp,
        epoch=stamp,
        has_pose=True,
        odom_from_base=odom_from_base,
        has_twist=True,
        v=v,
        vy=0.0,
        w=0.0,
        covariance=square,
        twist_covariance=np.zeros(9),
        battery=12.0,
    )


def pose_estimate(stamp: int, map_from_base: Pose2 = ORIGIN) -> m.PoseEstimate:
    """A good pose, where `odom` is `map`."""
    return m.PoseEstimate(
        stamp=stamp,
        map_from_base=map_from_base,
        map_from_odom=ORIGIN,
        covariance=np.zeros(9),
        quality=1.0,
        state=m.Localization.GOOD,
    )


def scan(stamp: int, laser: Laser, ranges: Float64s | float = 2.0) -> m.LaserScan:
    """A sweep that ends at `stamp`. ranges: (n_beams,) m, or one for all beams."""
    return m.LaserScan(
        stamp=stamp - round(laser.scan_time * 1e9),
        angle_min=laser.angle_min,
        angle_increment=laser.angle_increment,
        scan_time=laser.scan_time,
        range_min=laser.range_min,
        range_max=laser.range_max,
        ranges=np.broadcast_to(np.float32(ranges), laser.n_beams).copy(),
    )


def range_readings(stamp: int, n: int) -> m.RangeReadings:
    """n sensors that look back and see 0.5 m: an obstacle ahead would keep the controllers from their kernels."""
    columns = {"x": -0.1, "y": 0.0, "yaw": pi, "field_of_view": 0.5, "ranges": 0.5}
    return m.RangeReadings(stamp=stamp, **{name: np.full(n, value, np.float32) for name, value in columns.items()})


def map_update(stamp: int, cells: Int8s, version: int = 1) -> m.MapUpdate:
    """One tile at the origin, of 5 cm cells. cells: (TILE_CELLS, TILE_CELLS) int8, 0 free to 100 occupied."""
    return m.MapUpdate(
        stamp=stamp,
        map_id=1,
        version=version,
        resolution=0.05,
        rows=np.zeros(1, np.int32),
        columns=np.zeros(1, np.int32),
        cells=cells.reshape(1, TILE_CELLS**2).copy(),
    )


def zones(stamp: int, x: float, y: float) -> m.Zones:
    """A keep-out zone of 0.3 m, its lower left corner at (x, y), and a speed zone of 2 m around the origin."""
    corners_x, corners_y = np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])
    keep_out = m.Zone(0, "keep out", m.ZoneKind.KEEP_OUT, x + 0.3 * corners_x, y + 0.3 * corners_y)
    slow = m.Zone(0, "slow", m.ZoneKind.SLOW, 2.0 * corners_x - 1.0, 2.0 * corners_y - 1.0, speed=0.3)
    return m.Zones(stamp, (keep_out, slow))


def goal(stamp: int, goal_id: int, map_from_goal: Pose2) -> m.Goal:
    """A goal to be reached within 0.1 m and 0.1 rad. map_from_goal: its pose."""
    return m.Goal(
        stamp=stamp,
        id=goal_id,
        active=True,
        map_from_goal=map_from_goal,
        tolerance=0.1,
        yaw_tolerance=0.1,
        clear_costmap=False,
    )


def exploration_share(
    stamp: int, robot: str, others: tuple[str, ...], common_from_map: Pose2 = ORIGIN
) -> m.ExplorationShare:
    """What a robot without frontiers and map says to the others that explore with it."""
    none = np.zeros(0, np.float32)
    return m.ExplorationShare(
        stamp=stamp,
        robot=robot,
        session=1,
        sequence=1,
        task_id=1,
        others=others,
        active=True,
        common_from_map=common_from_map,
        x=0.0,
        y=0.0,
        frontier_xs=none,
        frontier_ys=none,
        frontier_costs=none,
        claimed=-1,
        closed_xs=none,
        closed_ys=none,
        seen_xs=none,
        seen_ys=none,
        cell=0.1,
        first_row=0,
        first_column=0,
        rows=0,
        columns=0,
        cells=b"",
    )


def path(stamp: int, goal_id: int, x: float) -> m.Path:
    """Straight from the origin to (x, 0)."""
    xs = np.linspace(0.0, x, 5)
    return m.Path(
        stamp=stamp,
        goal_id=goal_id,
        map_version=1,
        reason="",
        xs=xs,
        ys=np.zeros(5),
        yaws=np.zeros(5),
        length=abs(x),
        cost=abs(x),
    )
