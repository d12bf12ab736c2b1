# SPDX-License-Identifier: Apache-2.0
"""One try of an item's work in a process of its own: its result, or how it ended otherwise.

Tasks run in threads, here and on a cluster's workers. A thread cannot be stopped, and a worker that runs out of
memory takes its other tasks along. So the engine's thread only watches this process. Our own.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Literal

import psutil

from zenav.batch.child_reply import ChildReply

LOOK_S = 0.1  # between two looks at memory and time

Ending = Literal["done", "raised", "died", "timeout", "memory"]


@dataclass(frozen=True, slots=True)
class TryLimits:
    """Of one try: s on the wall, bytes resident; 0 is none. tries: of one item, at least 1."""

    timeout: float = 0.0
    memory: int = 0
    tries: int = 2


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a try ended. value: of the work, if done. detail: in words, if not. n_tries: including this one."""

    ending: Ending
    value: Any = None
    detail: str = ""
    n_tries: int = 1


class ChildProcess:
    """A process that works on one item at a time, started when it is needed. For one thread."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._link: Connection[Any, Any] | None = None

    def run(self, work: Callable[[Any], Any], item: Any, limits: TryLimits) -> Outcome:
        """One try. After any end but done and raised the process is a new one."""
        outcome = self._run(work, item, limits)
        if outcome.ending == "died" and self._idle_ended():
            self.close()
            outcome = self._run(work, item, limits)
        if outcome.ending not in ("done", "raised"):
            self.close()
        return outcome

    def close(self) -> None:
        """Kills the process. May be called by another thread: its `run` then ends as died."""
        process, link = self._process, self._link
        self._process = self._link = None
        if process is not None:
            process.kill()
            process.wait()
        if link is not None:
            link.close()

    def _run(self, work: Callable[[Any], Any], item: Any, limits: TryLimits) -> Outcome:
        process, link = self._started()
        begun = time.monotonic()
        try:
            link.send((work, item))
            while not link.poll(LOOK_S if limits.timeout or limits.memory else None):
                if limits.timeout and time.monotonic() - begun > limits.timeout:
                    return Outcome("timeout", detail=f"took more than {limits.timeout:g} s")
                if limits.memory and (used := _resident(process.pid)) > limits.memory:
                    return Outcome("memory", detail=f"{used / 1e6:.0f} MB, more than {limits.memory / 1e6:.0f} MB")
            reply: ChildReply = link.recv()
        except (EOFError, OSError):
            return Outcome("died", detail=_ending(process))
        if reply.out_of_memory:
            return Outcome("memory", detail=reply.error)
        return Outcome("raised", detail=reply.error) if reply.error else Outcome("done", reply.value)

    def _started(self) -> tuple[subprocess.Popen[bytes], "Connection[Any, Any]"]:
        if self._process is None or self._link is None:
            ours, its = socket.socketpair()
            number = its.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "zenav.batch.child", str(os.getpid()), str(number)],
                pass_fds=(number,),
                stdin=subprocess.DEVNULL,
            )
            its.close()
            self._link = Connection(ours.detach())
        return self._process, self._link

    def _idle_ended(self) -> bool:
        """Whether it had ended in order, before it got the item."""
        return self._process is not None and self._process.poll() == 0


def _resident(pid: int) -> int:
    try:
        return int(psutil.Process(pid).memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


def _ending(process: subprocess.Popen[bytes]) -> str:
    try:
        status = process.wait(5)
    except subprocess.TimeoutExpired:
        return "closed its link"
    return f"killed by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
