# SPDX-License-Identifier: Apache-2.0
"""Recordings: MCAP files that hold every message as it went on the wire, in the order in which the recorder took them.

A channel is a key without the robot's name; message encoding `msgpack`, the schema's text beside it. `log_time` is when
the recorder took a message, `publish_time` when it was sent. What was written until the last `flush` can be read
whatever happens to the writer; the same input gives the same file.

A recording may be split into parts. Each can be read alone: it begins with the configuration and with what was latched
then (`Channel.latched`).
"""

import platform
import subprocess
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path

from shared.recordings.reader import ABOUT, CONFIG, Channel, Drop, Entry, Recording
from shared.recordings.writer import Writer
from shared.repeatable import processor
from shared.runners.host import Sent

__all__ = ["ABOUT", "CONFIG", "Channel", "Drop", "Entry", "Recording", "Writer", "about", "arithmetic", "sink"]


def sink(writer: Writer) -> Callable[[Sent], None]:
    """Records what a runner publishes, with the time of sending as the time of logging: Lockstep(record=sink(w))."""

    def record(sent: Sent) -> None:
        envelope = sent.envelope
        writer.write(sent.key, sent.topic.type, sent.payload, envelope.sent, envelope.sent, envelope.sequence)

    return record


def about(robot: str) -> dict[str, str]:
    """Metadata of a recording that is made here and now: robot, versions, machine, git commit where there is one.

    Where `arithmetic()` is the same, the last bits of a replay are.
    """
    return {"robot": robot, **{name: version(name) for name in ("msgpack", "mcap")}, **arithmetic(), **_commit()}


def arithmetic() -> dict[str, str]:
    """What the last bits of a computation depend on here: processor, C library, numpy, numba."""
    libc = " ".join(platform.libc_ver())
    return {"processor": processor(), "libc": libc, "numpy": version("numpy"), "numba": version("numba")}


@cache
def _commit() -> dict[str, str]:
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=5,
        )
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"commit": found.stdout.strip()} if found.returncode == 0 else {}
