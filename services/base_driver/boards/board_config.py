# SPDX-License-Identifier: Apache-2.0
"""Settings of the motion board on a port."""

from typing import Literal

from pydantic import Field

from shared.config import Section


class SerialBoardConfig(Section):
    """The motion board, where `port` has a device."""

    model: Literal["drrobot", "velocity"] = Field(
        "drrobot",
        description="drrobot (X80SV), velocity (the text protocol of docs/velocity_board.md)",
    )
    kp: int = Field(
        15, ge=0, le=32767, description="drrobot: velocity gain; an X80SV is shaky at 20, hardly stable at 25"
    )
    ki: int = Field(0, ge=0, le=32767, description="drrobot: velocity gain")
    kd: int = Field(0, ge=0, le=32767, description="drrobot: velocity gain")
    command_life: float = Field(0.2, ge=0.05, le=5, description="lifetime of a command on the board, s: drrobot")
    sensors_silent: float = Field(
        0.5, gt=0.05, le=10, description="drrobot: s without its packet after which a range sensor is dead"
    )
    latency: float = Field(
        0.0,
        ge=0,
        le=0.2,
        description="s from the board's measurement to the reading of its bytes; subtracted from stamps",
    )
    inverted: tuple[Literal["left", "right"], ...] = Field(
        (), description="wheels whose motor and encoder are mounted the other way; drrobot: robot.drive.motor_direction"
    )
