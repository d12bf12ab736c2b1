# SPDX-License-Identifier: Apache-2.0
"""`zenav bench serial`: the latency of the base driver's process on an emulated line, and the rate of the decoders.

    cmd/vel is published -> base_driver's process -> bytes at the line's far end

    the board's bytes at the far end -> base_driver's process -> base/wheels is received

This process measures both by one clock. Both include Zenoh's hop between the processes.
"""

import os
import sys
import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

import numpy as np
import zenoh

from services.base_driver.kinematics import board_counts, wheel_speeds
from services.sim.hardware.board import BoardEmulator
from services.sim.hardware.drrobot_board import DrRobotElectronics
from services.sim.hardware.faults import ActiveFaults
from shared import topics
from shared.codec import Envelope, encode
from shared.config import Drive, Robot, UserError, load_robot
from shared.messages import BoardReport, Velocity, WheelState
from shared.runners.port import PseudoTerminal
from zenav.bench.decoding import decoding
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.console.table import show_table
from zenav.stack.launch import Launcher, free_stack, service_command

AIM_COMMAND, AIM_WHEELS = 2.0, 3.0  # ms, p99
AIM_DECODING = 1.0  # MB/s on one core
PERIOD = 0.02  # s from report to report
START = 90.0  # s that the process may take to answer: a first start compiles its kernels
LOST = 1.0  # s after which an answer does not come any more; it counts as having taken so long
LIMITS = {"command_p99_ms": AIM_COMMAND, "wheels_p99_ms": AIM_WHEELS, "decoding_slowest_mb_s": AIM_DECODING}


def serial(seconds: float, out: Path | None) -> int:
    """Measures for `seconds`, shows and writes the figures; 0 when the aims are met."""
    check_writable(out)
    folder = new_run_folder("serial")
    with stop_on_signal() as stop:
        delays = measure_delays(seconds, folder, stop)
        if stop.is_set():
            return 130
    report = serial_figures(delays, decoding())
    show_figures(report)
    write_report(out, report)
    s = report["summary"]
    met = s["command_p99_ms"] < AIM_COMMAND and s["wheels_p99_ms"] < AIM_WHEELS
    return 0 if met and s["decoding_slowest_mb_s"] >= AIM_DECODING else 1


def measure_delays(seconds: float, folder: Path, stop: StopFlag) -> dict[str, list[float]]:
    """Runs base_driver on a pseudo-terminal; the delays, s, of each command, and of each report to its WheelState.

    `taken` is the part of the latter until the process had the bytes. Raises UserError where it does not answer.
    """
    robot = load_robot("x80sv").robot
    link = folder.resolve() / "board"
    settings = [f"base_driver.port.device={link}", "base_driver.port.serial_number=''"]
    delays: dict[str, list[float]] = {"command": [], "wheels": [], "taken": []}
    rng = np.random.default_rng(0)
    with free_stack() as claim, FarEnd(link, robot) as board, Client(robot.name, claim.where) as client:
        command = service_command("base_driver", "x80sv", str(claim.where.domain), settings)
        with Launcher({"base_driver": command}, folder) as launcher:
            commander = CommandPublisher(client, robot.drive)
            client.listen(topics.WHEELS, board.hear)
            launcher.start_all()
            limit, until, answered = time.monotonic() + START, 0.0, 0
            while not stop.is_set() and (not until or time.monotonic() < until):
                begun = time.monotonic()
                launcher.step()
                wheels = board.report(LOST if until else PERIOD)
                stop.wait(float(rng.uniform(0.1, 0.5)) * PERIOD)  # at every moment between two ticks of the driver
                delay = commander.command(board, LOST if until else PERIOD, zero=answered == 0)
                answered = answered + 1 if wheels is not None and delay is not None else 0
                if until:
                    delays["command"].append(LOST if delay is None else delay)
                    delays["wheels"].append(LOST if wheels is None else wheels[0])
                    delays["taken"].append(LOST if wheels is None else wheels[1])
                elif answered >= 1 / PERIOD:
                    until = time.monotonic() + seconds
                elif time.monotonic() > limit:
                    raise UserError("base_driver does not answer", f"see {folder}/base_driver.log")
                stop.wait(max(0.0, PERIOD - (time.monotonic() - begun)))
    return delays


