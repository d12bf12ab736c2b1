# SPDX-License-Identifier: Apache-2.0
"""Starts the services as processes, brings dead and hung ones back, and ends them all: none is ever left behind."""

import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from shared.config import UserError
from shared.extensions import service_module
from shared.messages import Health
from shared.runners.transport import BASE_PORT, MAX_DOMAIN, PORTS_A_STACK, StackAddress
from shared.topics import SERVICES
from zenav.stack.preloaded import GUARD, Adopted, Preloaded, wait_for_end

ROOT = Path(__file__).resolve().parents[2]
MAX_SILENCE_S = 5.0  # s without a health message after which a service that had sent one counts as hung
MAX_STEP_S = 1.0  # s between two steps; the launcher itself stood still for the rest, as by Ctrl-Z
START_LIMIT = 180.0  # s to the first health message: a first start may compile its kernels
RECORDER_LIMIT = 20.0  # s that the others wait for the recorder, which shall miss nothing
MAX_SHUTDOWN_S = (
    1.2  # s for the services to end by themselves; then as long for the recorder, which writes what they said last
)
HEALTHY_AFTER = 30.0  # s of life after which a death counts as the first again
BACK_OFF = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # s before the first, second, ... restart in a row

Teller = Callable[[str, str], None]
"""(service, line): what people should see."""


@dataclass(slots=True)
class ServiceProcess:
    """One service's process and its history."""

    name: str
    command: list[str]
    log: Path
    process: "subprocess.Popen[bytes] | Adopted | None" = None
    started: float = 0.0
    heard: float = 0.0  # when its last health came; 0 before the first of this life
    due: float = 0.0  # when it is to be started again
    n_deaths: int = 0  # in a row
    n_restarts: int = 0
    told: int = 0  # bytes of its log that were shown
    cause: str = ""  # of its last death

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None


def service_command(
    name: str, robot: str, stack: str, settings: list[str], clock: str = "", memory: Path | None = None
) -> list[str]:
    """The command line of a process that dies with this one. memory: folder for what a restart must not lose,
    in that of the run, where recordings of crashes go."""
    command = [*GUARD, str(os.getpid()), service_module(name), "--robot", robot, "--stack", stack]
    for setting in settings:
        command += ["--set", setting]
    command += ["--memory", str(memory), "--crashes", str(memory.parent)] if memory else []
    return [*command, "--clock", clock] if clock else command


