# SPDX-License-Identifier: Apache-2.0
"""The freshest pose on the map: the mapper's correction, carried on by odometry."""

from shared.geometry import Pose2
from shared.messages import Localization, Odometry, PoseEstimate

TELEPORT = 0.5
"""m between two corrections that no driving explains."""
TOP_SPEED = 5.0
"""m/s between two odometry messages, beyond TELEPORT, that no driving explains."""


class Whereabouts:
    """Follows `pose` and `odom`. `map_from_base` is None until the mapper has spoken."""

    def __init__(self) -> None:
        self._estimate: PoseEstimate | None = None
        self._odometry: Odometry | None = None

    @property
    def map_from_base(self) -> Pose2 | None:
        """Where the robot is now, as well as anybody knows."""
        if self._estimate is None or self._odometry is None:
            return self._estimate.map_from_base if self._estimate else None
        return self._estimate.map_from_odom @ self._odometry.odom_from_base

    @property
    def lost(self) -> bool:
        """Whether the mapper says that it does not know."""
        return self._estimate is not None and self._estimate.state is Localization.LOST

    def estimated(self, estimate: PoseEstimate) -> bool:
        """Takes the mapper's word. True where the robot's place on the map jumped by more than driving explains."""
        before, self._estimate = self.map_from_base, estimate
        after = self.map_from_base
        return before is not None and after is not None and before.distance(after) > TELEPORT

    def moved(self, odometry: Odometry) -> None:
        """Takes dead reckoning. Where it restarts elsewhere, the robot stays where it was until the mapper speaks."""
        last = self._odometry
        stays = self.map_from_base
        if last is not None and self._estimate is not None and stays is not None and _leapt(last, odometry):
            self._estimate = PoseEstimate(
                self._estimate.stamp,
                stays,
                stays @ odometry.odom_from_base.inverse(),
                self._estimate.covariance,
                self._estimate.quality,
                self._estimate.state,
            )
        self._odometry = odometry


def _leapt(before: Odometry, after: Odometry) -> bool:
    elapsed = abs(after.stamp - before.stamp) * 1e-9
    return before.odom_from_base.distance(after.odom_from_base) > TELEPORT + TOP_SPEED * min(elapsed, 1.0)
