# SPDX-License-Identifier: Apache-2.0
"""Settings of the motion board on a port."""

from typing import Literal

from pydantic import Field

from shared.config import Section


class SerialBoardConfig(Section):
    """The motion board, where `port` has a device."""

    model: Literal["drrobot", "velocity", "kobuki", "create2", "ros_arduino_bridge", "roboclaw", "odrive"] = Field(
        "drrobot",
        description="drrobot (X80SV), velocity (our text protocol), kobuki (TurtleBot 2), create2 (Roomba, too), "
        "ros_arduino_bridge, roboclaw, odrive",
    )
    kp: int = Field(
        15, ge=0, le=32767, description="drrobot: velocity gain; an X80SV is shaky at 20, hardly stable at 25"
    )
    ki: int = Field(0, ge=0, le=32767, description="drrobot: velocity gain")
    kd: int = Field(0, ge=0, le=32767, description="drrobot: velocity gain")
    command_life: float = Field(
        0.2,
        ge=0.05,
        le=5,
        description="drrobot, odrive, roboclaw (steps of 0.1): lifetime of a command on the board, s",
    )
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
        (), description="wheels that count down when they roll forward: ros_arduino_bridge, roboclaw, odrive"
    )
    frame_rate: float = Field(30.0, gt=0, le=1000, description="ros_arduino_bridge: its PID_RATE, frames a second")
    address: int = Field(0x80, ge=0x80, le=0x87, description="roboclaw: its address; 128 as delivered")
    gyro: bool = Field(
        True, description="velocity, kobuki: whether the board's gyro is published as `imu`; false beside an imu_driver"
    )
    gear_ratio: float = Field(1.0, gt=0, le=1000, description="odrive: turns of the motor for a turn of the wheel")
