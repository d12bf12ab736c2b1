# SPDX-License-Identifier: Apache-2.0
"""One laser on one port: its bytes in, scans out, and what it must be told."""

from collections.abc import Callable
from math import pi
from typing import Annotated

import numpy as np
from pydantic import Field

from services.lidar_driver.device import Device, Float64s
from services.lidar_driver.device_clock import DeviceClock, DeviceClockConfig
from services.lidar_driver.ld06 import Ld06
from services.lidar_driver.masking import masked_angles, on_robot
from services.lidar_driver.rplidar import Rplidar
from services.lidar_driver.scip import Scip
from services.lidar_driver.sweeps import Sweep, Sweeps
from services.lidar_driver.xv11 import Xv11
from shared import topics
from shared.config import Laser, Robot, Section
from shared.messages import LaserScan, PortState, SerialData
from shared.ports import PortConfig
from shared.service import Log, Out, Service, every, on

PORT = "laser"
SPEED_SHARE = 0.15  # of the rate, by which the speed may be off before it is worth a word
STANDS = 0.1  # turns/s: slower is standing still
NO_PORT = "no port: set lidar_driver.port.device"
NO_BYTES = "no bytes: is the laser powered, and does it turn?"
NO_SENSE = "bytes arrive, none make sense: check lidar_driver.model and .port.baud"
STOPPED = "the laser stopped turning"

Angle = Annotated[float, Field(ge=-2 * pi, le=2 * pi)]


class LidarDriverConfig(Section):
    """The laser's driver. Its mount and its sweep are the robot's: `robot.laser`."""

    model: str = Field(
        "ld06",
        pattern="^(ld06|rplidar|scip|xv11)$",
        description="ld06 (LDROBOT LD06, LD19), rplidar (SLAMTEC A1 to A3), scip (Hokuyo URG, UTM, UST), xv11 (Neato)",
    )
    port: PortConfig = Field(
        PortConfig(),
        description="the laser's; baud: ld06 230400, rplidar 115200 (A3 256000), xv11 115200",
    )
    inverted: bool = Field(False, description="whether it hangs upside down")
    masks: tuple[tuple[Angle, Angle], ...] = Field(
        (), max_length=100, description="rad, [from, to] in `laser`, counter-clockwise: where it sees the robot itself"
    )
    mask_footprint: bool = Field(True, description="whether beams that end in the robot's footprint are left out")
    footprint_margin: float = Field(0.0, ge=0, le=1, description="m around the footprint that count as the robot, too")
    intensities: bool = Field(True, description="whether scans carry intensities where the laser has them")
    express: bool | None = Field(None, description="rplidar: express scan; none: where the model needs it (A2, A3)")
    latency: float = Field(0.0, ge=0, le=1, description="s from a beam to its bytes, by which its stamp is set back")
    silence: float = Field(1.0, ge=0.1, le=60, description="s without a byte after which the laser is started anew")
    clock: DeviceClockConfig = Field(DeviceClockConfig(), description="how the laser's clock is followed")


