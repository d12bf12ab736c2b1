# SPDX-License-Identifier: Apache-2.0
"""`zenav bench site`: a robot drives a route while its link to a site is clear, cut, slow and back.

The site is in a network namespace behind a link that delays and drops IP packets (lossy_link.py). One stack runs
through all phases. The bytes are counted at the robot's network interface, both ways together.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from services.gateway.router_process import RouterProcess
from shared import requests, topics
from shared.config import UserError, load_robot
from shared.geometry import Pose2
from shared.messages import GuardState, GuardStatus, Health, Truth
from shared.requests import Cancel, Navigate
from shared.secure_folder import MemberRole, SecureFolder
from zenav.bench.lossy_link import LOST, LossyLink, lossy_link
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.latency import LatencyChain, latency_chain
from zenav.secure.members import add_member, init_folder
from zenav.stack.launch import Launcher, free_stack, service_command

SERVICES = ("recorder", "sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator")
ROUTE = (Pose2(0.9, 0.0, 0.0), Pose2(0.0, 0.0, 0.0))  # in `map` of the world `room`
START_S = 120.0
SLOW_DELAY_S, SLOW_LOSS = 0.2, 0.1
STANDS_BELOW = 0.01  # m/s and rad/s
LIMITS_KB_S = {"rest": 2.0, "drives": 20.0, "drives, watched": 200.0}
MAX_RATIO = 1.25
"""of the median latency in any phase to that on a clear link. Noise of a busy computer is in it."""
ROUTER, PORT = "tcp/127.0.0.1:7447", 7449
COLUMNS = (
    "phase", "to the site, kB/s", "from it", "limit", "scans", "p50, ms", "p99, ms", "way, m", "longest stand, s",
    "stops", "at the site", "their age, ms", "link's CPU, %", "PSS, MB",
)  # fmt: skip


@dataclass(slots=True)
class LinkPhase:
    """One state of the link. begin, end: ns of the wall clock.  sent, received: bytes at the interface.

    way: m.  stand: s, the longest without motion.  stops: statuses of the guard with a stop or a fault.  at_site: the
    observer's report.  cpu: share of a core that the link's process takes, pss_mb: its memory (PSS).
    """

    name: str
    begin: int = 0
    end: int = 0
    sent: int = 0
    received: int = 0
    way: float = 0.0
    stand: float = 0.0
    stops: int = 0
    at_site: dict[str, Any] = field(default_factory=dict)
    p50: float = float("nan")
    p99: float = float("nan")
    n_scans: int = 0
    cpu: float = 0.0
    pss_mb: float = 0.0

    @property
    def seconds(self) -> float:
        return (self.end - self.begin) * 1e-9


class MotionRecord:
    """What the simulator's truth and the guard say of the robot, for a phase at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._before: Truth | None = None
        self._moved_at = 0
        self.way = self.stand = 0.0
        self.stops = 0

    def truth(self, truth: Truth) -> None:
        """Takes a pose of the simulator."""
        with self._lock:
            before, self._before = self._before, truth
            if before is None or truth.stamp <= before.stamp:
                return
            a, b = before.world_from_base, truth.world_from_base
            step, turn = float(np.hypot(b.x - a.x, b.y - a.y)), abs(float(np.sin(b.yaw - a.yaw)))
            seconds = (truth.stamp - before.stamp) * 1e-9
            self.way += step
            if step > STANDS_BELOW * seconds or turn > STANDS_BELOW * seconds:
                self._moved_at = truth.stamp
            self.stand = max(self.stand, (truth.stamp - self._moved_at) * 1e-9)

    def guard(self, status: GuardStatus) -> None:
        """Takes a status of the guard."""
        self.stops += status.state in (GuardState.STOPPED, GuardState.FAULT)

    def restart(self) -> None:
        """Counts from 0 again."""
        with self._lock:
            self.way = self.stand = 0.0
            self.stops = 0
            self._moved_at = self._before.stamp if self._before is not None else 0

    def into(self, phase: LinkPhase) -> None:
        """Writes what was counted into a phase."""
        with self._lock:
            phase.way, phase.stand, phase.stops = self.way, self.stand, self.stops


def site(robot: str, seconds: float, cut: float, out: Path | None) -> int:
    """Runs all phases of `seconds`, the cut of `cut` s; 0 when the limits are kept and the robot drove on."""
    check_writable(out)
    folder = new_run_folder("site")
    recording = folder / "run.mcap"
    with stop_on_signal() as stop, lossy_link() as link:
        run = SiteRun(robot, link, folder, recording, stop)
        report = run.measure(seconds, cut)
    add_latency(run.phases, latency_chain(recording))
    report |= {"phases": [asdict(phase) | {"seconds": phase.seconds} for phase in run.phases]}
    report |= {"faults": faults(run.phases, report), "recording": str(recording)}
    show(run.phases, report)
    write_report(out, report)
    return 1 if report["faults"] else 0