class FarEnd:
    """The line's far end: an emulated board whose wheels turn as commanded. Use it as a context."""

    def __init__(self, link: Path, robot: Robot) -> None:
        self._line = PseudoTerminal(link)
        faults = ActiveFaults()
        self._board, self._lock = BoardEmulator(faults, 0, DrRobotElectronics(faults)), threading.Lock()
        self._n_ultrasonic = sum(sensor.kind == "ultrasonic" for sensor in robot.ranges)
        self._n_infrared = len(robot.ranges) - self._n_ultrasonic
        self._wrap = robot.drive.encoder_wrap
        self._turned, self._at = np.zeros(2), time.time_ns()
        self._expected: tuple[float, float] | None = None
        self._obeyed: SimpleQueue[int] = SimpleQueue()
        self._wheels: SimpleQueue[tuple[int, int, int]] = SimpleQueue()
        self._closing = False
        self._reader = threading.Thread(target=self._read, name="far end", daemon=True)

    def __enter__(self) -> "FarEnd":
        self._reader.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._closing = True
        self._reader.join()
        self._line.close()

    def hear(self, wheels: WheelState, envelope: Envelope) -> None:
        """A WheelState came."""
        self._wheels.put((wheels.stamp, time.time_ns(), envelope.sent))

    def report(self, patience: float) -> tuple[float, float] | None:
        """Writes a report's packets; s until its WheelState came, and until its bytes were taken; None: it did not."""
        now = time.time_ns()
        with self._lock:
            left, right, _ = self._board.motors(now)
            self._turned += np.array([left, right]) * ((now - self._at) * 1e-9)
            self._at = now
            counts = [int(count) % self._wrap for count in self._turned]
            truth = BoardReport(
                stamp=now,
                left_counts=counts[0],
                right_counts=counts[1],
                left_speed=float(left),
                right_speed=float(right),
                ultrasonic=np.full(self._n_ultrasonic, 2.0, np.float32),
                infrared=np.full(self._n_infrared, 0.3, np.float32),
                battery=8.0,
                currents=np.full(2, 0.5, np.float32),
            )
            packets = self._board.report_bytes(truth, now)
        begun = time.time_ns()
        self._line.write(packets)
        limit = time.monotonic() + patience
        while True:
            try:
                stamp, came, sent = self._wheels.get(timeout=max(0.0, limit - time.monotonic()))
            except Empty:
                return None
            if stamp >= begun:
                return (came - begun) * 1e-9, (sent - begun) * 1e-9

    def expect(self, left: int, right: int) -> None:
        """From now on looks for these counts/s."""
        with self._lock:
            self._expected = left, right

    def time_obeyed(self, patience: float) -> int | None:
        """ns when the bytes of what is expected had been read; None where they did not come."""
        try:
            return self._obeyed.get(timeout=patience)
        except Empty:
            with self._lock:
                self._expected = None
            return None

    def _read(self) -> None:
        while not self._closing:
            data = self._line.read()
            at = time.time_ns()
            if not data:
                continue
            with self._lock:
                self._line.write(self._board.receive(data, at))
                if self._expected == self._board.motors(at)[:2]:
                    self._expected = None
                    self._obeyed.put(at)


class CommandPublisher:
    """Publishes cmd/vel in the guard's place, each time another one."""

    def __init__(self, client: Client, drive: Drive) -> None:
        self._drive = drive
        self._publisher = client.session.declare_publisher(
            f"{client.robot}/{topics.CMD_VEL.key}",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self._sequence = 0

    def command(self, board: FarEnd, patience: float, zero: bool) -> float | None:
        """s from publishing a command until its bytes were read; None where they did not come.

        zero: stands first, as a driver demands that had lost its board.
        """
        if zero:
            self._publish(0.0, 0.0)
        v, w = 0.1 + 0.02 * (self._sequence % 7), 0.1 * (self._sequence % 3)
        left, right = board_counts(*wheel_speeds(v, w, self._drive), self._drive)
        board.expect(round(left), round(right))
        begun = self._publish(v, w)
        at = board.time_obeyed(patience)
        return (at - begun) * 1e-9 if at is not None else None

    def _publish(self, v: float, w: float) -> int:
        now = time.time_ns()
        self._sequence += 1
        self._publisher.put(encode(Velocity(now, v, w, ""), Envelope("guard", "bench", self._sequence, now)))
        return now


def serial_figures(delays: dict[str, list[float]], rates: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Percentiles of the delays, ms, and the decoders' rates."""
    names = {
        "command": "cmd/vel to bytes on the line",
        "wheels": "bytes on the line to base/wheels",
        "taken": "of that, until they are read",
    }
    rows = {
        names[key]: {f"p{p}": round(float(np.percentile(values, p)) * 1e3, 3) for p in (50, 95, 99, 100)}
        for key, values in delays.items()
    }
    summary = {
        "n": len(delays["command"]),
        "n_lost": sum(value >= LOST for key in ("command", "wheels") for value in delays[key]),
        **{f"{key}_p{p}_ms": rows[names[key]][f"p{p}"] for key in ("command", "wheels") for p in (50, 99)},
        "load_per_core": round(os.getloadavg()[0] / (os.cpu_count() or 1), 2),  # over 1, others took the processor
        "decoding_slowest_mb_s": min(rate for row in rates.values() for rate in row.values()),
    }
    return {"summary": summary, "limits": LIMITS, "delays": rows, "decoding_mb_s": rates}


def show_figures(report: dict[str, Any]) -> None:
    """The figures as tables, the aims below them."""
    s = report["summary"]
    rows = [(name, *(f"{row[p]:.2f}" for p in ("p50", "p95", "p99", "p100"))) for name, row in report["delays"].items()]
    show_table(f"{s['n']} commands and reports, {s['n_lost']} lost", ("ms", "p50", "p95", "p99", "max"), rows)
    sizes = list(next(iter(report["decoding_mb_s"].values())))
    rates = [(name, *(f"{row[size]:.1f}" for size in sizes)) for name, row in report["decoding_mb_s"].items()]
    show_table("decoders on one core", ("MB/s", *(f"in readings of {size} bytes" for size in sizes)), rates)
    sys.stdout.write(
        f"aims: p99 under {AIM_COMMAND:g} ms to the line and {AIM_WHEELS:g} ms from it, {AIM_DECODING:g} MB/s decoded; "
        f"the machine's load is {s['load_per_core']:.1f} a core\n"
    )