@dataclass
class Launcher:
    """Starts and supervises the processes of a stack.

    Use it as a context: leaving it ends every process within 3 s. Its user calls `step` a few times a second.
    commands: by service's name, in the order of starting; a recorder goes first.   logs: folder of NAME.log.
    show_line: receives each log line of the services and of the launcher.   slowness: real seconds per stack second.
    """

    commands: dict[str, list[str]]
    logs: Path
    show_line: Teller = field(default=lambda name, line: None)
    slowness: float = 1.0

    def __post_init__(self) -> None:
        self.children = {
            name: ServiceProcess(name, command, self.logs / f"{name}.log") for name, command in self.commands.items()
        }
        self._lock = threading.Lock()
        self._stepped = time.monotonic()
        paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]  # noqa: TID251  # a child's environment is made here
        self._environment = dict(os.environ, PYTHONPATH=os.pathsep.join(p for p in paths if p))  # noqa: TID251
        self.preloaded = Preloaded(list(self.commands.values()), self._environment)

    def __enter__(self) -> "Launcher":
        self.logs.mkdir(parents=True, exist_ok=True)
        self.preloaded.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def start(self, name: str) -> None:
        """Starts one service's process: a fork of the preloaded parent, or a new program where there is none."""
        child = self.children[name]
        child.log.parent.mkdir(parents=True, exist_ok=True)  # a user may have cleaned up
        with child.log.open("ab") as log:
            child.told = min(child.told, log.tell())
            child.process = self.preloaded.fork(child.command, log) or subprocess.Popen(
                child.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=self._environment,
            )
        with self._lock:
            child.started, child.heard, child.due = time.monotonic(), 0.0, 0.0

    def start_all(
        self, ready: Callable[[str], bool] = lambda name: False, given_up: Callable[[], bool] = lambda: False
    ) -> None:
        """Starts every service, the recorder first; the others wait until `ready("recorder")`, for a while.

        Returns at once when `given_up()`, so that an interrupt also ends a start.
        """
        self.preloaded.wait_until_ready(given_up)
        if "recorder" in self.children:
            self.start("recorder")
            recorder, limit = self.children["recorder"], time.monotonic() + RECORDER_LIMIT
            while recorder.running and not ready("recorder") and not given_up() and time.monotonic() < limit:
                threading.Event().wait(0.02)
        for name in self.children:
            if name != "recorder" and not given_up():
                self.start(name)

    def hear(self, health: Health) -> None:
        """Takes a service's health; safe to call from any thread."""
        child = self.children.get(health.name)
        if child is not None and child.process is not None and child.process.pid == health.pid:
            with self._lock:
                child.heard = time.monotonic()

    def step(self) -> None:
        """Passes on the services' log lines, kills hung services, restarts dead ones.

        Raises UserError in a service's own words where the service refuses its configuration at the start.
        """
        with suppress(OSError):  # it cannot be started for the moment, and nothing depends on it
            self.preloaded.step()
        self._discount_own_pause()
        for child in self.children.values():
            self._show(child)
            if child.process is None:
                if child.due and time.monotonic() >= child.due:
                    self._restart(child)
                continue
            status = child.process.poll()
            if status is None:
                self._check_hung(child)
            else:
                self._bury(child, status)

    def pause(self, seconds: float) -> None:
        """Waits so long, or until a service ended or is due: then `step` is to be called."""
        now = time.monotonic()
        due = [child.due for child in self.children.values() if child.process is None and child.due]
        running = [child.process.pid for child in self.children.values() if child.process is not None]
        wait_for_end(running, min([seconds, *(at - now for at in due)]))

    def kill(self, name: str) -> None:
        """Ends one service's process at once, with everything that it started."""
        process = self.children[name].process
        if process is not None:
            _signal_group(process, signal.SIGKILL)

    def end(self) -> None:
        """Ends everything within 3 s: asked first, the recorder last, then by force."""
        self.preloaded.close()
        others = [child for child in self.children.values() if child.name != "recorder"]
        for group in (others, [child for child in self.children.values() if child.name == "recorder"]):
            for child in group:
                child.due = 0.0
                if child.running and child.process is not None:
                    child.process.terminate()
                    child.process.send_signal(signal.SIGCONT)  # a stopped process ends too
            limit = time.monotonic() + MAX_SHUTDOWN_S
            for child in group:
                if child.process is not None:
                    _wait(child.process, max(0.0, limit - time.monotonic()))
        for child in self.children.values():
            if child.process is not None:
                _signal_group(child.process, signal.SIGKILL)
                _wait(child.process, 0.5)
            self._show(child)

    def _discount_own_pause(self) -> None:
        """Counts no service as silent for the time in which this process could hear none."""
        now = time.monotonic()
        pause, self._stepped = now - self._stepped - MAX_STEP_S, now
        if pause > 0:
            with self._lock:
                for child in self.children.values():
                    child.started = min(child.started + pause, now)
                    child.heard = min(child.heard + pause, now) if child.heard else 0.0

    def _check_hung(self, child: ServiceProcess) -> None:
        now = time.monotonic()
        with self._lock:
            silent = now - (child.heard or child.started)
            limit = MAX_SILENCE_S * max(self.slowness, 1.0) if child.heard else START_LIMIT
        if silent > limit and child.cause != "hung":  # one that was killed may take its time to end
            self.show_line(child.name, f"hung: no health message for {silent:.0f} s; it is killed and started again")
            child.cause = "hung"
            self.kill(child.name)

    def _bury(self, child: ServiceProcess, status: int) -> None:
        self._show(child)
        words = last_lines(child.log)
        if status == 2 and not child.n_restarts and not child.heard:
            raise UserError(*_own_words(child.name, words))
        lived = time.monotonic() - child.started
        child.n_deaths = 1 if lived > HEALTHY_AFTER else child.n_deaths + 1
        child.process, wait = None, _put_off(child)
        child.cause = child.cause if child.cause == "hung" else _exit_text(status)
        self.show_line(
            child.name, f"{child.cause} after {lived:.1f} s; started again" + (f" in {wait:g} s" if wait else "")
        )
        if child.cause == "hung":
            child.cause = ""

    def _restart(self, child: ServiceProcess) -> None:
        child.n_restarts += 1
        try:
            self.start(child.name)
        except OSError as error:  # no memory, too many processes, a full disk: that may pass
            child.n_deaths += 1
            wait = _put_off(child)
            self.show_line(child.name, f"cannot be started: {error.strerror}; tried again in {wait:g} s")

    def _show(self, child: ServiceProcess) -> None:
        """Hands on what the service wrote since the last time, whole lines."""
        try:
            with child.log.open("rb") as log:
                log.seek(child.told)
                new = log.read()
        except FileNotFoundError:
            return
        whole = new.rpartition(b"\n")[0]
        if whole:
            child.told += len(whole) + 1
            for line in whole.decode(errors="replace").splitlines():
                self.show_line(child.name, line)


