# SPDX-License-Identifier: Apache-2.0
"""`zenav bench ros2`: the time that a message takes through the bridge to ROS 2, and the bridge's CPU and memory.

This process plays the stack, the router and the ROS 2 node. The bridge is a process of its own: once of a robot that
ROS 2 sees, and once of a robot with ROS 2 that is driven. The times contain two passages of Zenoh each.
"""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import psutil
import zenoh

from services.ros2.bridge_device import KIND
from services.ros2.ros_types import Distro, ros_types
from shared import topics
from shared.config import UserError, load_robot
from shared.messages import Health
from shared.runners.transport import router_configuration
from zenav.bench.ros2_traffic import N_BEAMS, ROBOT, BridgeTraffic, DrivenTraffic, OutgoingTraffic
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.stack.launch import StackClaim, free_stack

MAX_P99_MS, MAX_CPU, MAX_IDLE_CPU = 5.0, 0.10, 0.02
READY_S, IDLE_S, WARM_UP_S = 20.0, 5.0, 1.0
NO_SUBSCRIBER = "nothing: no subscriber"
DRIVEN = [
    word for row in ("ros2.drives=true", "robot.drive.kind=velocity", "robot.ranges=[]") for word in ("--set", row)
]
Traffic = TypeVar("Traffic", bound=BridgeTraffic)


@dataclass(frozen=True, slots=True)
class BridgeUsage:
    """Of the bridge's process: share of a core, and proportional set size."""

    cpu: float
    pss_mb: float


def ros2(out: Path | None, seconds: float) -> int:
    """0 when the limits are kept."""
    check_writable(out)
    with free_stack() as claim, _router() as (port, endpoint):
        settings = ["--set", f"ros2.port.device={KIND}://{endpoint}", "--stack", str(claim.where.domain)]
        with _stack(claim) as stack, _bridge(settings, stack) as process, _node(port) as node:
            idle = _used(process, lambda: _wait(IDLE_S))
            seen, busy = _measured(OutgoingTraffic(stack, node, ros_types(Distro.JAZZY)), process, seconds)
        settings += DRIVEN
        with _stack(claim) as stack, _bridge(settings, stack) as process, _node(port) as node:
            driven, driving = _measured(DrivenTraffic(stack, node, ros_types(Distro.JAZZY)), process, seconds)
    latencies = {
        "/scan out": seen.scans.ms,
        "/cmd_vel in": seen.commands.ms,
        "/scan in": driven.scans.ms,
        "/cmd_vel out": driven.commands.ms,
    }
    usages = {NO_SUBSCRIBER: idle, "/scan /odom /tf out": busy, "/scan /odom in": driving}
    report = figures(latencies, usages) | {"seconds": seconds}
    show(report)
    write_report(out, report)
    return 0 if report["kept"] else 1


def figures(latencies: dict[str, list[float]], usages: dict[str, BridgeUsage]) -> dict[str, Any]:
    """The report: latencies in ms, usage, and whether the limits are kept. Raises UserError without messages."""
    for name, values in latencies.items():
        if not values:
            raise UserError(f"no message of {name} passed the bridge", "see its log: zenav ros2 --log DEBUG")
    rows = {
        name: {"n": len(values), "p50_ms": float(np.percentile(values, 50)), "p99_ms": float(np.percentile(values, 99))}
        for name, values in latencies.items()
    }
    kept = all(row["p99_ms"] <= MAX_P99_MS for row in rows.values()) and all(
        usage.cpu <= (MAX_IDLE_CPU if name == NO_SUBSCRIBER else MAX_CPU) for name, usage in usages.items()
    )
    usage = {name: {"cpu": u.cpu, "pss_mb": u.pss_mb} for name, u in usages.items()}
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
    show_table("the bridge's process", ("what passes", "CPU, % of a core", "PSS, MB"), usage)


def _stack(claim: StackClaim) -> Client:
    """A client in the place of the stack's services."""
    return Client(load_robot(ROBOT).robot.name, claim.where, "lidar_driver")


def _measured(traffic: Traffic, process: psutil.Process, seconds: float) -> tuple[Traffic, BridgeUsage]:
    """The traffic after so long, and what the bridge used meanwhile."""
    traffic.run(WARM_UP_S)
    traffic.clear()
    usage = _used(process, lambda: traffic.run(seconds))
    return traffic, usage


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
