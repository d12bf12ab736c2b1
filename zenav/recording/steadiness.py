# SPDX-License-Identifier: Apache-2.0
"""`zenav recording stability`: how steadily the robot of a recording drove."""

import json
import sys
from pathlib import Path

from shared.codec import decode
from shared.config import UserError
from shared.topics import topic_of
from zenav.bench.table import table
from zenav.recording.chosen import opened
from zenav.stability import KEYS, Ride, rows


def stability(path: Path, as_json: bool) -> int:
    """Shows the figures. Raises UserError where no task was driven."""
    figures = ride_of(path).figures()
    if all(value is None for value in figures.values()):
        raise UserError(f"{path} holds no task that was driven", "record nav/status, plan, and odom or sim/truth")
    if as_json:
        sys.stdout.write(json.dumps(figures) + "\n")
    else:
        table("while a task was under way", ("", ""), rows(figures))
    return 0


def ride_of(path: Path) -> Ride:
    """The ride in a recording. Raises UserError where the file is none."""
    ride = Ride()
    for entry in opened(path).entries(KEYS):
        topic = topic_of(entry.key)
        if topic is not None and not entry.latched:
            ride.take(decode(topic.type, entry.payload)[0])
    return ride
