# SPDX-License-Identifier: Apache-2.0
"""`zenav bench ros2`: the time that a message takes through the bridge to ROS 2, and the bridge's CPU and memory.

This process plays the laser, the odometry, the router and the ROS 2 node. The bridge is a process of its own. Scans
have 720 beams and come 10 times a second, odometry 50 times. The times contain two passages of Zenoh each.
"""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh

from services.ros2.bridge_device import KIND
from services.ros2.rmw_names import RosName
from services.ros2.ros_format import RmwZenohFormat
from services.ros2.ros_types import Distro, RosTypes, ros_types
from shared import sample_messages, topics
from shared.config import Laser, UserError, load_robot
from shared.messages import Health
from shared.ros_messages import ODOM, SCAN, TF, RosFrames, RosMessages
from shared.runners.transport import router_configuration
from shared.types import NS_PER_S
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.stack.launch import free_stack

ROBOT, N_BEAMS = "x80sv", 720
TICK_S, TICKS_A_SCAN, TICKS_A_COMMAND = 0.02, 5, 5
MAX_P99_MS, MAX_CPU, MAX_IDLE_CPU = 5.0, 0.10, 0.02
READY_S, IDLE_S, WARM_UP_S = 20.0, 5.0, 1.0
TWIST = "geometry_msgs/msg/Twist"
GID = bytes(16)


@dataclass(frozen=True, slots=True)
class BridgeUsage:
    """Of the bridge's process: share of a core, and proportional set size."""

    cpu: float
    pss_mb: float


def ros2(out: Path | None, seconds: float) -> int:
    """0 when the limits are kept."""
    check_writable(out)
    name = load_robot(ROBOT).robot.name
    with free_stack() as claim, _router() as (port, endpoint), Client(name, claim.where, "lidar_driver") as stack:
        settings = ["--set", f"ros2.port.device={KIND}://{endpoint}", "--stack", str(claim.where.domain)]
        with _bridge(settings, stack) as process, _node(port) as node:
            idle = _used(process, lambda: _wait(IDLE_S))
            traffic = BridgeTraffic(stack, node, ros_types(Distro.JAZZY))
            traffic.run(WARM_UP_S)
            traffic.clear()
            busy = _used(process, lambda: traffic.run(seconds))
    report = figures(traffic.scan_ms, traffic.command_ms, idle, busy) | {"seconds": seconds}
    show(report)
    write_report(out, report)
    return 0 if report["kept"] else 1


def figures(scan_ms: list[float], command_ms: list[float], idle: BridgeUsage, busy: BridgeUsage) -> dict[str, Any]:
    """The report: latencies in ms, usage, and whether the limits are kept. Raises UserError without messages."""
    if not scan_ms or not command_ms:
        raise UserError("no message passed the bridge", "see its log: zenav ros2 --log DEBUG")
    rows = {
        name: {"n": len(values), "p50_ms": float(np.percentile(values, 50)), "p99_ms": float(np.percentile(values, 99))}
        for name, values in (("/scan out", scan_ms), ("/cmd_vel in", command_ms))
    }
    kept = (
        all(row["p99_ms"] <= MAX_P99_MS for row in rows.values()) and busy.cpu <= MAX_CPU and idle.cpu <= MAX_IDLE_CPU
    )
    usage = {
        name: {"cpu": u.cpu, "pss_mb": u.pss_mb} for name, u in (("no subscriber", idle), ("/scan /odom /tf", busy))
    }
    return {"latency": rows, "bridge": usage, "kept": kept}


def show(report: dict[str, Any]) -> None:
    """Prints the tables."""
    rows = [
        (name, str(row["n"]), f"{row['p50_ms']:.2f}", f"{row['p99_ms']:.2f}", f"{MAX_P99_MS:g}")
        for name, row in report["latency"].items()
    ]
    title = f"through the bridge, with {N_BEAMS} beams at 10 Hz"
    show_table(title, ("", "messages", "p50, ms", "p99, ms", "limit, ms"), rows)
    usage = [(name, f"{row['cpu'] * 100:.1f}", f"{row['pss_mb']:.0f}") for name, row in report["bridge"].items()]
    show_table("the bridge's process", ("ROS 2 nodes subscribe to", "CPU, % of a core", "PSS, MB"), usage)


