# SPDX-License-Identifier: Apache-2.0
"""The launcher's side of the preloaded parent (fork_server.py): starts it, asks it for processes, replaces it."""

import ctypes
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO

from zenav.stack import fork_server
from zenav.stack.heap import limit_heap

GUARD = (sys.executable, "-P", "-m", "zenav.stack.process_guard")
"""How a service's command begins; then come the launcher's number, the module and its arguments."""
PR_SET_CHILD_SUBREAPER = 36
READY_LIMIT_S = 60.0  # until services are started without it: a first start may compile kernels
REPLY_LIMIT_S = 2.0
END_LIMIT_S = 5.0  # after SIGKILL; a busy machine needs that
AGAIN_S = 5.0  # between two starts of it

_subreaping = threading.Lock()


class Adopted:
    """A process that another one forked for this one: what `subprocess.Popen` offers, as far as it is used here."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Its exit status, negative for a signal; None while it runs."""
        if self.returncode is None:
            with suppress(ChildProcessError):
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                if pid == self.pid:
                    self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit status. Raises subprocess.TimeoutExpired when it does not end within `timeout` s."""
        if self.poll() is None:
            wait_for_end([self.pid], timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)


def wait_for_end(pids: list[int], seconds: float) -> None:
    """Returns when one of these children ends, after `seconds` at the latest."""
    if not hasattr(os, "pidfd_open"):
        threading.Event().wait(min(seconds, 0.02))
        return
    descriptors = []
    try:
        for pid in pids:
            with suppress(ProcessLookupError):
                descriptors.append(os.pidfd_open(pid))
        ends = select.poll()
        for descriptor in descriptors:
            ends.register(descriptor, select.POLLIN)
        ends.poll(max(seconds, 0.0) * 1e3)
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def split(command: list[str]) -> tuple[str, list[str]] | None:
    """Module and arguments of a service's command; None where it is another program's."""
    n = len(GUARD)
    if tuple(command[:n]) != GUARD or len(command) < n + 2:
        return None
    return command[n + 1], command[n + 2 :]


class Preloaded:
    """The preloaded parent of these commands' services, where this system can have one.

    Nothing waits for it for longer than its limits, and nothing depends on it: where it fails, `fork` returns None.
    """

    def __init__(self, commands: list[list[str]], environment: dict[str, str]) -> None:
        self._commands = dict(found for command in commands if (found := split(command)) is not None)
        self._environment = environment
        self._connection: socket.socket | None = None
        self._process: Adopted | subprocess.Popen[bytes] | None = None
        self._ready, self._started = False, float("-inf")

    @property
    def pid(self) -> int | None:
        """Its number; None where it does not run."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    def start(self) -> None:
        """Starts it, and returns before it is ready.

        A launcher with one thread preloads in its own process and forks: so it shares these pages with the services.
        """
        if sys.platform != "linux" or not any(module.startswith("services.") for module in self._commands):
            return
        self.close()
        limit_heap()
        self._started = time.monotonic()
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if fork_server.is_single_threaded() and fork_server.preload(self._commands):
            self._process = self._forked(there)
        else:  # this process may not be copied: its threads hold locks
            command = [sys.executable, "-P", "-m", fork_server.MODULE, str(os.getpid()), str(there.fileno())]
            self._process = subprocess.Popen(
                [*command, json.dumps(self._commands)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(there.fileno(),),
                env=self._environment,
            )
        there.close()
        self._connection = here

    def wait_until_ready(self, given_up: Callable[[], bool]) -> None:
        """Returns when it can fork, when it has failed, when `given_up()`, or after its limit."""
        limit = self._started + READY_LIMIT_S
        while self._connection is not None and not self._ready and not given_up() and time.monotonic() < limit:
            self._hear_ready(0.1)

    def step(self) -> None:
        """Replaces it where it died."""
        if self._connection is None and self._started == float("-inf"):
            return
        if self.pid is None and time.monotonic() - self._started > AGAIN_S:
            self.start()

    def fork(self, command: list[str], log: BinaryIO) -> Adopted | None:
        """A new process for a service's command, this one's child; None where it must be started in another way."""
        wanted = split(command)
        if wanted is None or wanted[0] not in self._commands or self.pid is None or self._connection is None:
            return None
        if not self._ready:
            self._hear_ready(0.0)
        if not self._ready:
            return None
        module, arguments = wanted
        request = json.dumps({"module": module, "arguments": arguments, "folder": os.getcwd()}).encode()
        gate, opener = os.pipe()
        try:
            with _subreaper():
                self._connection.settimeout(REPLY_LIMIT_S)
                socket.send_fds(self._connection, [request], [log.fileno(), gate])
                process = Adopted(int(self._connection.recv(64)))
            os.write(opener, b"g")
        except (OSError, ValueError):
            self.close()  # the process, if there is one, finds its gate closed
            return None
        finally:
            os.close(gate)
            os.close(opener)
        return process

    def close(self) -> None:
        """Ends it; the services that it forked go on."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGKILL)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_LIMIT_S)
        self._connection, self._process, self._ready = None, None, False
        gc.unfreeze()

    def _forked(self, connection: socket.socket) -> Adopted:
        launcher = os.getpid()
        sys.stdout.flush()
        sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            try:
                fork_server.serve(connection, launcher)
            finally:
                os._exit(1)
        return Adopted(pid)

    def _hear_ready(self, seconds: float) -> None:
        assert self._connection is not None
        self._connection.settimeout(max(seconds, 0.001))
        try:
            self._ready = self._connection.recv(64) == fork_server.READY
        except TimeoutError:
            return
        except OSError:
            self._ready = False
        if not self._ready:
            self.close()


@contextmanager
def _subreaper() -> Iterator[None]:
    """Within the block this process becomes the parent of its grandchildren whose parent ends."""
    with _subreaping:
        prctl = ctypes.CDLL(None).prctl
        prctl(PR_SET_CHILD_SUBREAPER, 1)
        try:
            yield
        finally:
            prctl(PR_SET_CHILD_SUBREAPER, 0)
