# SPDX-License-Identifier: Apache-2.0
"""Settings of the base driver."""

from pydantic import Field, model_validator

from services.base_driver.battery import BatteryConfig
from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.encoders import EncoderConfig
from services.base_driver.stuck_detection import StuckConfig
from services.base_driver.watchdog import WatchdogConfig
from services.base_driver.wheel_tracking import WheelTrackingConfig
from shared.config import Section
from shared.ports import PortConfig

BUSY_S = 0.05  # for which a busy machine may let a report wait


class BaseDriverConfig(Section):
    """The base driver."""

    port: PortConfig = Field(
        PortConfig(), description="port of the motion board; no device: messages `hardware/board` and `motors`"
    )
    board: SerialBoardConfig = SerialBoardConfig()
    board_silent: float = Field(0.5, gt=0.05, le=5, description="s without a report after which the link is lost")
    board_age: float = Field(
        0.2,
        gt=0.02,
        le=1,
        description="maximum age, s, of a report that is used; `bad_stamps` if all reports are older",
    )
    battery: BatteryConfig = BatteryConfig()
    watchdog: WatchdogConfig = WatchdogConfig()
    encoders: EncoderConfig = EncoderConfig()
    stuck: StuckConfig = StuckConfig()
    following: WheelTrackingConfig = WheelTrackingConfig()

    @model_validator(mode="after")
    def _reports_are_young(self) -> "BaseDriverConfig":
        """A report is older than `latency` when it is read."""
        latency = self.board.latency
        if latency > 0 and latency + BUSY_S > self.board_age:
            raise ValueError(
                f"board.latency: {latency} s is too near to board_age, {self.board_age} s, which must be larger by "
                f"{BUSY_S} s at least"
            )
        return self
