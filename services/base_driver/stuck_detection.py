# SPDX-License-Identifier: Apache-2.0
"""Does a commanded wheel turn? If not, its motor, encoder or cable is broken, or the wheel is blocked."""

from pydantic import Field

from shared.config import Section


class StuckConfig(Section):
    """Limits of a stuck wheel."""

    commanded_over: float = Field(0.05, gt=0, le=1, description="minimum command that is judged, m/s at the rim")
    turns_under: float = Field(0.02, gt=0, le=1, description="maximum mean speed of a stuck wheel, m/s at the rim")
    longer_than: float = Field(1.0, gt=0.1, le=10, description="minimum duration, s")


class StuckDetector:
    """Judges one wheel: stuck if it is commanded in one direction for `longer_than` and hardly turns."""

    def __init__(self, config: StuckConfig) -> None:
        self.config = config
        self._since: int | None = None
        self._angle = 0.0
        self._forward = True

    def reset(self) -> None:
        """Restarts with the next report."""
        self._since = None

    def update(self, stamp: int, angle: float, commanded: float, radius: float) -> bool:
        """Whether the wheel is stuck after a report; stamp: ns, angle: rad, commanded: rad/s, radius: m."""
        if abs(commanded) * radius <= self.config.commanded_over:
            self._since = None
            return False
        forward = commanded > 0
        travelled = abs(angle - self._angle) * radius
        turns = travelled >= self.config.turns_under * self.config.longer_than
        if self._since is None or stamp < self._since or turns or forward != self._forward:
            self._since, self._angle, self._forward = stamp, angle, forward
            return False
        return (stamp - self._since) * 1e-9 >= self.config.longer_than
