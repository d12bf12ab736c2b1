# SPDX-License-Identifier: Apache-2.0
"""Does a commanded wheel turn? If not, its motor, encoder or cable is broken, or something holds it."""

from pydantic import Field

from shared.config import Section


class StuckConfig(Section):
    """When a wheel counts as stuck."""

    commanded_over: float = Field(0.05, gt=0, le=1, description="m/s at the rim; slower commands are not judged")
    turns_under: float = Field(0.02, gt=0, le=1, description="m/s at the rim, on average, that a stuck wheel shows")
    longer_than: float = Field(1.0, gt=0.1, le=10, description="s")


class StuckDetector:
    """Watches one wheel: stuck when it is asked to turn, in one direction, and for `longer_than` hardly does."""

    def __init__(self, config: StuckConfig) -> None:
        self.config = config
        self._since: int | None = None
        self._angle = 0.0
        self._forward = True

    def reset(self) -> None:
        """Judges from the next report on."""
        self._since = None

    def update(self, stamp: int, angle: float, commanded: float, radius: float) -> bool:
        """After a report: stamp (ns), the wheel's angle (rad), the commanded speed (rad/s), the wheel's radius (m)."""
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
