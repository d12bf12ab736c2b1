# SPDX-License-Identifier: Apache-2.0
"""Driver of one laser on one port: its bytes in; scans, and commands to the laser, out."""

from collections.abc import Callable
from math import pi
from typing import Annotated

import numpy as np
from pydantic import Field

from services.lidar_driver import ld06
from services.lidar_driver.device import LaserDevice
from services.lidar_driver.device_clock import DeviceClock, DeviceClockConfig
from services.lidar_driver.rplidar import Rplidar
from services.lidar_driver.scip import Scip
from services.lidar_driver.self_mask import masked_angles, on_robot
from services.lidar_driver.sweep_assembly import GridSweep, SweepAssembler
from services.lidar_driver.xv11 import Xv11
from services.lidar_driver.ydlidar import MODELS as YDLIDAR_MODELS
from services.lidar_driver.ydlidar import Ydlidar
from shared import topics
from shared.config import Laser, Robot, Section
from shared.messages import LaserScan, PortState, SerialData
from shared.ports import PortConfig
from shared.service import Log, Out, Service, every, on
from shared.types import Float64s

PORT = "laser"
MAX_SPEED_ERROR = 0.15  # share of the rate; a larger error is shown in the state
MIN_TURN_RATE = 0.1  # turns/s; slower counts as stopped
NO_PORT = "no port: set lidar_driver.port.device"
NO_BYTES = "no bytes: is the laser powered, and does it turn?"
NO_SENSE = "bytes arrive, none make sense: check lidar_driver.model and .port.baud"
STOPPED = "the laser stopped turning"

Angle = Annotated[float, Field(ge=-2 * pi, le=2 * pi)]


class LidarDriverConfig(Section):
    """The laser driver. Mount and sweep are in `robot.laser`."""

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


class LidarDriverService(Service):
    """Starts the laser, decodes its beams, estimates its clock, and reports its faults."""

    config_type = LidarDriverConfig
    config: LidarDriverConfig

    def __init__(self, config: LidarDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.device: LaserDevice = DEVICES[config.model](config, robot.laser)
        self.clock = DeviceClock(config.clock)
        self.sweeps = SweepAssembler(robot.laser, self.device.clockwise, config.inverted)
        beams = np.arange(robot.laser.n_beams, dtype=np.float64)
        self.angles: Float64s = self.sweeps.angle_min + self.sweeps.increment * beams
        self.masked = masked_angles(self.angles, config.masks)
        self.open = False
        self.why_closed = "" if config.port.given else NO_PORT
        self.bytes_at, self.packet_at, self.opened_at, self.started_at = 0, 0, 0, 0  # ns
        self.n_good = 0
        self.n_scans = 0
        self.logged_fault, self.n_scans_at_log = "", 0  # last fault that was logged, and n_scans at that time

    @property
    def ports(self) -> dict[str, PortConfig]:
        port = self.config.port
        if self.config.model == "rplidar":
            port = port.model_copy(update={"dtr": False})  # a high DTR stops an A1's motor
        return {PORT: port}

    def state(self) -> str:
        if fault := self.fault() or self.logged_fault:
            return fault
        if not self.n_scans:
            return "starting the laser"
        speed, rate, counts = self.device.speed or 0.0, self.robot.laser.rate, self.device.counts
        expected = f", {rate:g} expected" if abs(speed - rate) > MAX_SPEED_ERROR * rate else ""
        return (
            f"scanning, {speed:.1f} turns/s{expected}; {counts.n_good} packets, {counts.n_bad} bad, "
            f"{counts.n_resyncs} resyncs, {self.sweeps.n_lost} sweeps lost"
        )

    def fault(self) -> str:
        """The present fault of port or laser, for people; empty without one."""
        if not self.open:
            return self.why_closed
        silence = self.config.silence * 1e9
        if self.now - max(self.bytes_at, self.opened_at) > silence:
            return self.device.fault or NO_BYTES
        if self.now - max(self.packet_at, self.opened_at) > 2 * silence:
            return NO_SENSE
        if self.device.fault:
            return self.device.fault
        speed = self.device.speed
        return STOPPED if self.device.scanning and speed is not None and speed < MIN_TURN_RATE else ""

    @on(topics.PORT)
    def plugged(self, state: PortState) -> Out:
        if state.port != PORT:
            return
        self.open, self.why_closed = state.open, state.detail or "its port is closed"
        if state.open:
            self.opened_at = self.now
            yield from self._start()
        yield from self._log_fault_change()

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        if data.port != PORT:
            return
        if not self.open:
            self.open, self.opened_at = True, self.now
        self.bytes_at = self.now
        met = self.device.clock_reading
        decoded = self.device.receive(data.data, data.stamp)
        if self.device.clock_reading is not None and self.device.clock_reading != met:
            self.clock.add_clock_reading(*self.device.clock_reading)
        for returns in decoded:
            if returns.restarted:
                self.clock.restart()
            self.clock.observe(data.stamp, returns.sent, returns.ages)
            yield from (topics.SCAN(scan) for scan in map(self._scan, self.sweeps.add(returns)) if scan is not None)
        if self.device.counts.n_good != self.n_good:
            self.n_good, self.packet_at = self.device.counts.n_good, self.now
        yield from self._send(self.device.next_command(self.now))

    @every(hz=20)
    def watch(self) -> Out:
        times = self.bytes_at, self.packet_at, self.opened_at, self.started_at
        self.bytes_at, self.packet_at, self.opened_at, self.started_at = (
            min(at, self.now)
            for at in times  # the clock may have been set back
        )
        if self.open:
            if self.device.scanning and self.now - max(self.bytes_at, self.started_at) > self.config.silence * 1e9:
                yield from self._start()
            yield from self._send(self.device.next_command(self.now))
        yield from self._log_fault_change()

    def on_shutdown(self) -> Out:
        return self._send(self.device.stop_command()) if self.open else ()

    def _start(self) -> Out:
        self.started_at = self.now
        self.clock.reset()
        self.sweeps.restart()
        yield from self._send(self.device.start(self.now))

    def _send(self, data: bytes) -> Out:
        if data:
            yield topics.TX(SerialData(self.now, PORT, data))

    def _log_fault_change(self) -> Out:
        """Logs each change of the fault. A fault ends with the next scan, not with an answer of the laser."""
        fault = self.fault()
        if fault and fault != self.logged_fault:
            yield Log("WARNING", f"laser: {fault}")
            self.logged_fault, self.n_scans_at_log = fault, self.n_scans
        elif self.logged_fault and not fault and self.n_scans > self.n_scans_at_log:
            yield Log("INFO", "laser: in order again")
            self.logged_fault = ""

    def _scan(self, sweep: GridSweep) -> LaserScan | None:
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


DEVICES: dict[str, Callable[[LidarDriverConfig, Laser], LaserDevice]] = {
    **dict.fromkeys(ld06.SAMPLES, lambda config, laser: ld06.Ld06(config.port.baud, ld06.SAMPLES[config.model])),
    "rplidar": lambda config, laser: Rplidar(config.port.baud, config.express, laser.rate),
    "scip": lambda config, laser: Scip(laser, config.inverted, config.intensities),
    "xv11": lambda config, laser: Xv11(config.port.baud),
    **dict.fromkeys(YDLIDAR_MODELS, lambda config, laser: Ydlidar(config.port.baud, YDLIDAR_MODELS[config.model])),
}