class LidarDriverService(Service):
    """Starts the laser, follows its clock, and says what is wrong with it."""

    config_type = LidarDriverConfig
    config: LidarDriverConfig

    def __init__(self, config: LidarDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.device: Device = DEVICES[config.model](config, robot.laser)
        self.clock = DeviceClock(config.clock)
        self.sweeps = Sweeps(robot.laser, self.device.clockwise, config.inverted)
        beams = np.arange(robot.laser.n_beams, dtype=np.float64)
        self.angles: Float64s = self.sweeps.angle_min + self.sweeps.increment * beams
        self.masked = masked_angles(self.angles, config.masks)
        self.open = False
        self.why_closed = "" if config.port.given else NO_PORT
        self.heard_at, self.understood_at, self.opened_at, self.started_at = 0, 0, 0, 0  # ns
        self.n_good = 0
        self.n_scans = 0
        self.told, self.n_scans_then = "", 0  # what people were told is wrong, and n_scans at that time

    @property
    def ports(self) -> dict[str, PortConfig]:
        port = self.config.port
        if self.config.model == "rplidar":
            port = port.model_copy(update={"dtr": False})  # high, it holds an A1's motor
        return {PORT: port}

    def state(self) -> str:
        if trouble := self.trouble() or self.told:
            return trouble
        if not self.n_scans:
            return "starting the laser"
        speed, rate, counts = self.device.speed or 0.0, self.robot.laser.rate, self.device.counts
        expected = f", {rate:g} expected" if abs(speed - rate) > SPEED_SHARE * rate else ""
        return (
            f"scanning, {speed:.1f} turns/s{expected}; {counts.n_good} packets, {counts.n_bad} bad, "
            f"{counts.n_resyncs} resyncs, {self.sweeps.n_lost} sweeps lost"
        )

    def trouble(self) -> str:
        """What is wrong, for people; empty when nothing is."""
        if not self.open:
            return self.why_closed
        silence = self.config.silence * 1e9
        if self.now - max(self.heard_at, self.opened_at) > silence:
            return self.device.trouble or NO_BYTES
        if self.now - max(self.understood_at, self.opened_at) > 2 * silence:
            return NO_SENSE
        if self.device.trouble:
            return self.device.trouble
        speed = self.device.speed
        return STOPPED if self.device.scanning and speed is not None and speed < STANDS else ""

    @on(topics.PORT)
    def plugged(self, state: PortState) -> Out:
        if state.port != PORT:
            return
        self.open, self.why_closed = state.open, state.detail or "its port is closed"
        if state.open:
            self.opened_at = self.now
            yield from self._start()
        yield from self._tell()

    @on(topics.RX)
    def received(self, data: SerialData) -> Out:
        if data.port != PORT:
            return
        if not self.open:
            self.open, self.opened_at = True, self.now
        self.heard_at = self.now
        met = self.device.met
        found = self.device.received(data.data, data.stamp)
        if self.device.met is not None and self.device.met != met:
            self.clock.meet(*self.device.met)
        for returns in found:
            if returns.restarted:
                self.clock.restart()
            self.clock.observe(data.stamp, returns.sent, returns.ages)
            yield from (topics.SCAN(scan) for scan in map(self._scan, self.sweeps.add(returns)) if scan is not None)
        if self.device.counts.n_good != self.n_good:
            self.n_good, self.understood_at = self.device.counts.n_good, self.now
        yield from self._say(self.device.due(self.now))

    @every(hz=20)
    def watch(self) -> Out:
        times = self.heard_at, self.understood_at, self.opened_at, self.started_at
        self.heard_at, self.understood_at, self.opened_at, self.started_at = (
            min(at, self.now)
            for at in times  # the clock may have been set back
        )
        if self.open:
            if self.device.scanning and self.now - max(self.heard_at, self.started_at) > self.config.silence * 1e9:
                yield from self._start()
            yield from self._say(self.device.due(self.now))
        yield from self._tell()

    def farewell(self) -> Out:
        return self._say(self.device.farewell()) if self.open else ()

    def _start(self) -> Out:
        self.started_at = self.now
        self.clock.begin()
        self.sweeps.restart()
        yield from self._say(self.device.opened(self.now))

    def _say(self, data: bytes) -> Out:
        if data:
            yield topics.TX(SerialData(self.now, PORT, data))

    def _tell(self) -> Out:
        """One line for each change of what is wrong. It is over when scans come, not when the laser answers."""
        trouble = self.trouble()
        if trouble and trouble != self.told:
            yield Log("WARNING", f"laser: {trouble}")
            self.told, self.n_scans_then = trouble, self.n_scans
        elif self.told and not trouble and self.n_scans > self.n_scans_then:
            yield Log("INFO", "laser: in order again")
            self.told = ""

    def _scan(self, sweep: Sweep) -> LaserScan | None:
        laser = self.robot.laser
        first, last = self.clock.stack_time(sweep.first), self.clock.stack_time(sweep.last)
        back = round(self.config.latency * 1e9) + max(0, last - self.now)
        scan_time = (last - first) * 1e-9
        if not 0 < scan_time <= 2 or first < back:
            return None
        ranges = sweep.ranges.copy()
        ranges[self.masked | (ranges > laser.range_max)] = np.nan
        if self.config.mask_footprint:
            margin = self.config.footprint_margin
            ranges[on_robot(ranges, self.angles, laser.mount, self.robot.corners, margin)] = np.nan
        self.n_scans += 1
        scan = (first - back, self.sweeps.angle_min, self.sweeps.increment, scan_time, laser.range_min, laser.range_max)
        if sweep.intensities is None or not self.config.intensities:
            return LaserScan(*scan, ranges)
        return LaserScan(*scan, ranges, np.where(np.isnan(ranges), 0, sweep.intensities).astype(np.float32))


DEVICES: dict[str, Callable[[LidarDriverConfig, Laser], Device]] = {
    "ld06": lambda config, laser: Ld06(config.port.baud),
    "rplidar": lambda config, laser: Rplidar(config.port.baud, config.express),
    "scip": lambda config, laser: Scip(laser, config.inverted, config.intensities),
    "xv11": lambda config, laser: Xv11(config.port.baud),
}
