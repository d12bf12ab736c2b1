# SPDX-License-Identifier: Apache-2.0
"""After a restart: the map and the pose that were published last, and where the robot is by now."""

from services.mapper.odometry_track import OdometryTrack
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MapUpdate, PoseEstimate

SECOND = 1_000_000_000


class Before:
    """What is known from before a restart, as it comes in."""

    def __init__(self) -> None:
        self.map: MapUpdate | None = None
        self.pose: PoseEstimate | None = None

    def known(self) -> tuple[MapUpdate, OccupancyGrid, PoseEstimate] | None:
        """The map, its grid and how the robot was on it; None until all are known and the map tells anything."""
        if self.map is None or self.pose is None:
            return None
        grid = OccupancyGrid(self.map.resolution, self.map.map_id)
        grid.apply(self.map)
        return (self.map, grid, self.pose) if grid.occupied.any() else None

    def whereabouts(self, track: OdometryTrack, end: int, max_speed: float) -> tuple[Pose2, Pose2] | None:
        """Where the robot is by odometry, which went on meanwhile, and where it was; asked once, at the first scan.

        None where odometry was restarted too.
        """
        before, self.pose = self.pose, None
        if before is None or self.map is None or not track.samples:
            return None
        guess = before.map_from_odom @ track.odom_from_start(end) @ track.at(end)
        farthest = max_speed * max(end - before.stamp, 0) / SECOND + 0.5
        return (guess, before.map_from_base) if guess.distance(before.map_from_base) <= farthest else None