class BridgeTraffic:
    """Publishes on both sides, and measures on the other. The stamp of a scan, and a command's turn rate, name it."""

    def __init__(self, stack: Client, node: zenoh.Session, types: RosTypes) -> None:
        self._stack, self._node, self._types = stack, node, types
        self._make = RosMessages(types.types, RosFrames())
        self._format = RmwZenohFormat(0, "", "bench")
        self.scan_ms: list[float] = []
        self.command_ms: list[float] = []
        self._scans: dict[int, float] = {}
        self._commands: dict[float, float] = {}
        self._n = 0
        robot = load_robot(ROBOT).robot
        self._laser: Laser = robot.laser.model_copy(
            update={"n_beams": N_BEAMS, "angle_increment": 2 * np.pi / N_BEAMS, "angle_min": -np.pi}
        )
        self._subscribers = [
            node.declare_subscriber(self._key("/scan", SCAN), self._hear_scan),
            *(node.declare_subscriber(self._key(*row), lambda sample: None) for row in (("/odom", ODOM), ("/tf", TF))),
        ]
        stack.listen(topics.TELEOP, lambda command, _: self._hear_command(command.w))
        self._publisher = node.declare_publisher(self._key("/cmd_vel", TWIST))

    def run(self, seconds: float) -> None:
        """Publishes for so long."""
        due = time.monotonic()
        for i in range(round(seconds / TICK_S)):
            stamp = self._stack.now()
            self._stack.publish(topics.ODOM(sample_messages.odometry(stamp)))
            if i % TICKS_A_SCAN == 0:
                self._stack.publish(topics.POSE(sample_messages.pose_estimate(stamp)))
                self._send_scan(stamp)
            elif i % TICKS_A_COMMAND == 1:
                self._send_command()
            due += TICK_S
            threading.Event().wait(max(0.0, due - time.monotonic()))

    def clear(self) -> None:
        """Forgets what was measured so far."""
        self.scan_ms.clear()
        self.command_ms.clear()

    def _send_scan(self, stamp: int) -> None:
        scan = replace(sample_messages.scan(stamp, self._laser), stamp=stamp)
        self._scans[stamp] = time.perf_counter()
        self._stack.publish(topics.SCAN(scan))

    def _send_command(self) -> None:
        self._n += 1
        w = round(0.001 * (self._n % 1000), 3)
        data = self._types.encode(self._make.twist(0.0, w))
        self._commands[w] = time.perf_counter()
        self._publisher.put(data, attachment=self._format.attachment(self._n, time.time_ns(), GID))

    def _hear_scan(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        stamp = self._types.decode(sample.payload.to_bytes(), SCAN).header.stamp
        begun = self._scans.pop(stamp.sec * NS_PER_S + stamp.nanosec, None)
        if begun is not None:
            self.scan_ms.append((now - begun) * 1e3)

    def _hear_command(self, w: float) -> None:
        now = time.perf_counter()
        begun = self._commands.pop(round(w, 3), None)
        if begun is not None:
            self.command_ms.append((now - begun) * 1e3)

    def _key(self, name: str, type_: str) -> str:
        return self._format.key(RosName(name, type_, self._types.hash_of(type_)))


def _wait(seconds: float) -> None:
    """Nothing happens for so long."""
    threading.Event().wait(seconds)


def _used(process: psutil.Process, work: Callable[[], None]) -> BridgeUsage:
    before, begun = process.cpu_times(), time.monotonic()
    work()
    after, elapsed = process.cpu_times(), time.monotonic() - begun
    spent = after.user + after.system - before.user - before.system
    return BridgeUsage(spent / elapsed, process.memory_full_info().pss / 2**20)


@contextmanager
def _router() -> Iterator[tuple[int, str]]:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = int(probe.getsockname()[1])
    endpoint = f"tcp/127.0.0.1:{port}"
    with zenoh.open(router_configuration(endpoint)):
        yield port, endpoint


@contextmanager
def _node(port: int) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{port}"], "scouting/multicast/enabled": False}
    for key, value in (settings | {"transport/shared_memory/enabled": False}).items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


@contextmanager
def _bridge(settings: list[str], stack: Client) -> Iterator[psutil.Process]:
    """The bridge's process, once it is connected."""
    ready = threading.Event()

    def hear(health: Health) -> None:
        if health.name == "ros2" and health.state.startswith("in domain"):
            ready.set()

    stack.listen(topics.HEALTH, lambda health, _: hear(health))
    child = subprocess.Popen([sys.executable, "-P", "-m", "services.ros2", *settings, "--log", "ERROR"])
    try:
        if not ready.wait(READY_S):
            raise UserError("the bridge does not start", "see zenav ros2 --log DEBUG")
        yield psutil.Process(child.pid)
    finally:
        child.terminate()
        child.wait(READY_S)
