# SPDX-License-Identifier: Apache-2.0
"""The robot's speed from its poses in `map`, smoothed (our own): what the others hear of it."""

from shared.geometry import Pose2
from shared.types import NS_PER_S

MAX_AGE_NS = NS_PER_S
"""ns after which a pose says nothing of the speed: the robot stands on old inputs."""
SETTLING = 0.4  # share of the newest step


class MeasuredSpeed:
    """Of the poses that were added."""

    def __init__(self) -> None:
        self._stamp, self._v, self._w = 0, 0.0, 0.0

    def add(self, before: Pose2 | None, here: Pose2, stamp: int) -> None:
        """Takes a pose in `map`. before: the last one, if the step from it is of driving.  stamp: ns."""
        seconds, self._stamp = (stamp - self._stamp) / NS_PER_S, stamp
        if before is not None and 0.02 < seconds < 1.0:
            step = before.inverse() @ here
            self._v += SETTLING * (max(-20.0, min(step.x / seconds, 20.0)) - self._v)
            self._w += SETTLING * (max(-50.0, min(step.yaw / seconds, 50.0)) - self._w)

    def at(self, now: int) -> tuple[float, float]:
        """m/s, rad/s; zero where the last pose is too old. now: ns."""
        if now - self._stamp > MAX_AGE_NS:
            self._v = self._w = 0.0
        return self._v, self._w
