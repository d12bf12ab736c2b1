# SPDX-License-Identifier: Apache-2.0
"""What the gateway costs: the time of a scan's bytes between two services, and to a member over TLS.

Publisher and subscriber are processes with sessions as services have. CLOCK_MONOTONIC is one for all processes of a
computer, also in another network namespace, so a message carries the time at which it was sent. With root and `ip` the
member is in a namespace of its own, behind a pair of virtual devices; otherwise on loopback.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from shared.config import UserError, load_robot
from shared.runners import transport
from shared.secure_folder import MemberRole, SecureFolder
from zenav.bench.gateway_subscriber import MARK, STAMP
from zenav.bench.listener import wait_for_listener
from zenav.bench.member_namespace import MemberNamespace, member_namespace
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.secure.members import add_member, init_folder
from zenav.stack.launch import free_stack

SCAN_BYTES = 3000  # a message of 720 beams
RATE_HZ = 40.0
MAX_ADDED_MS, MAX_TLS_MS = 1.0, 3.0  # of p99, over the direct one
WARM_UP = 40  # messages that are not counted
ROBOT = "x80sv"
DIRECT = "a service"
SUBSCRIBER = sys.executable, "-m", "zenav.bench.gateway_subscriber"


@dataclass(frozen=True, slots=True)
class LinkLatency:
    """ms from publishing to the subscriber's callback, and the subscriber's share of a core."""

    n: int
    lost: int
    p50: float
    p99: float
    cpu: float


def gateway(out: Path | None, seconds: float) -> int:
    """`zenav bench gateway`; 0 when the limits are kept."""
    check_writable(out)
    robot = load_robot(ROBOT).robot.name
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        claim = stack.enter_context(free_stack())
        members = stack.enter_context(member_namespace())
        place = SecureFolder(folder / "secure")
        viewer = viewer_credentials(place, ROBOT)
        rows, usage = _measure(place, claim.where.domain, robot, members, viewer, seconds)
    report = figures(rows, usage) | {"namespace": bool(members.name), "seconds": seconds, "rate_hz": RATE_HZ}
    show(report)
    write_report(out, report)
    return 0 if report["kept"] else 1


def figures(rows: dict[str, LinkLatency], usage: dict[str, dict[str, float]]) -> dict[str, Any]:
    """The report: latencies, the gateway's usage, and whether the limits are kept."""
    direct = rows[DIRECT].p99
    limits = {name: direct + (MAX_TLS_MS if "TLS" in name else MAX_ADDED_MS) for name in rows if name != DIRECT}
    return {
        "links": {
            name: {"n": row.n, "lost": row.lost, "p50_ms": row.p50, "p99_ms": row.p99, "cpu": row.cpu,
                   "limit_ms": limits.get(name)}
            for name, row in rows.items()
        },
        "gateway": usage,
        "kept": all(rows[name].p99 <= limit for name, limit in limits.items()),
    }  # fmt: skip


def viewer_credentials(place: SecureFolder, robot: str) -> Path:
    """Makes a secure folder with one member, a viewer; the file of its credentials, beside the folder."""
    file = place.path.with_name("bench.pem")
    with redirect_stdout(sys.stderr):
        init_folder(robot, str(place.path), [])
        add_member("bench", MemberRole.VIEWER, str(place.path), file, 1)
    return file


def free_endpoint(members: MemberNamespace) -> str:
    """HOST:PORT at which members can reach a gateway, and no process listens."""
    with socket.socket() as probe:
        probe.bind((members.robot, 0))
        return f"{members.robot}:{probe.getsockname()[1]}"


def gateway_settings(place: SecureFolder, address: str) -> list[str]:
    """The settings of a gateway that listens at HOST:PORT."""
    return [f"gateway.port.device=tls://{address}", f"gateway.folder={place.path}"]


def member_subscriber(members: MemberNamespace, endpoint: str, viewer: Path, key: str) -> list[str]:
    """The command of a member that subscribes to a key."""
    return members.inside(*SUBSCRIBER, endpoint, str(viewer), key)


def show(report: dict[str, Any]) -> None:
    """Prints the tables."""
    links = [
        (name, str(row["n"]), str(row["lost"]), f"{row['p50_ms']:.2f}", f"{row['p99_ms']:.2f}",
         "" if row["limit_ms"] is None else f"{row['limit_ms']:.2f}", f"{row['cpu'] * 100:.1f}")
        for name, row in report["links"].items()
    ]  # fmt: skip
    where = "in a network namespace" if report["namespace"] else "on loopback"
    title = f"messages of {SCAN_BYTES} bytes at {RATE_HZ:g} Hz, the member {where}"
    columns = ("from a service to", "messages", "lost", "p50, ms", "p99, ms", "limit, ms", "CPU, % of a core")
    show_table(title, columns, links)
    rows = [(name, f"{row['cpu'] * 100:.1f}", f"{row['pss_mb']:.0f}") for name, row in report["gateway"].items()]
    show_table("the gateway, both processes", ("", "CPU, % of a core", "PSS, MB"), rows)


