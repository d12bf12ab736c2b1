# SPDX-License-Identifier: Apache-2.0
"""Recordings: MCAP files of the messages as they were sent, in the order in which the recorder received them.

A channel is a key without the robot's name. Its message encoding is `msgpack`, with a schema in JSON. `log_time` is the
time of recording, `publish_time` the time of sending. Data before the last `flush` survives a crash of the writer. The
same input gives the same file.

A recording may consist of parts. Each part can be read alone: it begins with the configuration and the latched values
(`Channel.latched`).
"""

import platform
import subprocess
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path

from shared.recordings.reader import ABOUT, CONFIG, Channel, Drop, Entry, Recording
from shared.recordings.writer import Writer, is_finished, is_locked
from shared.repeatable import processor
from shared.runners.host import Sent

__all__ = [
    "ABOUT",
    "CONFIG",
    "Channel",
    "Drop",
    "Entry",
    "Recording",
    "Writer",
    "about",
    "arithmetic",
    "is_finished",
    "is_locked",
    "sink",
]


def sink(writer: Writer) -> Callable[[Sent], None]:
    """A function that records publications, with the send time as log time: Lockstep(record=sink(writer))."""

    def record(sent: Sent) -> None:
        envelope = sent.envelope
        writer.write(sent.key, sent.topic.type, sent.payload, envelope.sent, envelope.sent, envelope.sequence)

    return record


def about(robot: str) -> dict[str, str]:
    """Metadata of a new recording: robot, versions, machine, git commit where there is one.

    A replay gives the same last bits where `arithmetic()` is the same.
    """
    return {"robot": robot, **{name: version(name) for name in ("msgpack", "mcap")}, **arithmetic(), **_commit()}


def arithmetic() -> dict[str, str]:
    """Processor, C library, numpy and numba of this machine: the last bits of results depend on them."""
    libc = " ".join(platform.libc_ver())
    return {"processor": processor(), "libc": libc, "numpy": version("numpy"), "numba": version("numba")}


@cache
def _commit() -> dict[str, str]:
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():  # installed, perhaps inside of a checkout of something else
        return {}
    try:
        result = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=root,
            capture_output=True,
            text=True,
            timeout=5,
        )
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"commit": result.stdout.strip()} if result.returncode == 0 else {}
