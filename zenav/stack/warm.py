# SPDX-License-Identifier: Apache-2.0
"""Compiles kernels into numba's cache, so that none compiles while the robot drives.

`zenav up` and `zenav demo` call `warm_first`. `zenav warm` does it ahead. `python -m zenav.stack.warm` warms all that
the built-in robots drive by, which is what tests and the image need. With a path it writes these kernels into that
archive, for a wheel.
"""

import shared.repeatable  # noqa: F401  # before numpy; numba compiles for the machine that it names

# isort: split
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from shared.config import RobotFile, UserError, configured
from shared.kernel_cache import ROOT
from shared.robot_files import ROBOTS_DIR
from shared.topics import SERVICES
from zenav.stack.kernel_stamp import (
    cache_lock,
    cache_root,
    clear_stale,
    code_digest,
    read_stamp,
    warm_key,
    write_stamp,
)
from zenav.stack.prebuilt_kernels import collect, copy_prebuilt
from zenav.stack.service_loader import service_class

ROBOTS: tuple[tuple[str, list[str]], ...] = (
    ("x80sv", []),
    ("jackal", []),
    ("x80sv", ["robot.drive.min_turning_radius=0.5", "robot.drive.turns_in_place=false"]),
    *(("x80sv", [f"local_ctrl.controller={name}"]) for name in ("dwa", "pursuit")),
)
"""Name and settings: what they drive by has kernels of its own."""

WITH_KERNELS = "mapper", "planner", "local_ctrl", "sim", "navigator", "base_driver"
"""Services with kernels, those that compile longest first: two workers then end at about the same time."""
MAX_WORKERS = 2  # the mapper alone takes 40 % of the time: a third worker gains nothing, and each needs 250 MB


@dataclass(frozen=True, slots=True)
class Task:
    """One service to be warmed with one configuration. key: of the stamp."""

    service: str
    robot: str
    settings: tuple[str, ...]
    key: str


@dataclass(slots=True)
class Times:
    """What compiling took. kernels: s of CPU by name; services: s by name, of the clock on the wall."""

    kernels: Counter[str] = field(default_factory=Counter)
    services: Counter[str] = field(default_factory=Counter)
    wall: float = 0.0


def main(arguments: Sequence[str]) -> None:
    """Warms every service, and says how long each took. arguments: an archive for all robots' kernels, or none."""
    robots = (*ROBOTS, *built_in_robots()) if arguments else ROBOTS
    tasks = [task for robot, settings in robots for task in tasks_for(robot, settings, SERVICES)]
    times = warm(tasks)
    for name, seconds in times.services.items():
        sys.stdout.write(f"{name:<16}{seconds:6.1f} s\n")
    sys.stdout.write(f"{len(times.kernels)} kernels compiled in {times.wall:.1f} s\n")
    for archive in arguments:
        n = collect({task.key for task in tasks}, Path(archive))
        sys.stdout.write(f"{n} kernels in {archive}\n" if n else "kernels compiled here serve no other processor\n")


def built_in_robots() -> list[tuple[str, list[str]]]:
    """Name and settings of each robot: as its file says, and with a board on a port where the drive can have one."""
    from services.base_driver.boards.models import MODELS_WITH_ODOMETRY
    from services.base_driver.config import BaseDriverConfig

    found: list[tuple[str, list[str]]] = []
    for name in sorted(path.stem for path in ROBOTS_DIR.glob("*.yaml")):
        file = configured(name, [])
        found.append((name, []))
        if (
            file.robot.drive.kind != "velocity"
            or file.section("base_driver", BaseDriverConfig).board.model in MODELS_WITH_ODOMETRY
        ):
            found.append((name, ["base_driver.port.device=/dev/ttyUSB0"]))
    return found


def report(robot: str, settings: list[str], every: bool, again: bool, times_too: bool) -> None:
    """`zenav warm`: compiles, and says what that took. every: for all that the built-in robots drive by."""
    chosen = ROBOTS if every else ((robot, settings),)
    times = warm([task for name, extra in chosen for task in tasks_for(name, extra, SERVICES)], again)
    if not times.services:
        sys.stdout.write(f"every kernel is compiled already, in {cache_root()}; --again compiles them again\n")
        return
    if times_too:
        for name, seconds in times.kernels.most_common():
            sys.stdout.write(f"{seconds:7.2f} s  {name}\n")
    cpu = sum(times.kernels.values())
    sys.stdout.write(f"{len(times.kernels)} kernels compiled in {times.wall:.1f} s, {cpu:.1f} s of CPU\n")


def warm_first(robot: str, settings: list[str], services: Iterable[str]) -> None:
    """Compiles what these services need with this robot and is not in the cache yet, with a progress bar.

    Raises UserError where the robot or its settings are wrong, or the cache cannot be written.
    """
    warm(tasks_for(robot, settings, services))


def tasks_for(robot: str, settings: list[str], services: Iterable[str]) -> list[Task]:
    """The tasks for the services that have kernels. Raises UserError where the configuration is wrong."""
    file, wanted = configured(robot, settings), set(services)
    return [
        Task(name, robot, tuple(settings), warm_key(name, file, _section(name, file)))
        for name in WITH_KERNELS
        if name in wanted
    ]