def _measure(
    place: SecureFolder, domain: int, robot: str, members: MemberNamespace, viewer: Path, seconds: float
) -> tuple[dict[str, LinkLatency], dict[str, dict[str, float]]]:
    """Latencies by subscriber, and CPU and PSS of the gateway by situation."""
    key, n = f"{robot}/scan", max(round(seconds * RATE_HZ), 1)
    address = free_endpoint(members)
    usage: dict[str, dict[str, float]] = {}
    with transport.opened(transport.StackAddress(domain), "lidar_driver") as session, ExitStack() as children:
        local = children.enter_context(_subscriber([*SUBSCRIBER, str(domain), "mapper", key]))
        rows = {DIRECT: _run(session, key, n, [local])[0]}
        process = children.enter_context(_gateway(place, domain, address))
        wait_for_listener(address)
        with _watched(process, usage, "no member"):
            rows["a service, with a gateway"] = _run(session, key, n, [local])[0]
        member = children.enter_context(
            _subscriber(member_subscriber(members, f"tls/{address}", viewer, f"{robot}/**"))
        )
        with _watched(process, usage, "a member of all topics"):
            both = _run(session, key, n, [local, member])
        rows["a service, with a member of all topics"], rows["that member, over TLS"] = both
    return rows, usage


def _run(session: Any, key: str, n: int, subscribers: list[subprocess.Popen[str]]) -> list[LinkLatency]:
    """Publishes n messages; the latency at each subscriber."""
    _publish(session, key, WARM_UP)
    for subscriber in subscribers:
        subscriber_report(subscriber)
    began = time.monotonic()
    _publish(session, key, n)
    elapsed = time.monotonic() - began
    return [_latency(subscriber_report(subscriber), n, elapsed) for subscriber in subscribers]


def _publish(session: Any, key: str, n: int) -> None:
    rest = os.urandom(SCAN_BYTES - STAMP.size)
    due = time.monotonic()
    for _ in range(n):
        session.put(key, STAMP.pack(MARK, time.monotonic_ns()) + rest)
        due += 1 / RATE_HZ
        threading.Event().wait(max(due - time.monotonic(), 0))
    threading.Event().wait(0.5)  # for the last ones


def _latency(report: dict[str, Any], n: int, seconds: float) -> LinkLatency:
    times = np.asarray(report["times"], float)
    if not len(times):
        raise UserError("no message arrived", "is a firewall between the network namespaces?")
    p50, p99 = np.percentile(times, (50, 99))
    return LinkLatency(len(times), n - len(times), float(p50), float(p99), report["cpu_s"] / seconds)


def subscriber_report(subscriber: subprocess.Popen[str]) -> dict[str, Any]:
    """What a subscriber took since its last report."""
    assert subscriber.stdin is not None
    assert subscriber.stdout is not None
    subscriber.stdin.write("report\n")
    subscriber.stdin.flush()
    return dict(json.loads(subscriber.stdout.readline()))


# --- processes --------------------------------------------------------------------------------------------------------


@contextmanager
def _subscriber(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline() != "ready\n":
                raise UserError("the subscriber did not begin", "see its error above")
            yield process
        finally:
            process.kill()


@contextmanager
def _gateway(place: SecureFolder, domain: int, address: str) -> Iterator[psutil.Process]:
    options = [word for setting in gateway_settings(place, address) for word in ("--set", setting)]
    command = [sys.executable, "-m", "services.gateway", "--stack", str(domain), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield psutil.Process(process.pid)
    finally:
        process.terminate()
        process.wait(10)


@contextmanager
def _watched(process: psutil.Process, usage: dict[str, dict[str, float]], situation: str) -> Iterator[None]:
    """Notes the CPU, as a share of a core, and the PSS of a process and its children."""
    began, used = time.monotonic(), _cpu_s(process)
    yield
    share = (_cpu_s(process) - used) / (time.monotonic() - began)
    family = [process, *process.children(recursive=True)]
    usage[situation] = {"cpu": share, "pss_mb": sum(p.memory_full_info().pss for p in family) / 1e6}


def _cpu_s(process: psutil.Process) -> float:
    times = [p.cpu_times() for p in (process, *process.children(recursive=True))]
    return float(sum(t.user + t.system for t in times))
