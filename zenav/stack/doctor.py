# SPDX-License-Identifier: Apache-2.0
"""`zenav doctor`: what this machine offers the stack, what is wrong with it, and how to fix that."""

import os
import platform
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from shared.config import UserError
from shared.extensions import service_module
from shared.kernel_cache import ROOT
from shared.runners import transport
from shared.runners.transport import StackAddress, stack_address
from shared.secure_folder import RENEWAL_DAYS, secure_folder
from shared.topics import SERVICES

OK, WARNING, BAD = "ok", "warning", "bad"
ROUND_TRIPS = 50
INSTALL = "make venv" if (ROOT / "pyproject.toml").is_file() else "pip install --upgrade zenav"


@dataclass(frozen=True, slots=True)
class DoctorFinding:
    """One row: the subject, `ok`, `warning` or `bad`, the finding, and a hint."""

    name: str
    verdict: str
    found: str
    hint: str = ""


def doctor(robot: str, stack: str) -> int:
    """Shows every finding; 1 when one is bad."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    where = stack_address(stack)
    colours = {OK: "green", WARNING: "yellow", BAD: "bold red"}
    table = Table(box=None, pad_edge=False)
    for column in ("", "", "found", "how to fix it"):
        table.add_column(column, overflow="fold")
    worst = OK
    for finding in findings(where, robot):
        verdict = Text(finding.verdict, style=colours[finding.verdict])
        table.add_row(finding.name, verdict, finding.found, finding.hint)
        worst = BAD if BAD in (worst, finding.verdict) else finding.verdict if worst == OK else worst
    console = Console(markup=False, emoji=False)  # a path with [ ] stays what it is
    if not console.is_terminal:
        console.width = 160  # a log's lines do not wrap
    console.print(table)
    return 1 if worst == BAD else 0


def findings(where: StackAddress, robot: str) -> Iterator[DoctorFinding]:
    """Looks at everything, one after the other; a check that fails is itself a finding."""
    checks: tuple[Callable[[], Iterator[DoctorFinding]], ...] = (
        python, packages, kernels, processor, realtime, clock, lambda: ports(where), lambda: loopback(where), serial,
        lambda: robot_ports(robot), disk, data, certificates,
    )  # fmt: skip
    for check in checks:
        try:
            yield from check()
        except Exception as error:  # the doctor must not die of the illness
            yield DoctorFinding(getattr(check, "__name__", "check"), WARNING, f"cannot be looked at: {error}")


def python() -> Iterator[DoctorFinding]:
    good = (3, 11) <= sys.version_info < (3, 14)
    found = f"{platform.python_version()} at {sys.executable}"
    yield DoctorFinding(
        "Python", OK if good else BAD, found, "" if good else f"install Python 3.11, 3.12 or 3.13; then: {INSTALL}"
    )


def packages() -> Iterator[DoctorFinding]:
    try:
        wanted = [line for line in requires("zenav") or [] if "extra ==" not in line]
    except PackageNotFoundError:
        yield DoctorFinding("packages", WARNING, "zenav is not installed here, it runs from its folder", INSTALL)
        return
    missing = []
    for line in wanted:
        name = next(part for part in line.replace("=", " ").replace(">", " ").replace("<", " ").split())
        try:
            version(name)
        except PackageNotFoundError:
            missing.append(name)
    found = f"missing: {', '.join(missing)}" if missing else f"all {len(wanted)} here; zenoh {version('eclipse-zenoh')}"
    yield DoctorFinding("packages", BAD if missing else OK, found, INSTALL if missing else "")


def kernels() -> Iterator[DoctorFinding]:
    from zenav.stack.kernel_stamp import cache_root, code_digest, read_stamp

    n = len(read_stamp(cache_root(), code_digest()))
    place = "beside the code" if cache_root() == ROOT else f"in {cache_root()}"
    if n:
        yield DoctorFinding("kernels", OK, f"compiled, {place}: {n} configurations of services")
    else:
        yield DoctorFinding(
            "kernels", WARNING, f"not compiled yet, to be kept {place}: a first start takes longer", "zenav warm"
        )


def processor() -> Iterator[DoctorFinding]:
    n, load = os.cpu_count() or 1, os.getloadavg()[0]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else n
    if usable < 2:
        yield DoctorFinding("CPU", WARNING, f"{usable} core", "the stack wants 2 cores")
    elif load > usable:
        yield DoctorFinding(
            "CPU", WARNING, f"{usable} cores, load {load:.1f}", "other programs take the cores: see top"
        )
    else:
        yield DoctorFinding("CPU", OK, f"{usable} cores, load {load:.1f}")


def realtime() -> Iterator[DoctorFinding]:
    try:
        before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(5))
        os.sched_setscheduler(0, before, parameter)
        yield DoctorFinding("real time", OK, "SCHED_RR is allowed: the velocity path does not wait for other load")
    except (OSError, AttributeError):
        hint = "echo '* - rtprio 10' | sudo tee /etc/security/limits.d/zenav.conf; then log in again"
        yield DoctorFinding("real time", WARNING, "SCHED_RR is not allowed: latency depends on other load", hint)


def clock() -> Iterator[DoctorFinding]:
    wall, steady = time.time_ns(), time.monotonic_ns()
    threading.Event().wait(0.3)
    drift = abs((time.time_ns() - wall) - (time.monotonic_ns() - steady)) / 1e6
    year = time.gmtime().tm_year
    if year < 2025:
        yield DoctorFinding("clock", BAD, f"it shows the year {year}", "set it: sudo timedatectl set-ntp true")
    elif drift > 5:
        yield DoctorFinding(
            "clock", WARNING, f"it jumped by {drift:.0f} ms in 0.3 s", "let it settle: timedatectl timesync-status"
        )
    else:
        yield DoctorFinding("clock", OK, f"{time.strftime('%Y-%m-%d %H:%M:%S %Z')}, steady")


def ports(where: StackAddress) -> Iterator[DoctorFinding]:
    from zenav.stack.launch import claim_holder, taken_ports

    if where.router:
        return
    held = taken_ports(where)
    low, high = where.port(SERVICES[0]), where.port(SERVICES[-1])
    if not held:
        yield DoctorFinding("ports", OK, f"{low} to {high} of stack {where.domain} are free")
    foreign = []
    for port in held:
        who, service = claim_holder(port), SERVICES[port - low]
        if service_module(service) not in who and "zenav run" not in who:
            foreign.append(
                DoctorFinding(
                    "ports", BAD, f"{port} ({service}) is taken by {who}", "end it, or use another: --stack 1"
                )
            )
    yield from foreign
    if held and not foreign:
        names = ", ".join(SERVICES[port - low] for port in held)
        yield DoctorFinding("ports", OK, f"stack {where.domain} runs: {names}")


def loopback(where: StackAddress) -> Iterator[DoctorFinding]:
    """A query there and back, between two sessions as a service and a tool have them."""
    import zenoh

    from zenav.stack.launch import free_stack

    if where.router:
        try:
            transport.opened(where).close()  # type: ignore[no-untyped-call]  # zenoh's own
            yield DoctorFinding("Zenoh", OK, f"the router at {where.router} answers")
        except UserError as error:
            yield DoctorFinding("Zenoh", BAD, error.what, error.hint)
        return
    with free_stack() as claim, transport.opened(claim.where, "sim") as a, transport.opened(claim.where) as b:

        def echo(query: zenoh.Query) -> None:
            with query:
                query.reply("doctor/echo", b"here")

        kept = a.declare_queryable("doctor/echo", echo)
        limit = time.monotonic() + 3.0
        while not any(reply.ok for reply in b.get("doctor/echo", timeout=1.0)):
            if time.monotonic() > limit:
                hint = "does a firewall or a container keep processes from 127.0.0.1?"
                yield DoctorFinding("Zenoh", BAD, "two sessions on loopback do not find each other in 3 s", hint)
                return
        times = []
        for _ in range(ROUND_TRIPS):
            begun = time.perf_counter()
            list(b.get("doctor/echo", timeout=1.0))
            times.append((time.perf_counter() - begun) * 1e3)
        del kept
    times.sort()
    slow = times[-2] > 20
    found = f"round trip on loopback {times[len(times) // 2]:.2f} ms, slow ones {times[-2]:.1f} ms"
    yield DoctorFinding(
        "Zenoh", WARNING if slow else OK, found, "the cores are busy: see CPU and real time" if slow else ""
    )


def serial() -> Iterator[DoctorFinding]:
    from serial.tools import list_ports

    from shared.runners.port import admission
    from zenav.stack.usb_boards import adapter_text

    listed = [p for p in list_ports.comports() if p.device.startswith(("/dev/ttyUSB", "/dev/ttyACM", "/dev/cu."))]
    found = [p.device for p in listed]
    if not found:
        yield DoctorFinding("serial", OK, "no board is plugged in (not needed in simulation)")
        return
    closed = [device for device in found if not os.access(device, os.R_OK | os.W_OK)]
    if closed:
        hints = ", or: ".join(sorted({admission(device) for device in closed}))
        yield DoctorFinding("serial", BAD, f"{', '.join(closed)}: no right to read and write", hints)
    else:
        yield DoctorFinding("serial", OK, ", ".join(adapter_text(port) for port in listed))


def robot_ports(robot: str) -> Iterator[DoctorFinding]:
    """The ports that a robot's file names: whether they are there, and may be opened. They are not opened.

    To open a serial port restarts some boards, so a running stack would lose its own.
    """
    from shared.config import Section, load_robot
    from shared.ports import PortConfig
    from shared.runners.port import access_error
    from zenav.stack.config_report import read_sections
    from zenav.stack.hardware import DRIVERS

    try:
        file = load_robot(robot)
        sections = read_sections(file)
        drivers = [driver for driver in DRIVERS.values() if driver in sections]
    except UserError as error:
        yield DoctorFinding("robot", BAD, error.what, error.hint)
        return
    devices: dict[tuple[str, ...], Section] = {(driver,): sections[driver] for driver in drivers}
    devices |= {
        (driver, "laser_2"): second for driver in drivers if (second := getattr(sections[driver], "laser_2", None))
    }
    ports: dict[tuple[str, ...], PortConfig] = {
        place: getattr(device, "port", PortConfig()) for place, device in devices.items()
    }
    for place, port in ports.items():
        if not port.given:
            continue
        name = ".".join((*place, "port"))
        if trouble := access_error(port):
            yield DoctorFinding("robot", BAD, f"{name}: {trouble}", f"{file.place((*place, 'port'))} names it")
        else:
            yield DoctorFinding("robot", OK, f"{name}: {port.name}" + " (not tried)" * bool(port.kind))
    if not any(port.given for port in ports.values()):
        yield DoctorFinding("robot", OK, f"{file.path.name} names no ports (not needed in simulation)")


def disk() -> Iterator[DoctorFinding]:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    if not os.access(Path.cwd(), os.W_OK):
        yield DoctorFinding("disk", BAD, f"{Path.cwd()} cannot be written", "work in a folder of yours")
    elif free < 1:
        yield DoctorFinding(
            "disk", WARNING, f"{free:.1f} GB free here", "recordings take about 0.3 GB an hour: make room"
        )
    else:
        yield DoctorFinding("disk", OK, f"{free:.0f} GB free here")


def data() -> Iterator[DoctorFinding]:
    place = os.environ.get("ZENAV_DATA", "")  # noqa: TID251
    if not place:
        yield DoctorFinding("ZENAV_DATA", OK, "not set: tests on real logs are skipped")
    elif not Path(place).is_dir():
        yield DoctorFinding(
            "ZENAV_DATA", WARNING, f"{place} is no folder", "unset it, or name the folder with the logs"
        )
    else:
        yield DoctorFinding("ZENAV_DATA", OK, place)


def certificates() -> Iterator[DoctorFinding]:
    """Certificates that end soon; nothing where this computer has no folder of credentials."""
    folder = secure_folder()
    if not folder.exists:
        return
    day = datetime.now(UTC).date()  # noqa: TID251  # certificates end by the wall clock
    days_left = {"the robot": folder.robot_days_left(day)}
    days_left |= {member.name: member.days_left(day) for member in folder.members() if not member.revoked}
    for name, days in days_left.items():
        if days <= RENEWAL_DAYS:
            hint = "zenav secure renew" + ("" if name == "the robot" else f" {name}")
            found = f"that of {name} ended" if days < 0 else f"that of {name} ends in {days} days"
            yield DoctorFinding("certificates", BAD if days < 0 else WARNING, found, hint)
    try:
        folder.require()
    except UserError as error:
        yield DoctorFinding("certificates", BAD, error.what, error.hint)
    if min(days_left.values()) > RENEWAL_DAYS:
        yield DoctorFinding("certificates", OK, f"{len(days_left)}, the next ends in {min(days_left.values())} days")