def warm(tasks: list[Task], again: bool = False) -> Times:
    """Compiles in processes beside this one what the stamp does not name. again: removes all in the cache first."""
    cache, code, times = cache_root(), code_digest(), Times()
    if not again and {task.key for task in tasks} <= read_stamp(cache, code):
        return times
    with cache_lock(cache):
        clear_stale(cache, code, again)
        warmed = read_stamp(cache, code)  # another process may have compiled while this one waited
        if not warmed and not again and (warmed := copy_prebuilt(cache)):
            write_stamp(cache, code, warmed)
        due = list({task.key: task for task in tasks if task.key not in warmed}.values())
        if due:
            begun = time.monotonic()
            with _display(due, cache) as show:
                _work(due, times, show)
            times.wall = time.monotonic() - begun
            write_stamp(cache, code, warmed | {task.key for task in due})
    return times


def _work(due: list[Task], times: Times, show: Callable[[Times], None]) -> None:
    """Gives the tasks to the workers, all of a service to one, and collects their lines.

    Raises UserError where a service refuses its configuration.
    """
    pending: queue.SimpleQueue[list[Task]] = queue.SimpleQueue()
    for service in WITH_KERNELS:
        if group := [task for task in due if task.service == service]:
            pending.put(group)
    said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    workers = [_start() for _ in range(min(len(os.sched_getaffinity(0)), MAX_WORKERS, pending.qsize()))]
    threads = [threading.Thread(target=_feed, args=(worker, pending, said), daemon=True) for worker in workers]
    n_open = len(workers)
    try:
        for thread in threads:
            thread.start()
        while n_open:
            line = said.get()
            if "kernel" in line:
                times.kernels[line["kernel"]] += line["seconds"]
            elif "done" in line:
                times.services[line["done"]] += line["wall"]
            elif "refused" in line:
                raise UserError(line["refused"], line["hint"])
            elif line.get("failed"):
                raise RuntimeError(f"the kernels of {line['failed']} cannot be compiled; the traceback is above")
            else:
                n_open -= 1
            show(times)
    finally:
        for worker in workers:
            worker.kill()
        for worker, thread in zip(workers, threads):
            thread.join()  # its worker's end is the end of what it reads
            with worker:
                pass


def _start() -> "subprocess.Popen[str]":
    environment = dict(os.environ)  # noqa: TID251  # a child's environment is made here
    environment["PYTHONPATH"] = os.pathsep.join(p for p in (str(ROOT), environment.get("PYTHONPATH", "")) if p)
    command = [sys.executable, "-P", "-m", "zenav.stack.warm_worker", str(os.getpid())]
    pipe = subprocess.PIPE  # a session of its own: Ctrl-C is this process's matter
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment, start_new_session=True)


def _feed(
    worker: "subprocess.Popen[str]",
    pending: "queue.SimpleQueue[list[Task]]",
    said: "queue.SimpleQueue[dict[str, Any]]",
) -> None:
    """Gives one worker group after group of tasks, and passes on its lines; at the end, an empty one."""
    assert worker.stdin is not None
    assert worker.stdout is not None
    while True:
        try:
            group = pending.get_nowait()
        except queue.Empty:
            break
        for task in group:
            line: dict[str, Any] = {}
            try:
                worker.stdin.write(json.dumps(asdict(task)) + "\n")
                worker.stdin.flush()
                for text in worker.stdout:
                    said.put(line := json.loads(text))
                    if "done" in line or "refused" in line:
                        break
            except OSError:  # it has died
                line = {}
            if "refused" in line:
                return
            if "done" not in line:
                said.put({"failed": task.service})
                return
    said.put({})


@contextmanager
def _display(due: list[Task], cache: Path) -> Iterator[Callable[[Times], None]]:
    """From the first kernel on, a line that says what is done and why, and on a terminal a progress bar; on stderr."""
    from zenav.console.progress import progress_bar

    total = n_kernels({task.service for task in due})
    place = "beside the code" if cache == ROOT else f"in {cache}"
    with ExitStack() as stack:
        bar: list[Callable[[float], None]] = []

        def show(times: Times) -> None:
            if times.kernels and not bar:
                sys.stderr.write(f"compiling kernels for this machine, once: they are kept {place}\n")
                sys.stderr.flush()
                bar.append(stack.enter_context(progress_bar("compiling")))
            if bar:
                bar[0](min(len(times.kernels) / total, 1.0))

        yield show


def n_kernels(services: set[str], root: Path = ROOT) -> int:
    """How many kernels the sources of these services and of `shared` hold; a configuration uses most of them."""
    folders = [root / "shared", *(root / "services" / name for name in services)]
    return sum(path.read_bytes().count(b"\n@njit") for folder in folders for path in folder.rglob("*.py")) or 1


def _section(name: str, file: RobotFile) -> dict[str, Any]:
    """A service's section as plain values, with what its kernels cannot depend on left out."""
    section = file.section(name, service_class(name).config_type).model_dump(mode="json")
    if name == "sim":
        section.pop("seed", None)
    if name == "base_driver":
        section["port"] = bool(section["port"]["device"])
    return section


if __name__ == "__main__":
    main(sys.argv[1:])
