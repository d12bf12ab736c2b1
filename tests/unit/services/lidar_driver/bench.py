# SPDX-License-Identifier: Apache-2.0
"""A driver at the end of an emulated laser's line, without a runner."""

from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.lidar_driver.service import LidarDriverConfig, LidarDriverService
from services.sim.hardware.lasers import Chunks, LaserEmulator, make_emulator
from shared import topics
from shared.config import Laser, Robot, load_robot
from shared.messages import LaserScan, PortState, SerialData
from shared.service import Log, Out
from shared.types import NS_PER_S

MS = 1_000_000
START = 1_700_000_000 * NS_PER_S
TICK = 20 * MS

SWEEPS: dict[str, dict[str, Any]] = {
    "ld06": {"angle_min": 0.0, "angle_increment": -2 * pi / 450, "n_beams": 450, "rate": 10.0},
    "ld14": {"angle_min": 0.0, "angle_increment": -2 * pi / 384, "n_beams": 384, "rate": 6.0},
    "stl27l": {"angle_min": 0.0, "angle_increment": -2 * pi / 2160, "n_beams": 2160, "rate": 10.0},
    "xv11": {"angle_min": 0.0, "angle_increment": pi / 180, "n_beams": 360, "rate": 5.0},
    "scip": {"angle_min": -340 * 2 * pi / 1024, "angle_increment": 2 * pi / 1024, "n_beams": 682, "rate": 10.0},
    "rplidar": {"angle_min": 0.0, "angle_increment": -2 * pi / 360, "n_beams": 360, "rate": 5.0},
    "rplidar_a2": {"angle_min": -pi, "angle_increment": -2 * pi / 400, "n_beams": 400, "rate": 10.0},
    "rplidar_c1": {"angle_min": 0.0, "angle_increment": -2 * pi / 500, "n_beams": 500, "rate": 10.0},
    "rplidar_s1": {"angle_min": 0.0, "angle_increment": -2 * pi / 920, "n_beams": 920, "rate": 10.0},
    "rplidar_s2": {"angle_min": 0.0, "angle_increment": -2 * pi / 3200, "n_beams": 3200, "rate": 10.0},
    "ydlidar_x2": {"angle_min": 0.0, "angle_increment": -2 * pi / 500, "n_beams": 500, "rate": 6.0, "range_min": 2.95},
    "ydlidar_x4": {"angle_min": 0.0, "angle_increment": -2 * pi / 500, "n_beams": 500, "rate": 10.0, "range_min": 2.95},
    "ydlidar_g2": {"angle_min": 0.0, "angle_increment": -2 * pi / 500, "n_beams": 500, "rate": 10.0, "range_min": 2.95},
}
"""Emulated model -> its sweep.

The beams of the YDLIDARs shift with the distance: only from 3 m on does a sample of any beam stay in the beam's place.
"""
MODELS = tuple(SWEEPS)
CLOCK_ERROR = {"ld14": 12 * MS, "ydlidar_x2": 15 * MS, "ydlidar_x4": 8 * MS, "ydlidar_g2": 8 * MS}
"""ns, of the first sweeps; others 5 ms. With few packets a tick of 20 ms, none of the first ones arrives at once."""
BAUD = {
    "ld06": 230400,
    "stl27l": 921600,
    "rplidar_c1": 460800,
    "rplidar_s1": 256000,
    "rplidar_s2": 1000000,
    "ydlidar_x4": 128000,
    "ydlidar_g2": 230400,
}


def laser_of(model: str) -> Laser:
    sweep = SWEEPS[model]
    share = (sweep["n_beams"] - 1) * abs(sweep["angle_increment"]) / (2 * pi)
    return Laser(**{"range_min": 0.05, "range_max": 12.0, "scan_time": share / sweep["rate"]} | sweep)


def robot_with(laser: Laser) -> Robot:
    return load_robot("x80sv").robot.model_copy(update={"laser": laser})


def spoken(model: str) -> str:
    """lidar_driver.model of an emulated model."""
    return "rplidar" if model.startswith("rplidar") else model


def made_driver(model: str, laser: Laser | None = None, **settings: Any) -> LidarDriverService:
    values = {
        "model": spoken(model),
        "port": {"device": "there", "baud": BAUD.get(model, 115200)},
        "mask_footprint": False,
    }
    config = LidarDriverConfig.model_validate(values | settings)
    driver = LidarDriverService(config, robot_with(laser or laser_of(model)))
    driver.now = START
    return driver


