# SPDX-License-Identifier: Apache-2.0
"""`zenav bench footprint`: memory and CPU of each process of a live stack, its restarts, and how soon it starts."""

import os
import resource
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from shared import requests, topics
from shared.config import UserError
from shared.messages import Health, Truth
from shared.requests import Explore, Navigate, Reply
from shared.runners.transport import StackAddress
from shared.task_state import FINAL_STATES
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.evaluation import MOVING
from zenav.scenario.scenario import Scenario, load_scenario
from zenav.stack.launch import free_stack

MAX_PSS_MB = 350.0  # whole stack without simulator, on a mapped office
MAX_CPU = 0.45  # share of a core, without simulator and recorder
MAX_RESTART_S = 0.5  # killed to the first message
MAX_FIRST_MOTION_S = 4.0  # from the command `zenav up`, kernels warm
MAX_COMMAND_S = 0.25  # `zenav --help` and `zenav topic list`
START_LIMIT_S = 120.0  # until the robot moves: a first start may compile kernels
RESTART_LIMIT_S = 30.0
BETWEEN_KILLS_S = 4.0
ASK_EVERY_S = 0.05
COMMANDS = ("--help", "topic list")
COMMAND_RUNS = 7
LAUNCHER, PRELOADED = "zenav up", "preloaded parent"
NOT_ON_THE_ROBOT = ("sim",)  # of memory
NOT_COUNTED = ("sim", "recorder")  # of CPU


@dataclass(slots=True)
class Usage:
    """One process: memory now, and the CPU that it used between two looks.

    pss: MB, each page divided by the number of processes that have it.  uss: MB, its own pages.  rss: MB.
    cpu: share of a core, all threads, user and system.
    """

    pss: float
    uss: float
    rss: float
    cpu: float = 0.0


@dataclass
class MeasuredStack:
    """A `zenav up` that runs, and a client on it. `pids`: by service, from its newest health message."""

    process: "subprocess.Popen[bytes]"
    client: Client
    begun: float  # s, monotonic, when the command was given
    pids: dict[str, int] = field(default_factory=dict)
    first_health_s: dict[tuple[str, int], float] = field(default_factory=dict)  # by service and pid; monotonic
    moved: float = 0.0  # s, monotonic: first motion

    def hear(self, health: Health) -> None:
        self.pids[health.name] = health.pid
        self.first_health_s.setdefault((health.name, health.pid), time.monotonic())

    def see(self, truth: Truth) -> None:
        if not self.moved and abs(truth.v) + 0.1 * abs(truth.w) > MOVING:
            self.moved = time.monotonic()

    def is_replaced(self, name: str, pid: int) -> bool:
        """Whether a process other than `pid` has sent this service's health."""
        return self.pids[name] != pid

    def until(self, holds: Callable[[], object], seconds: float, what: str) -> None:
        """Waits for the condition. Raises UserError with `what` when it does not come true."""
        limit = time.monotonic() + seconds
        while not holds():
            if self.process.poll() is not None or time.monotonic() > limit:
                raise UserError(f"the stack did not run as it should: {what}", "see the logs in out/")
            time.sleep(0.005)  # noqa: TID251  # what is measured is some hundredths of a second

    def moves_by(self, request: requests.Request[Any, Reply], message: Callable[[], Any]) -> None:
        """Asks for a task until the robot moves; again where it ended at once, as before the first board report."""
        task, limit = -1, time.monotonic() + START_LIMIT_S
        while not self.moved:
            if self.process.poll() is not None or time.monotonic() > limit:
                raise UserError(f"the robot did not move after {request.key}", "see the logs in out/")
            nav = self.client.latest(topics.NAV_STATUS)
            if task < 0 or (nav is not None and nav.task_id == task and nav.state in FINAL_STATES):
                with suppress(UserError):
                    reply = self.client.ask(request, message(), timeout=1.0)
                    task = reply.task_id if reply.accepted else -1
            time.sleep(ASK_EVERY_S)  # noqa: TID251  # as a user does

    def processes(self) -> dict[str, psutil.Process]:
        """By name: the services, the launcher, and what else it started."""
        launcher = psutil.Process(self.process.pid)
        names = {pid: name for name, pid in self.pids.items()}
        by_name = {LAUNCHER: launcher}
        for child in launcher.children(recursive=True):
            by_name[names.get(child.pid, PRELOADED)] = child
        return by_name


