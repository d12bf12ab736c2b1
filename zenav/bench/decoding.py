# SPDX-License-Identifier: Apache-2.0
"""How many bytes a second each hardware decoder takes on one core, in large and in small readings."""

import time
from collections.abc import Callable
from math import pi
from statistics import median

import numpy as np

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.serial_board import SerialBoard
from services.lidar_driver.service import DEVICES, LidarDriverConfig
from services.sim.hardware.board import BoardEmulator
from services.sim.hardware.drrobot_board import DrRobotElectronics
from services.sim.hardware.faults import ActiveFaults
from services.sim.hardware.lasers import make_emulator
from shared.config import Laser, load_robot
from shared.messages import BoardReport, LaserScan, SerialData

SIZES = (4096, 64)  # bytes of a reading
LASERS = {"ld06": (450, 10), "xv11": (360, 5), "scip": (682, 10), "rplidar": (360, 5), "rplidar_a2": (400, 10)}
"""Emulated model -> beams of a sweep, sweeps a second."""
SCIP_PER_TURN = 1024
TICK = 20_000_000  # ns
START = 1_700_000_000_000_000_000  # ns
DIALOGUE = 500  # ticks in which a laser's start sequence is through
PARTS = 5  # of a stream, of whose rates the median counts

Decoder = Callable[[bytes], object]


def decoding(n_bytes: int = 200_000) -> dict[str, dict[str, float]]:
    """MB a second of CPU time, by decoder and size of the readings."""
    rates = {}
    for name in ("board", *LASERS):
        decoder, stream = _board(n_bytes) if name == "board" else _laser(name, n_bytes)
        rates[name] = {str(size): round(_rate(decoder, stream, size), 2) for size in SIZES}
    return rates


def _rate(decoder: Decoder, stream: bytes, size: int) -> float:
    """MB/s: the median over parts of the stream."""
    pieces = [stream[i : i + size] for i in range(0, len(stream), size)]
    each = -(-len(pieces) // PARTS)
    rates = []
    for i in range(0, len(pieces), each):
        part = pieces[i : i + each]
        begun = time.thread_time()
        for piece in part:
            decoder(piece)
        rates.append(sum(map(len, part)) / (time.thread_time() - begun) / 1e6)
    return median(rates)


def _board(n_bytes: int) -> tuple[Decoder, bytes]:
    """Bytes to BoardReports, and what the X80SV's board says while it drives."""
    decoder, emulated = (
        SerialBoard(SerialBoardConfig(), load_robot("x80sv").robot, 0.5),
        BoardEmulator(ActiveFaults(), 0, DrRobotElectronics(ActiveFaults())),
    )
    decoder.warm_up()
    stream, i = bytearray(), 0
    while len(stream) < n_bytes:
        report = BoardReport(
            stamp=START + i * TICK,
            left_counts=i % 32768,
            right_counts=7 * i % 32768,
            left_speed=50.0,
            right_speed=350.0,
            ultrasonic=np.full(3, 1.0, np.float32),
            infrared=np.full(7, 0.3, np.float32),
            battery=7.2,
            currents=np.ones(2, np.float32),
        )
        stream += emulated.report_bytes(report, report.stamp)
        i += 1
    return lambda data: decoder.receive(SerialData(START, "board", data), START), bytes(stream)


def _laser(model: str, n_bytes: int) -> tuple[Decoder, bytes]:
    """Bytes to returns, and what the laser says after its start sequence, of sweeps of random ranges."""
    n, rate = LASERS[model]
    increment = 2 * pi / (SCIP_PER_TURN if model == "scip" else n)
    clockwise = model.startswith(("ld06", "rplidar"))
    laser = Laser(
        angle_min=-n * increment / 2 if model == "scip" else 0.0,
        angle_increment=-increment if clockwise else increment,
        n_beams=n,
        scan_time=(n - 1) * increment / (2 * pi * rate),
        rate=rate,
        range_min=0.05,
        range_max=12.0,
    )
    emulated = make_emulator(model, laser)
    config = LidarDriverConfig(model=model.removesuffix("_a2"))
    decoder = DEVICES[config.model](config, laser)
    now, command = START, decoder.start(START)
    for _ in range(DIALOGUE):
        answer = emulated.receive(command, now) if command else b""
        if answer:
            decoder.receive(answer, now)
        now += TICK
        command = decoder.next_command(now)
    rng, stream = np.random.default_rng(0), bytearray()
    while len(stream) < n_bytes:
        ranges = rng.uniform(0.1, 11.9, n).astype(np.float32)
        sweep = LaserScan(
            stamp=now,
            angle_min=laser.angle_min,
            angle_increment=laser.angle_increment,
            scan_time=laser.scan_time,
            range_min=0.05,
            range_max=12.0,
            ranges=ranges,
        )
        stream += b"".join(data for _, data in emulated.sweep_chunks(sweep, now))
        now += round(1e9 / rate)
        if not stream:
            raise RuntimeError(f"the emulated {model} does not scan")
    return lambda data: decoder.receive(data, START), bytes(stream)