class Faulty:
    """A laser behind a bad line: shares of its chunks come after random bytes, break off, or have a wrong bit."""

    def __init__(
        self, laser: LaserEmulator, seed: int, garbage: float = 0.0, half: float = 0.0, bad_sum: float = 0.0
    ) -> None:
        self.laser, self.garbage, self.half, self.bad_sum = laser, garbage, half, bad_sum
        self.rng = np.random.default_rng(seed)
        self.turning = True

    def receive(self, data: bytes, now: int) -> bytes:
        return self.laser.receive(data, now)

    def sweep_chunks(self, scan: LaserScan, now: int) -> Chunks:
        return [(at, self._spoiled(data)) for at, data in self.laser.sweep_chunks(scan, now)]

    def _spoiled(self, data: bytes) -> bytes:
        half, bad_sum, garbage = self.rng.random(3) < (self.half, self.bad_sum, self.garbage)
        if half:
            data = data[: len(data) // 2]
        if bad_sum and data:
            wrong = bytearray(data)
            wrong[int(self.rng.integers(len(data)))] ^= 1 << int(self.rng.integers(8))
            data = bytes(wrong)
        if garbage:
            data = self.rng.bytes(int(self.rng.integers(1, 60))) + data
        return data


class DeviceLine:
    """Laser and driver, the stack's clock, and all that either says."""

    def __init__(self, driver: LidarDriverService, laser: LaserEmulator) -> None:
        self.driver, self.laser = driver, laser
        self.now = START
        self.written: list[bytes] = []
        self.scans: list[LaserScan] = []
        self.lines: list[str] = []
        self.leaving: list[tuple[int, bytes]] = []
        self.passes: Callable[[bytes], bytes] = lambda data: data  # what the line does to bytes
        self.delay: Callable[[], int] = lambda: 0  # ns more until the port has read
        self.stack_time: Callable[[int], int] = lambda true: true  # the stack's clock at a true time
        self.take(driver.plugged(PortState(START, "laser", True, "")))

    def take(self, out: Out) -> None:
        for said in out:
            if isinstance(said, Log):
                self.lines.append(said.text)
            elif said.topic is topics.TX:
                self.written.append(said.message.data)
            else:
                assert said.topic is topics.SCAN
                self.scans.append(said.message)

    def hear(self, data: bytes) -> None:
        data = self.passes(data)
        if data:
            self.take(self.driver.receive(SerialData(self.driver.now, "laser", data)))

    def step(self, sweeps: list[LaserScan]) -> None:
        """20 ms of true time, and the sweeps that ended in it."""
        self.now += TICK
        orders, self.written = self.written, []
        answer = b"".join(self.laser.receive(order, self.now) for order in orders)
        for sweep in sweeps:
            self.leaving += self.laser.sweep_chunks(sweep, self.now)
        due = [(when, data) for when, data in self.leaving if when <= self.now]
        self.leaving = [(when, data) for when, data in self.leaving if when > self.now]
        self.driver.now = self.stack_time(self.now + self.delay())
        self.hear(answer + b"".join(data for _, data in due))
        self.take(self.driver.watch())

    def run(self, sweeps: list[LaserScan], seconds: float) -> None:
        end = self.now + round(seconds * NS_PER_S)
        while self.now < end:
            ended = [s for s in sweeps if self.now < s.stamp + round(s.scan_time * NS_PER_S) <= self.now + TICK]
            self.step(ended)


def line_of(model: str, **settings: Any) -> DeviceLine:
    return DeviceLine(made_driver(model, **settings), make_emulator(model, laser_of(model)))


def sweep_of(laser: Laser, stamp: int, ranges: NDArray[Any]) -> LaserScan:
    return LaserScan(
        stamp, laser.angle_min, laser.angle_increment, laser.scan_time, laser.range_min, laser.range_max,
        np.asarray(ranges, np.float32),
    )  # fmt: skip


def random_sweeps(laser: Laser, seconds: float, seed: int = 0, start: int = START) -> list[LaserScan]:
    """Sweeps of random ranges in whole mm, 2 % of them empty, at the laser's rate."""
    rng = np.random.default_rng(seed)
    sweeps = []
    for k in range(int(seconds * laser.rate)):
        ranges = np.round(rng.uniform(laser.range_min + 0.05, 11.9, laser.n_beams), 3)
        ranges[rng.random(laser.n_beams) < 0.02] = np.nan
        sweeps.append(sweep_of(laser, start + round(k * NS_PER_S / laser.rate), ranges))
    return sweeps


def truth_of(scan: LaserScan, sweeps: list[LaserScan]) -> LaserScan:
    """The sweep that a scan reports: the one nearest in time."""
    return min(sweeps, key=lambda sweep: abs(sweep.stamp - scan.stamp))
