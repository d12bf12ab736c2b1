# SPDX-License-Identifier: Apache-2.0
"""Is the battery empty? A motor's start pulls the voltage down for a moment; an empty battery stays down."""

from pydantic import Field

from shared.config import Section


class BatteryConfig(Section):
    """When the battery is low, and when it is empty."""

    low: float = Field(6.6, ge=0, le=100, description="V under which the status says so; 0 never")
    empty: float = Field(0.0, ge=0, le=100, description="V under which the robot stands; 0 never")
    sag: float = Field(0.1, ge=0, le=60, description="s for which the voltage may be under that")
    recovered: float = Field(0.3, ge=0, le=10, description="V over `empty` from which the robot may drive again")


class BatteryMonitor:
    """Watches the reports; `is_empty` holds until the voltage has recovered."""

    def __init__(self, config: BatteryConfig) -> None:
        self.config = config
        self.is_empty = False
        self._under_since: int | None = None

    def update(self, stamp: int, volts: float) -> None:
        """A report's stamp (ns) and voltage, NaN where none has been measured."""
        if self.is_empty:
            self._under_since = None
            self.is_empty = not volts >= self.config.empty + self.config.recovered
        elif volts < self.config.empty:
            since = self._under_since = stamp if self._under_since is None else min(stamp, self._under_since)
            self.is_empty = (stamp - since) * 1e-9 >= self.config.sag
        else:
            self._under_since = None

    def is_low(self, volts: float) -> bool:
        """Whether people should know."""
        return volts < self.config.low