def footprint(
    robot: str, world: str, seconds: float, saved_map: Path | None, rounds: int, out: Path | None, settings: list[str]
) -> int:
    """Runs the stack, shows and writes its figures; 0 when each is within its limit."""
    check_writable(out)
    folder = new_run_folder("footprint")
    chosen = load_scenario(robot, world, 0, settings)
    with stop_on_signal():
        place = (saved_map or mapped(chosen, folder / "map")).resolve()
        commands = {command: command_times(command) for command in COMMANDS}
        with running(chosen, folder) as stack:
            motion = first_motion(stack)
        with running(chosen, folder, "--map", str(place), "--mode", "continue", "--at", "0", "0", "0") as stack:
            drive_around(stack, chosen)
            usage = measured(stack, seconds)
            restarts = restart_times(stack, rounds)
    report = figures(usage, restarts, motion, commands)
    report |= {"load": os.getloadavg()[0], "map": str(place), "settings": settings}
    show(report)
    write_report(out, report)
    return 0 if all(row["within"] for row in report["limits"]) else 1


def mapped(chosen: Scenario, folder: Path) -> Path:
    """A map of the world, made by a drive to all its goals in lockstep; the folder."""
    from zenav.bench.sim_slam_harness import SimSlamHarness
    from zenav.maps.saved_map import write_saved_map

    sys.stderr.write(f"zenav: maps {chosen.world.name} first, into {folder}; give it with --map next time\n")
    rig = SimSlamHarness(chosen.file)
    for goal in (*chosen.world.goals.values(), chosen.world.start):
        rig.drive(goal)
    rig.stand(4.0)
    write_saved_map(folder, rig.mapper.slam.snapshot())
    return folder


@contextmanager
def running(chosen: Scenario, folder: Path, *options: str) -> Iterator[MeasuredStack]:
    """`zenav up` in a process of its own, as a user starts it. It is ended with the block."""
    with free_stack() as claim:
        where = claim.where
    command = [sys.executable, "-P", "-m", "zenav", "up", "--robot", chosen.robot, "--world", chosen.world.name]
    command += ["--stack", str(where.domain), *options]
    for setting in chosen.settings:
        command += ["--set", setting]
    with Client(chosen.file.robot.name, StackAddress(where.domain)) as client, (folder / "up.log").open("ab") as log:
        begun = time.monotonic()
        process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        stack = MeasuredStack(process, client, begun)
        client.follow(topics.NAV_STATUS)
        client.listen(topics.HEALTH, lambda health, _: stack.hear(health))
        client.listen(topics.TRUTH, lambda truth, _: stack.see(truth))
        try:
            yield stack
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def first_motion(stack: MeasuredStack) -> float:
    """s from the command to the first motion, when a user asks for exploring as soon as that is accepted."""
    stack.moves_by(requests.EXPLORE, lambda: Explore(stack.client.now()))
    return stack.moved - stack.begun


def drive_around(stack: MeasuredStack, chosen: Scenario) -> None:
    """Lets the robot drive from goal to goal for ever, and waits until it moves."""
    poses = tuple(pose for _, pose in chosen.goals)
    stack.moves_by(requests.NAVIGATE, lambda: Navigate(stack.client.now(), poses, 0.0, 0, True))


def measured(stack: MeasuredStack, seconds: float) -> dict[str, Usage]:
    """Memory and CPU by process, over `seconds` of driving."""
    time.sleep(5.0)  # noqa: TID251  # what starting left to do is done
    before = {name: (process, _cpu_s(process)) for name, process in stack.processes().items()}
    begun = time.monotonic()
    time.sleep(seconds)  # noqa: TID251  # the stack drives
    usage = {}
    for name, (process, spent) in before.items():
        share = (_cpu_s(process) - spent) / (time.monotonic() - begun)
        usage[name] = memory(process.pid)
        usage[name].cpu = share
    return usage


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def memory(pid: int) -> Usage:
    """A process's memory, from the kernel's own sums of its pages."""
    rows = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kb = {key.rstrip(":"): int(value) for key, value in (row.split()[:2] for row in rows)}
    return Usage(kb["Pss"] / 1e3, (kb["Private_Clean"] + kb["Private_Dirty"]) / 1e3, kb["Rss"] / 1e3)


