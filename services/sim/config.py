# SPDX-License-Identifier: Apache-2.0
"""Settings of the simulator."""

from math import pi
from typing import Literal

from pydantic import Field

from services.sim.drive import Battery, DriveTruth
from services.sim.hardware.emulation import EmulationConfig
from services.sim.imu import ImuNoise
from services.sim.sensors import LaserNoise, RangeNoise
from shared.config import Section


class StartPose(Section):
    """A pose in the world."""

    x: float = Field(ge=-1e4, le=1e4, description="m")
    y: float = Field(ge=-1e4, le=1e4, description="m")
    yaw: float = Field(0.0, ge=-2 * pi, le=2 * pi, description="rad")


class SimConfig(Section):
    """The simulator."""

    world: str = Field(
        "office",
        description="empty, room, corridor, office, the path of a world or a ROS map, barn:N, building:N or crowd:N",
    )
    barn_file: str = Field("", description="path of the list of cylinders for `world: barn:N`")
    seed: int = Field(0, ge=0, le=2**31, description="of noise, slip, people and loose things")
    start: StartPose | None = Field(None, description="where the robot starts; none: where the world says")
    clutter_jitter: float = Field(0.1, ge=0, le=1, description="m by which loose things move from seed to seed")
    people_react: bool = Field(True, description="whether people stop for the robot and walk around it")
    other_discs: int = Field(
        0, ge=0, le=2000, description="discs of other robots in this world, which `sim/others` places: docs/fleet.md"
    )
    hardware: Literal["messages", "emulated"] = Field(
        "messages", description="messages: board and scan as such; emulated: byte streams on ports, as the robot's"
    )
    emulation: EmulationConfig = EmulationConfig()
    drive: DriveTruth = Field(DriveTruth(), description="the drive as it really is")
    battery: Battery = Field(Battery(), description="the battery")
    laser: LaserNoise = Field(LaserNoise(), description="errors of the laser")
    ranges: RangeNoise = Field(RangeNoise(), description="errors of ultrasonic and infrared sensors")
    imu: ImuNoise = Field(ImuNoise(), description="errors of the inertial sensor")
