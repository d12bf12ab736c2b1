# SPDX-License-Identifier: Apache-2.0
"""Driver of an inertial sensor on one port: its bytes in; `imu` in `base`, and commands to the sensor, out."""

from collections.abc import Callable

from pydantic import Field

from services.imu_driver.bno055 import Bno055
from services.imu_driver.bno085 import Bno085
from services.imu_driver.device import ImuDevice, Reading
from shared import topics
from shared.config import Robot, Section
from shared.imu_axes import imu_in_base
from shared.messages import Imu, PortState, SerialData
from shared.ports import PortConfig
from shared.robot import ImuMount
from shared.sensor_line import SensorLine
from shared.service import Out, Service, every, on

PORT = "imu"
NO_BYTES = "no bytes: is the sensor powered, and its line crossed (TX to RX)?"
NO_SENSE = "bytes arrive, none make sense: check imu_driver.model, .port.baud and the pins that choose its mode"


class ImuDriverConfig(Section):
    """The driver of an inertial sensor. Its mount is `robot.imu`. It starts only where `port` is given."""

    model: str = Field(
        "bno055",
        pattern="^(bno055|bno085)$",
        description="bno055 (Bosch, UART), bno085 (CEVA BNO080, BNO085, BNO086 in mode UART-RVC)",
    )
    port: PortConfig = Field(PortConfig(), description="port of the sensor; baud: 115200 of both")
    latency: float = Field(0.005, ge=0, le=0.2, description="s from a measurement to its bytes, beside their own time")
    silence: float = Field(0.5, ge=0.1, le=60, description="s without a byte after which the sensor is started again")


class ImuDriverService(Service):
    """Starts the sensor, decodes its readings, and reports its faults."""

    config_type = ImuDriverConfig
    config: ImuDriverConfig

    def __init__(self, config: ImuDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.device: ImuDevice = DEVICES[config.model](config.port.baud)
        self.mount = robot.imu or ImuMount()
        self.line = SensorLine(config.port, "imu_driver", "imu", config.silence)
        self.last_stamp = 0  # ns
        self.n_readings = 0

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    def state(self) -> str:
        """The fault, or the counts, for the health message."""
        counts = self.device.counts
        return self.fault() or f"{counts.n_good} packets, {counts.n_bad} bad"

    def fault(self) -> str:
        """The present fault of port or sensor, for people; empty without one."""
        if not self.line.open:
            return self.line.why_closed
        if self.line.is_silent(self.now):
            return NO_BYTES
        if self.line.lacks_readings(self.now):
            return self.device.fault or NO_SENSE
        return ""

    @on(topics.PORT)
    def plugged(self, state: PortState) -> Out:
        """Starts the sensor when its port opens."""
        if state.port != PORT:
            return
        if self.line.update_port(state, self.now):
            yield from self._start()
        yield from self.line.fault_log(self.fault(), self.n_readings)

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        """Decodes the sensor's bytes."""
        if data.port != PORT:
            return
        self.line.add_bytes(self.now)
        for reading in self.device.receive(data.data, data.stamp):
            yield from self._publish(reading)
        yield from self._send(self.device.next_command(self.now))

    @every(hz=50)
    def watch(self) -> Out:
        """Asks for the next reading; starts a silent sensor again."""
        self.line.limit_times(self.now)
        if self.line.is_start_due(self.now):
            yield from self._start()
        elif self.line.open:
            yield from self._send(self.device.next_command(self.now))
        yield from self.line.fault_log(self.fault(), self.n_readings)

    def _start(self) -> Out:
        self.line.started_at = self.now
        yield from self._send(self.device.start(self.now))

    def _send(self, data: bytes) -> Out:
        if data:
            yield topics.TX(SerialData(self.now, PORT, data))

    def _publish(self, reading: Reading) -> Out:
        """Publishes a reading whose stamp is newer than the last one's."""
        stamp = max(reading.stamp - round(self.config.latency * 1e9), 0)
        self.line.reading_at = self.now
        self.n_readings += 1
        if stamp <= self.last_stamp <= self.now:
            return
        self.last_stamp = stamp
        yield topics.IMU(in_base(reading, stamp, self.mount))


def in_base(reading: Reading, stamp: int, mount: ImuMount) -> Imu:
    """A reading in the axes of `base`. stamp: ns."""
    return imu_in_base(mount, stamp, reading.yaw_rate, reading.x, reading.y, reading.z)


DEVICES: dict[str, Callable[[int], ImuDevice]] = {"bno055": Bno055, "bno085": Bno085}
