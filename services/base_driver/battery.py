# SPDX-License-Identifier: Apache-2.0
"""Is the battery empty? The start of a motor lowers the voltage briefly; that of an empty battery stays low."""

from pydantic import Field

from shared.config import Section


class BatteryConfig(Section):
    """Voltages of a low and of an empty battery."""

    low: float = Field(6.6, ge=0, le=100, description="V; below it the status contains a warning; 0: never")
    empty: float = Field(0.0, ge=0, le=100, description="V; below it the robot stops; 0: never")
    sag: float = Field(0.1, ge=0, le=60, description="s for which the voltage may be below `empty`")
    recovered: float = Field(0.3, ge=0, le=10, description="V above `empty` at which the robot may drive again")


class BatteryMonitor:
    """Judges the voltage of the reports; `is_empty` stays True until the voltage has recovered."""

    def __init__(self, config: BatteryConfig) -> None:
        self.config = config
        self.is_empty = False
        self._under_since: int | None = None

    def update(self, stamp: int, volts: float) -> None:
        """Adds a report: stamp (ns), voltage (V, NaN unknown)."""
        if self.is_empty:
            self._under_since = None
            self.is_empty = not volts >= self.config.empty + self.config.recovered
        elif volts < self.config.empty:
            since = self._under_since = stamp if self._under_since is None else min(stamp, self._under_since)
            self.is_empty = (stamp - since) * 1e-9 >= self.config.sag
        else:
            self._under_since = None

    def is_low(self, volts: float) -> bool:
        """Whether the status should contain a warning; volts: V, NaN unknown."""
        return volts < self.config.low
