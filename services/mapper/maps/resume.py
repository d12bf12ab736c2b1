# SPDX-License-Identifier: Apache-2.0
"""Resumption after a restart: the last published map and pose, and the pose that odometry gives since then."""

from services.mapper.front_end.continuous_odometry import ContinuousOdometry
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MapUpdate, PoseEstimate
from shared.types import NS_PER_S

MAX_JUMP_M = 0.5  # of the resumed pose, beyond what the robot can drive


class PreviousRun:
    """The latched messages of the mapper's previous run, as they arrive."""

    def __init__(self) -> None:
        self.map: MapUpdate | None = None
        self.pose: PoseEstimate | None = None

    def state(self) -> tuple[MapUpdate, OccupancyGrid, PoseEstimate] | None:
        """Returns the map, its grid and the last pose; None until both arrived, or without occupied cells."""
        if self.map is None or self.pose is None:
            return None
        grid = OccupancyGrid(self.map.resolution, self.map.map_id)
        grid.apply(self.map)
        return (self.map, grid, self.pose) if grid.occupied.any() else None

    def take_poses(self, track: ContinuousOdometry, end: int, max_speed: float) -> tuple[Pose2, Pose2] | None:
        """Returns the present map_from_base by odometry, and the last published one; once, for the first scan.

        end: ns, of that scan.  max_speed: m/s.  None if odometry was restarted too.
        """
        last, self.pose = self.pose, None
        if last is None or self.map is None or not track.samples:
            return None
        guess = last.map_from_odom @ track.odom_from_start(end) @ track.start_from_base(end)
        max_distance = max_speed * max(end - last.stamp, 0) / NS_PER_S + MAX_JUMP_M
        return (guess, last.map_from_base) if guess.distance(last.map_from_base) <= max_distance else None
