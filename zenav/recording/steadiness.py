# SPDX-License-Identifier: Apache-2.0
"""`zenav recording stability`: how steadily the robot of a recording drove."""

import json
import sys
from contextlib import suppress
from pathlib import Path

from shared.codec import CodecError, decode
from shared.config import UserError
from shared.topics import topic_of
from zenav.console.table import show_table
from zenav.metrics.stability import KEYS, Ride, figure_rows
from zenav.recording.opening import open_recording


def stability(path: Path, as_json: bool) -> int:
    """Shows the figures. Raises UserError where no task was driven."""
    figures = read_ride(path).figures()
    if all(value is None for value in figures.values()):
        raise UserError(f"{path} holds no task that was driven", "record nav/status, plan, and odom or sim/truth")
    if as_json:
        sys.stdout.write(json.dumps(figures) + "\n")
    else:
        show_table("while a task was under way", ("", ""), figure_rows(figures))
    return 0


def read_ride(path: Path) -> Ride:
    """The ride in a recording, without messages that cannot be read. Raises UserError where the file is none."""
    ride = Ride()
    for entry in open_recording(path).entries(KEYS):
        topic = topic_of(entry.key)
        if topic is None or entry.latched:
            continue
        with suppress(CodecError):
            ride.add(decode(topic.type, entry.payload)[0])
    return ride
