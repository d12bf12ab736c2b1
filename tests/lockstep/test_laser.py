# SPDX-License-Identifier: Apache-2.0
"""A laser that speaks bytes over a wire gives the scans that the simulator would have sent as messages."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from services.lidar_driver.service import LidarDriverConfig, LidarDriverService
from services.sim.config import SimConfig
from services.sim.hardware.lasers import LaserEmulator, make_emulator
from services.sim.service import SimService
from shared import topics
from shared.config import configured
from shared.messages import LaserScan, MotorCommand, SerialData
from shared.ports import PortConfig
from shared.runners.host import Sent
from shared.runners.lockstep import Lockstep
from shared.runners.replay import replay
from shared.service import Out, every, on
from tests.lockstep.stack import HALL
from tests.lockstep.test_ports import KeptBytes
from tests.unit.services.lidar_driver.bench import BAUD, CLOCK_ERROR, MODELS, laser_of, robot_with, spoken

MS = 1_000_000
SECONDS = 5.0
WIRE = (("sim", "laser"), ("lidar_driver", "laser"))


class SpeakingSim(SimService):
    """The simulator whose laser speaks its model's bytes."""

    laser: LaserEmulator
    leaving: list[tuple[int, bytes]]

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {"laser": PortConfig(device="wired")}

    @on(topics.RX)
    def heard(self, data: SerialData) -> Out:
        if answer := self.laser.receive(data.data, self.now):
            yield topics.TX(SerialData(self.now, "laser", answer))

    @every(hz=50)
    def tick(self) -> Out:
        for said in super().tick():
            if said.topic is topics.SCAN:
                self.leaving += self.laser.sweep_chunks(said.message, self.now)
            else:
                yield said
        due = b"".join(data for when, data in self.leaving if when <= self.now)
        self.leaving = [(when, data) for when, data in self.leaving if when > self.now]
        if due:
            yield topics.TX(SerialData(self.now, "laser", due))


def scans_of(folder: Path, model: str, speaking: bool) -> tuple[list[LaserScan], list[Sent], Lockstep]:
    """What comes out while the robot turns on the spot, as messages or through bytes and driver."""
    path = folder / "world.yaml"
    path.write_text(HALL)
    config = configured("x80sv", [f"sim.world={path}", "sim.clutter_jitter=0"]).section("sim", SimConfig)
    robot = robot_with(laser_of(model).model_copy(update={"range_min": 0.05}))
    recorded: list[Sent] = []
    if speaking:
        sim: SimService = SpeakingSim(config, robot)
        sim.laser, sim.leaving = make_emulator(model, robot.laser), []  # type: ignore[attr-defined]  # a SpeakingSim
        driver = LidarDriverService(driver_config(model), robot)
        lockstep = Lockstep({"sim": sim, "lidar_driver": driver}, recorded.append, wires=(WIRE,))
    else:
        lockstep = Lockstep({"sim": SimService(config, robot)}, recorded.append)
    scans: list[LaserScan] = []
    lockstep.watch("scan", scans.append)
    for _ in range(round(SECONDS * 10)):
        lockstep.publish(topics.MOTORS(MotorCommand(lockstep.now, 60.0, 60.0)), "base_driver")
        lockstep.run(0.1)
    return scans, recorded, lockstep


def driver_config(model: str) -> LidarDriverConfig:
    port = PortConfig(device="wired", baud=BAUD.get(model, 115200))
    return LidarDriverConfig(model=spoken(model), port=port)


@pytest.mark.parametrize("model", MODELS)
def test_the_drivers_scans_are_the_simulators(model, tmp_path):
    sent, _, _ = scans_of(tmp_path, model, speaking=False)
    heard, _, _ = scans_of(tmp_path, model, speaking=True)
    assert len(heard) >= len(sent) - 2 - laser_of(model).rate
    for scan in heard:
        true = min(sent, key=lambda other: abs(other.stamp - scan.stamp))
        assert abs(scan.stamp - true.stamp) < CLOCK_ERROR.get(model, 5 * MS)
        assert scan.scan_time == pytest.approx(true.scan_time, abs=4e-4)
        assert (scan.angle_min, scan.angle_increment) == pytest.approx((true.angle_min, true.angle_increment))
        if model.startswith("ydlidar"):  # its samples lie between the beams, and shift with the distance
            errors = np.abs(scan.ranges - true.ranges)
            assert np.mean(np.isfinite(errors)) > 0.95
            assert np.nanpercentile(errors, 95) < 5.1e-4
            assert np.nanmax(errors) < 0.15
            continue
        np.testing.assert_array_equal(np.isnan(scan.ranges), np.isnan(true.ranges))
        assert_allclose(scan.ranges, true.ranges, atol=5.1e-4)


def test_the_driver_replays_to_the_bit_from_the_bytes_of_its_port(tmp_path):
    scans, recorded, lockstep = scans_of(tmp_path, "rplidar", speaking=True)
    lockstep.flush()
    driver = LidarDriverService(driver_config("rplidar"), robot_with(laser_of("rplidar")))
    replayed = replay(KeptBytes(recorded, "lidar_driver"), ["lidar_driver"], lambda name: driver)
    assert not replayed.gaps
    spoken = {"scan", "log/lidar_driver", "port/tx/lidar_driver"}
    assert [s.payload for s in replayed.sent["lidar_driver"]] == [s.payload for s in recorded if s.key in spoken]
    assert len(scans) > 10
