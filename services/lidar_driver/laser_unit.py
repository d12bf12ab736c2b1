# SPDX-License-Identifier: Apache-2.0
"""One laser of the driver: starts its device, decodes its beams, estimates its clock, and reports its faults.

The order of these steps is our own.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from services.lidar_driver.device import LaserDevice
from services.lidar_driver.device_clock import DeviceClock
from services.lidar_driver.self_mask import masked_angles, on_robot
from services.lidar_driver.sweep_assembly import GridSweep, SweepAssembler
from shared import topics
from shared.config import Laser, Robot
from shared.messages import LaserScan, PortState, SerialData
from shared.ports import PortConfig
from shared.sensor_line import SensorLine
from shared.service import Out
from shared.topics import Topic
from shared.types import Float64s

if TYPE_CHECKING:
    from services.lidar_driver.service import LaserDeviceConfig

MAX_SPEED_ERROR = 0.15  # share of the rate; a larger error is shown in the state
MIN_TURN_RATE = 0.1  # turns/s; slower counts as stopped
NO_BYTES = "no bytes: is the laser powered, and does it turn?"
NO_SENSE = "bytes arrive, none make sense: check {}.model and .port.baud"
STOPPED = "the laser stopped turning"


class LaserUnit:
    """The device at one port, and the scans that it gives on one topic. now: ns."""

    def __init__(
        self,
        name: str,
        section: str,
        config: "LaserDeviceConfig",
        device: LaserDevice,
        topic: Topic[LaserScan],
        laser: Laser,
        robot: Robot,
    ) -> None:
        """name: of the port.  section: of its settings, for hints."""
        self.name, self.section, self.config, self.device = name, section, config, device
        self.topic, self.laser, self.robot = topic, laser, robot
        self.label = f"laser {laser.name}" if laser.name else "laser"
        self.clock = DeviceClock(config.clock)
        self.sweeps = SweepAssembler(laser, self.device.clockwise, config.inverted)
        beams = np.arange(laser.n_beams, dtype=np.float64)
        self.angles: Float64s = self.sweeps.angle_min + self.sweeps.increment * beams
        self.masked = masked_angles(self.angles, config.masks)
        self.line = SensorLine(config.port, section, self.label, config.silence)
        self.n_good = 0
        self.n_scans = 0

    @property
    def port(self) -> PortConfig:
        """The port to open."""
        if self.config.model == "rplidar":
            return self.config.port.model_copy(update={"dtr": False})  # a high DTR stops an A1's motor
        return self.config.port

    def state(self, now: int) -> str:
        """What the laser does, for health; with its name, where it has one."""
        words = self._state(now)
        return f"{self.label}: {words}" if self.laser.name else words

    def _state(self, now: int) -> str:
        if fault := self.fault(now) or self.line.logged_fault:
            return fault
        if not self.n_scans:
            return "starting the laser"
        speed, rate, counts = self.device.speed or 0.0, self.laser.rate, self.device.counts
        expected = f", {rate:g} expected" if abs(speed - rate) > MAX_SPEED_ERROR * rate else ""
        return (
            f"scanning, {speed:.1f} turns/s{expected}; {counts.n_good} packets, {counts.n_bad} bad, "
            f"{counts.n_resyncs} resyncs, {self.sweeps.n_lost} sweeps lost"
        )

    def fault(self, now: int) -> str:
        """The present fault of port or laser, for people; empty without one."""
        if not self.line.open:
            return self.line.why_closed
        if self.line.is_silent(now):
            return self.device.fault or NO_BYTES
        if self.line.lacks_readings(now):
            return NO_SENSE.format(self.section)
        if self.device.fault:
            return self.device.fault
        speed = self.device.speed
        return STOPPED if self.device.scanning and speed is not None and speed < MIN_TURN_RATE else ""

    def plugged(self, state: PortState, now: int) -> Out:
        """Takes the state of its port."""
        if self.line.update_port(state, now):
            yield from self._start(now)
        yield from self.line.fault_log(self.fault(now), self.n_scans)

    def receive(self, data: SerialData, now: int) -> Out:
        """Takes bytes of the laser."""
        self.line.add_bytes(now)
        met = self.device.clock_reading
        decoded = self.device.receive(data.data, data.stamp)
        if self.device.clock_reading is not None and self.device.clock_reading != met:
            self.clock.add_clock_reading(*self.device.clock_reading)
        for returns in decoded:
            if returns.restarted:
                self.clock.restart()
            self.clock.observe(data.stamp, returns.sent, returns.ages)
            yield from (
                self.topic(scan) for sweep in self.sweeps.add(returns) if (scan := self._scan(sweep, now)) is not None
            )
        if self.device.counts.n_good != self.n_good:
            self.n_good, self.line.reading_at = self.device.counts.n_good, now
        yield from self._send(self.device.next_command(now), now)

    def watch(self, now: int) -> Out:
        """Starts a silent laser again, and sends what is due; 20 times a second."""
        self.line.limit_times(now)
        if self.device.scanning and self.line.is_start_due(now):
            yield from self._start(now)
        if self.line.open:
            yield from self._send(self.device.next_command(now), now)
        yield from self.line.fault_log(self.fault(now), self.n_scans)

    def stop(self, now: int) -> Out:
        """Stops the laser: the process ends."""
        return self._send(self.device.stop_command(), now) if self.line.open else ()

    def _start(self, now: int) -> Out:
        self.line.started_at = now
        self.clock.reset()
        self.sweeps.restart()
        yield from self._send(self.device.start(now), now)

    def _send(self, data: bytes, now: int) -> Out:
        if data:
            yield topics.TX(SerialData(now, self.name, data))

    def _scan(self, sweep: GridSweep, now: int) -> LaserScan | None:
        laser = self.laser
        first, last = self.clock.stack_time(sweep.first), self.clock.stack_time(sweep.last)
        back = round(self.config.latency * 1e9) + max(0, last - now)
        scan_time = (last - first) * 1e-9
        if not 0 < scan_time <= 2 or first < back:
            return None
        ranges = sweep.ranges.copy()
        ranges[self.masked | (ranges > laser.range_max)] = np.nan
        if self.config.mask_footprint:
            margin = self.config.footprint_margin
            ranges[on_robot(ranges, self.angles, laser.mount, self.robot.corners, margin)] = np.nan
        self.n_scans += 1
        scan = LaserScan(
            stamp=first - back,
            angle_min=self.sweeps.angle_min,
            angle_increment=self.sweeps.increment,
            scan_time=scan_time,
            range_min=laser.range_min,
            range_max=laser.range_max,
            ranges=ranges,
        )
        if sweep.intensities is None or not self.config.intensities:
            return scan
        return replace(scan, intensities=np.where(np.isnan(ranges), 0, sweep.intensities).astype(np.float32))