def restart_times(stack: MeasuredStack, rounds: int) -> dict[str, list[float]]:
    """s from the SIGKILL of each service to the first message of its next process."""
    times: dict[str, list[float]] = {}
    for _ in range(rounds):
        begun = time.monotonic()
        for name in [name for name in stack.pids if name not in NOT_ON_THE_ROBOT]:
            pid, killed = stack.pids[name], time.monotonic()
            os.kill(pid, signal.SIGKILL)
            stack.until(partial(stack.is_replaced, name, pid), RESTART_LIMIT_S, f"{name} stays away")
            times.setdefault(name, []).append(stack.first_health_s[name, stack.pids[name]] - killed)
            time.sleep(BETWEEN_KILLS_S)  # noqa: TID251  # each is killed while the others are well
        time.sleep(max(0.0, 31.0 - (time.monotonic() - begun)))  # noqa: TID251  # the next death counts as the first
    return times


def command_times(command: str) -> tuple[float, float]:
    """Medians of the wall's time and of CPU, s, of a command of this program."""
    wall, cpu = [], []
    for _ in range(COMMAND_RUNS):
        begun, spent = time.monotonic(), _children_s()
        subprocess.run([sys.executable, "-P", "-m", "zenav", *command.split()], capture_output=True, check=True)
        wall.append(time.monotonic() - begun)
        cpu.append(_children_s() - spent)
    return statistics.median(wall), statistics.median(cpu)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def figures(
    usage: dict[str, Usage],
    restarts: dict[str, list[float]],
    motion: float,
    commands: dict[str, tuple[float, float]],
) -> dict[str, Any]:
    """All figures; `limits` has each that is promised beside its bound."""
    pss = sum(row.pss for name, row in usage.items() if name not in NOT_ON_THE_ROBOT)
    cpu = sum(row.cpu for name, row in usage.items() if name not in NOT_COUNTED)
    slowest = max(statistics.median(times) for times in restarts.values()) if restarts else 0.0
    wanted = [
        ("PSS of the stack without simulator, MB", pss, MAX_PSS_MB),
        ("CPU without simulator and recorder, share of a core", cpu, MAX_CPU),
        ("restart of the slowest service, median, s", slowest, MAX_RESTART_S),
        ("`zenav up` to the first motion, s", motion, MAX_FIRST_MOTION_S),
        *((f"`zenav {command}`, median, s", wall, MAX_COMMAND_S) for command, (wall, _) in commands.items()),
    ]
    return {
        "summary": {
            "pss_mb": round(pss, 1),
            "cpu": round(cpu, 3),
            "restart_s_slowest_median": round(slowest, 3),
            "first_motion_s": round(motion, 2),
            **{f"{command.strip('-').replace(' ', '_')}_s": round(wall, 3) for command, (wall, _) in commands.items()},
        },
        "limits": [
            {"what": what, "found": round(value, 3), "limit": limit, "within": value <= limit}
            for what, value, limit in wanted
        ],
        "processes": {
            name: {
                "pss_mb": round(row.pss, 1),
                "uss_mb": round(row.uss, 1),
                "rss_mb": round(row.rss, 1),
                "cpu": round(row.cpu, 3),
                "restart_s": [round(value, 3) for value in restarts.get(name, [])],
            }
            for name, row in usage.items()
        },
        "commands": {command: {"wall_s": round(w, 3), "cpu_s": round(c, 3)} for command, (w, c) in commands.items()},
    }


def show(report: dict[str, Any]) -> None:
    """The figures as tables."""
    rows = [
        (
            name, f"{row['pss_mb']:.0f}", f"{row['uss_mb']:.0f}", f"{row['rss_mb']:.0f}", f"{row['cpu'] * 100:.1f}",
            f"{statistics.median(row['restart_s']):.2f}" if row["restart_s"] else "-",
        )
        for name, row in report["processes"].items()
    ]  # fmt: skip
    show_table("processes", ("", "PSS, MB", "USS, MB", "RSS, MB", "CPU, % of a core", "restart, s"), rows)
    limits = [
        (row["what"], f"{row['found']:g}", f"{row['limit']:g}", "" if row["within"] else "too much")
        for row in report["limits"]
    ]
    show_table(f"limits (load average {report['load']:.1f})", ("", "found", "limit", ""), limits)
    cpu = ", ".join(f"{command} {row['cpu_s']:.2f}" for command, row in report["commands"].items())
    sys.stdout.write(f"CPU of the commands, s: {cpu}\n")
