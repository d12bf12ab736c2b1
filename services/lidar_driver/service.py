# SPDX-License-Identifier: Apache-2.0
"""Driver of the lasers, each on a port: their bytes in; scans, and commands to the lasers, out."""

from collections.abc import Callable
from math import pi
from typing import Annotated

from pydantic import Field

from services.lidar_driver import ld06
from services.lidar_driver.device import LaserDevice
from services.lidar_driver.device_clock import DeviceClockConfig
from services.lidar_driver.laser_unit import LaserUnit
from services.lidar_driver.rplidar import Rplidar
from services.lidar_driver.scip import Scip
from services.lidar_driver.xv11 import Xv11
from services.lidar_driver.ydlidar import MODELS as YDLIDAR_MODELS
from services.lidar_driver.ydlidar import Ydlidar
from shared import topics
from shared.config import Laser, Robot, Section, UserError
from shared.lasers import NO_SECOND_LASER, lasers_by_topic
from shared.messages import PortState, SerialData
from shared.ports import PortConfig
from shared.service import Out, Service, every, on

PORT, PORT_2 = "laser", "laser_2"

Angle = Annotated[float, Field(ge=-2 * pi, le=2 * pi)]


class LaserDeviceConfig(Section):
    """One laser's device. Mount and sweep are in `robot.laser` or `robot.lasers`."""

    model: str = Field(
        "ld06",
        pattern="^(ld06|ld14|stl27l|rplidar|scip|xv11|ydlidar_x2|ydlidar_x4|ydlidar_g2)$",
        description="ld06 (LDROBOT LD06, LD19), ld14, stl27l (LDROBOT), rplidar (SLAMTEC A, S and C series), "
        "scip (Hokuyo URG, UTM, UST), xv11 (Neato), ydlidar_x2, ydlidar_x4, ydlidar_g2",
    )
    port: PortConfig = Field(
        PortConfig(),
        description="port of the laser; baud: ld06 230400, stl27l 921600, ld14 and xv11 115200, "
        "rplidar 115200 (A3, S1 256000, C1 460800, S2, S3 1000000), "
        "ydlidar_x2 115200, ydlidar_x4 128000, ydlidar_g2 230400",
    )
    inverted: bool = Field(False, description="whether the laser is mounted upside down")
    masks: tuple[tuple[Angle, Angle], ...] = Field(
        (),
        max_length=100,
        description="rad, [from, to] in `laser`, counter-clockwise: angles at which the robot blocks the view",
    )
    mask_footprint: bool = Field(True, description="whether beams that end in the footprint are set to NaN")
    footprint_margin: float = Field(0.0, ge=0, le=1, description="margin, m, around the footprint for `mask_footprint`")
    intensities: bool = Field(True, description="whether scans contain intensities, if the laser has them")
    express: bool | None = Field(None, description="rplidar: express scan; none: if the model needs it (all but A1)")
    latency: float = Field(0.0, ge=0, le=1, description="s from a beam to its bytes; subtracted from the stamps")
    silence: float = Field(1.0, ge=0.1, le=60, description="s without a byte after which the laser is restarted")
    clock: DeviceClockConfig = Field(DeviceClockConfig(), description="estimation of the laser's clock")


class LidarDriverConfig(LaserDeviceConfig):
    """The laser driver: the settings of the first laser, and of the second one in `laser_2`."""

    laser_2: LaserDeviceConfig | None = Field(None, description="device of the second laser in `robot.lasers`")


class LidarDriverService(Service):
    """Passes bytes to the lasers' devices, and publishes what they measure."""

    config_type = LidarDriverConfig
    config: LidarDriverConfig

    def __init__(self, config: LidarDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        is_set = config.laser_2 not in (None, LaserDeviceConfig())  # Compose gives an empty port without ZENAV_LASER_2
        if is_set and len(robot.all_lasers) < 2:
            raise UserError(f"lidar_driver.laser_2 is set, but {NO_SECOND_LASER}", "list both in robot.lasers")
        configs = (PORT, "lidar_driver", config), (PORT_2, "lidar_driver.laser_2", config.laser_2)
        self.lasers = {
            port: LaserUnit(
                name=port,
                section=section,
                config=settings,
                device=DEVICES[settings.model](settings, laser),
                topic=topic,
                laser=laser,
                robot=robot,
            )
            for (port, section, settings), (topic, laser) in zip(configs, lasers_by_topic(robot).items(), strict=False)
            if settings is not None
        }

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {port: laser.port for port, laser in self.lasers.items()}

    def state(self) -> str:
        return "; ".join(laser.state(self.now) for laser in self.lasers.values())

    @on(topics.PORT)
    def plugged(self, state: PortState) -> Out:
        if state.port in self.lasers:
            yield from self.lasers[state.port].plugged(state, self.now)

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        if data.port in self.lasers:
            yield from self.lasers[data.port].receive(data, self.now)

    @every(hz=20)
    def watch(self) -> Out:
        for laser in self.lasers.values():
            yield from laser.watch(self.now)

    def on_shutdown(self) -> Out:
        for laser in self.lasers.values():
            yield from laser.stop(self.now)


DEVICES: dict[str, Callable[[LaserDeviceConfig, Laser], LaserDevice]] = {
    **dict.fromkeys(ld06.SAMPLES, lambda config, laser: ld06.Ld06(config.port.baud, ld06.SAMPLES[config.model])),
    "rplidar": lambda config, laser: Rplidar(config.port.baud, config.express, laser.rate),
    "scip": lambda config, laser: Scip(laser, config.inverted, config.intensities),
    "xv11": lambda config, laser: Xv11(config.port.baud),
    **dict.fromkeys(YDLIDAR_MODELS, lambda config, laser: Ydlidar(config.port.baud, YDLIDAR_MODELS[config.model])),
}