def _put_off(child: ServiceProcess) -> float:
    """Sets when a dead service is due, later after each death in a row. Returns the s until then."""
    wait = BACK_OFF[min(child.n_deaths - 1, len(BACK_OFF) - 1)]
    child.due = time.monotonic() + wait
    return wait


def last_lines(log: Path, n: int = 20) -> list[str]:
    """The last lines of a log; none where there is none."""
    try:
        return log.read_text(errors="replace").splitlines()[-n:]
    except OSError:
        return []


class StackClaim:
    """A stack number of one's own: while it is held, no other launcher takes it. Use as a context."""

    def __init__(self, domain: int, lock: socket.socket) -> None:
        self.where, self._lock = StackAddress(domain), lock

    def __enter__(self) -> "StackClaim":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.close()


def claim_stack(domain: int) -> StackClaim:
    """The claim on a stack number. Raises UserError, with the holder's name, where another process has it."""
    port = BASE_PORT + PORTS_A_STACK * (domain + 1) - 1  # the block's last: no service has it
    lock = socket.socket()
    try:
        lock.bind(("127.0.0.1", port))
        lock.listen()
    except OSError:
        lock.close()
        raise _is_taken(domain, port) from None
    ports = taken_ports(StackAddress(domain))
    if ports:
        lock.close()
        raise _is_taken(domain, ports[0])
    return StackClaim(domain, lock)


def free_stack() -> StackClaim:
    """The claim on a stack number that no process has. Raises UserError where all are taken."""
    first = os.getpid()  # two that look at the same time do not look at the same numbers
    for i in range(MAX_DOMAIN):
        try:
            return claim_stack(MAX_DOMAIN - (first + i) % MAX_DOMAIN)
        except UserError:
            continue
    raise UserError("every stack number is taken", "end some stacks: see ss -tlnp")


def taken_ports(where: StackAddress, names: tuple[str, ...] = SERVICES) -> list[int]:
    """Which loopback ports of these services are taken."""
    found = []
    for name in names:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", where.port(name)))
            except OSError:
                found.append(where.port(name))
    return found


def claim_holder(port: int) -> str:
    """The process that listens on a loopback port, as far as this user may see: `python3 (pid 4711)`."""
    import psutil

    try:
        for connection in psutil.net_connections("tcp"):
            if connection.laddr and connection.laddr.port == port and connection.status == psutil.CONN_LISTEN:
                pid = connection.pid
                if pid is not None:
                    words = " ".join(psutil.Process(pid).cmdline()[:7])
                    return f"{words or 'process'} (pid {pid})"
    except psutil.Error:
        pass
    return f"another user's process: sudo ss -tlnp | grep {port}"


def _is_taken(domain: int, port: int) -> UserError:
    return UserError(
        f"port {port} of stack {domain} is taken by {claim_holder(port)}",
        "end it, or choose another number, like: --stack 1",
    )


def _own_words(name: str, words: list[str]) -> tuple[str, str]:
    """(what, hint) of the UserError that a service ended with."""
    hint = next((line.removeprefix("hint: ") for line in reversed(words) if line.startswith("hint: ")), "see its log")
    what = next((line for line in reversed(words) if line.startswith(f"{name}: ")), f"{name} ended with status 2")
    return what, hint


def _exit_text(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"


def _signal_group(process: "subprocess.Popen[bytes] | Adopted", number: int) -> None:
    try:
        os.killpg(process.pid, number)  # its own session: the group is the process and what it started
    except ProcessLookupError:
        return


def _wait(process: "subprocess.Popen[bytes] | Adopted", seconds: float) -> None:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