class SiteRun:
    """A stack with a link to a site in a namespace."""

    def __init__(self, robot: str, link: LossyLink, folder: Path, recording: Path, stop: StopFlag) -> None:
        self._stop = stop
        self.robot, self.link, self.folder, self.recording = robot, link, folder, recording
        self.name = load_robot(robot).robot.name
        self.phases: list[LinkPhase] = []
        self.motion = MotionRecord()
        self.healths: dict[str, Health] = {}

    def measure(self, seconds: float, cut: float) -> dict[str, Any]:
        """Goes through the phases. Returns what the orders of the site did."""
        orders: dict[str, Any] = {}
        with ExitStack() as stack:
            place = SecureFolder(self.folder / "secure")
            credentials = self.folder / "robot.pem"
            with redirect_stdout(sys.stderr):
                init_folder("site@x80sv", str(place.path), [])
                add_member(self.name, MemberRole.ROBOT, str(place.path), credentials, 1)
            order = {"local": ROUTER, "listen": f"tls/{self.link.site}:{PORT}", "folder": str(place.path)}
            router = RouterProcess(order, lambda line: None, self.link.inside())
            stack.callback(router.end)
            client = stack.enter_context(self._stack(credentials))
            observer = stack.enter_context(self._observer())
            self._phase("rest", seconds, observer)
            self._drive(client)
            self._phase("drives", seconds, observer)
            self.link.set(0.0, LOST)
            self._phase("drives, link cut", cut, observer)
            orders["goal on the cut link"] = _ask(observer, "goal")
            before = client.latest(topics.NAV_STATUS)
            self.link.set(SLOW_DELAY_S, SLOW_LOSS)
            self._phase("drives, link slow", seconds, observer)
            after = client.latest(topics.NAV_STATUS)
            orders["same task after it"] = before is not None and after is not None and before.task_id == after.task_id
            self.link.set(0.0, 0.0)
            self._phase("drives, link back", seconds, observer)
            _ask(observer, "watch")
            self._phase("drives, watched", seconds, observer)
            _ask(observer, "unwatch")
            orders["stop"], orders["release"] = _ask(observer, "stop"), _ask(observer, "release")
            client.ask(requests.CANCEL, Cancel(client.now()))
        return {"orders": orders, "load": list(np.round(_load(), 1))}

    @contextmanager
    def _stack(self, credentials: Path) -> Iterator[Client]:
        device = f"uplink.port.device=tls://{self.link.site}:{PORT}"
        settings = ["sim.world=room", f"recorder.file={self.recording}", device, f"uplink.credentials={credentials}"]
        with free_stack() as claim:
            stack = str(claim.where.domain)
            commands = {
                name: service_command(name, self.robot, stack, settings, memory=self.folder / "memory")
                for name in (*SERVICES, "uplink")
            }
            with Launcher(commands, self.folder) as launcher, Client(self.name, claim.where) as client:
                client.listen(topics.HEALTH, lambda health, _: self._hear(launcher, health))
                client.listen(topics.TRUTH, lambda truth, _: self.motion.truth(truth))
                client.listen(topics.GUARD, lambda status, _: self.motion.guard(status))
                client.follow(topics.NAV_STATUS, topics.POSE)
                launcher.start_all(lambda name: name in self.healths)
                limit = time.monotonic() + START_S
                while not (self._is_linked and client.latest(topics.POSE) and client.latest(topics.NAV_STATUS)):
                    if time.monotonic() > limit:
                        raise UserError("the stack did not start, or has no link", f"see the logs in {self.folder}")
                    launcher.step()
                    launcher.pause(0.1)
                yield client

    @property
    def _is_linked(self) -> bool:
        health = self.healths.get("uplink")
        return health is not None and health.state.startswith("linked")

    def _hear(self, launcher: Launcher, health: Health) -> None:
        launcher.hear(health)
        self.healths[health.name] = health

    @contextmanager
    def _observer(self) -> Iterator["subprocess.Popen[str]"]:
        command = self.link.inside(sys.executable, "-m", "zenav.bench.site_observer", ROUTER, self.name)
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as observer:
            try:
                assert observer.stdout is not None
                if observer.stdout.readline() != "ready\n":
                    raise UserError("the tool at the site did not begin", "see its error above")
                yield observer
            finally:
                observer.kill()

    def _drive(self, client: Client) -> None:
        """Begins the route, which has no end, and waits for the first motion."""
        limit = time.monotonic() + START_S
        while not client.ask(requests.NAVIGATE, Navigate(client.now(), ROUTE, 0.0, 0, True)).accepted:
            if time.monotonic() > limit:
                raise UserError("the robot takes no route", f"see the logs in {self.folder}")
            self._wait(0.5)
        self.motion.restart()
        while self.motion.way < 0.1 and time.monotonic() < limit:
            self._wait(0.1)

    def _wait(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise KeyboardInterrupt

    def _phase(self, name: str, seconds: float, observer: "subprocess.Popen[str]") -> None:
        _ask(observer, "report")
        self.motion.restart()
        process = psutil.Process(self.healths["uplink"].pid)
        used = sum(process.cpu_times()[:2])
        phase, (sent, received) = LinkPhase(name, time.time_ns()), self.link.n_bytes
        self._wait(seconds)
        phase.sent, phase.received = (now - then for now, then in zip(self.link.n_bytes, (sent, received)))
        phase.end = time.time_ns()
        phase.cpu = (sum(process.cpu_times()[:2]) - used) / phase.seconds
        phase.pss_mb = process.memory_full_info().pss / 1e6
        self.motion.into(phase)
        phase.at_site = _ask(observer, "report")
        self.phases.append(phase)


def add_latency(phases: list[LinkPhase], chain: LatencyChain) -> None:
    """Writes the time from scan to `cmd/vel`, without the wait for the tick, into each phase."""
    for phase in phases:
        latency = chain.latency[(chain.sent >= phase.begin) & (chain.sent < phase.end)] * 1e3
        if len(latency):
            phase.p50, phase.p99 = (float(value) for value in np.percentile(latency, (50, 99)))
            phase.n_scans = len(latency)


def faults(phases: list[LinkPhase], report: dict[str, Any]) -> list[str]:
    """What does not hold, in words."""
    found, by_name = [], {phase.name: phase for phase in phases}
    for name, limit in LIMITS_KB_S.items():
        rate = _kb_s(by_name[name])
        if rate >= limit:
            found.append(f"{name}: {rate:.1f} kB/s, where {limit:g} are the limit")
    clear = by_name["drives"]
    for phase in phases:
        if not phase.name.startswith("drives"):
            continue
        if phase.stops:
            found.append(f"{phase.name}: the guard stopped the robot")
        if phase.way / phase.seconds < 0.5 * clear.way / clear.seconds:
            found.append(f"{phase.name}: the robot drove less than half as far as on a clear link")
        if phase.p50 > MAX_RATIO * clear.p50:
            found.append(f"{phase.name}: cmd/vel is {phase.p50 / clear.p50:.2f} times as late")
    orders = report["orders"]
    if "error" not in orders["goal on the cut link"] or not orders["same task after it"]:
        found.append("a goal of the cut link reached the robot")
    failed = [word for word in ("stop", "release") if "error" in orders[word]]
    found += [f"{word} is not confirmed: {orders[word]['error']}" for word in failed]
    return found


def show(phases: list[LinkPhase], report: dict[str, Any]) -> None:
    """The figures as a table."""
    rows = [
        (
            phase.name,
            f"{phase.sent / phase.seconds / 1e3:.2f}",
            f"{phase.received / phase.seconds / 1e3:.2f}",
            f"{LIMITS_KB_S[phase.name]:g}" if phase.name in LIMITS_KB_S else "",
            str(phase.n_scans),
            f"{phase.p50:.1f}",
            f"{phase.p99:.1f}",
            f"{phase.way:.1f}",
            f"{phase.stand:.1f}",
            str(phase.stops),
            str(sum(phase.at_site.get("messages", {}).values())),
            "" if phase.at_site.get("delay") is None else f"{phase.at_site['delay'] * 1e3:.0f}",
            f"{phase.cpu * 100:.1f}",
            f"{phase.pss_mb:.0f}",
        )
        for phase in phases
    ]
    slow = f"{SLOW_DELAY_S * 1e3:g} ms and {SLOW_LOSS:.0%} loss each way"
    show_table(f"a robot's link to a site; slow is {slow}; load {report['load'][0]:g}", COLUMNS, rows)
    orders = report["orders"]
    sys.stdout.write(f"STOP of the site: {orders['stop']}, its release: {orders['release']}\n")
    sys.stdout.write(f"goal on the cut link: {orders['goal on the cut link']}\n")
    for fault in report["faults"]:
        sys.stderr.write(f"{fault}\n")


def _kb_s(phase: LinkPhase) -> float:
    return (phase.sent + phase.received) / phase.seconds / 1e3


def _ask(observer: "subprocess.Popen[str]", word: str) -> dict[str, Any]:
    assert observer.stdin is not None
    assert observer.stdout is not None
    observer.stdin.write(f"{word}\n")
    observer.stdin.flush()
    return dict(json.loads(observer.stdout.readline()))


def _load() -> tuple[float, float, float]:
    return os.getloadavg()
