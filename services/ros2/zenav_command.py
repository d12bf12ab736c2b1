# SPDX-License-Identifier: Apache-2.0
"""Commands of zenav that work on files of maps, which services do not read: each in a process of its own."""

import json
import subprocess
import sys
from math import radians
from typing import NamedTuple

from services.ros2.outgoing_markers import Place

LIMIT_S, MAX_TEXT = 120.0, 300  # a large map; characters of an error


class CommandResult(NamedTuple):
    """What a command wrote. error: its words; empty where it is done."""

    text: str
    error: str


def run_command(*arguments: str) -> CommandResult:
    """Runs `zenav ARGUMENTS` and waits for its end."""
    command = (sys.executable, "-P", "-m", "zenav", *arguments)
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=LIMIT_S
        )
    except (OSError, subprocess.TimeoutExpired) as failed:
        return CommandResult("", str(failed)[-MAX_TEXT:])
    error = "" if done.returncode == 0 else " ".join(done.stderr.split()) or f"status {done.returncode}"
    return CommandResult(done.stdout, error[-MAX_TEXT:])


def saved_places(map_name: str) -> tuple[Place, ...]:
    """The places of a saved map, of none where the name is empty; without places where they cannot be read."""
    result = run_command("places", "list", "--json", *(("--map", map_name) if map_name else ()))
    rows = [json.loads(line) for line in result.text.splitlines()] if not result.error else []
    return tuple(Place(row["name"], row["x"], row["y"], _radians(row["yaw"])) for row in rows)


def _radians(yaw: float | None) -> float | None:
    return None if yaw is None else radians(yaw)
