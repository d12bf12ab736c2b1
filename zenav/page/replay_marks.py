# SPDX-License-Identifier: Apache-2.0
"""What stands beside the time of a replay: stops and faults, marks of users, and the robot's trail."""

from math import hypot, inf
from typing import Any

import msgpack

from services.dashboard.frames import MARK
from shared import topics
from shared.messages import GuardState
from shared.recording import Entry
from shared.topics import key_of
from zenav.page.target import Values

LOG_KEY = key_of(topics.LOG, "dashboard")
MARK_KEYS = frozenset((topics.GUARD.key, LOG_KEY, topics.POSE.key))
MAX_MARKS = 500
TRAIL_STEP_M = 0.1
MAX_TRAIL = 20_000  # points: 2 km
STOPPED = (GuardState.STOPPED, GuardState.FAULT)


class ReplayMarks:
    """Takes the messages of MARK_KEYS in the order of recording. zero: ns, the begin of the recording.

    marks: rows of `t` (s), `kind` ("fault" or "mark"), `reason` (a code of shared/reasons.py) and `text`.
    trail: t, x, y of each point in one list; s, and m in `map`.
    """

    def __init__(self, zero: int) -> None:
        self.marks: list[Values] = []
        self.trail: list[float] = []
        self._zero = zero
        self._reason = ""
        self._last = (inf, inf)

    def add(self, entry: Entry) -> None:
        """Takes a message; one that is not valid is left out."""
        fields, time = _fields(entry.payload), (entry.log_time - self._zero) / 1e9
        if entry.key == topics.POSE.key:
            self._add_pose(time, fields.get("map_from_base"))
        elif entry.key == LOG_KEY:
            text = str(fields.get("text", ""))
            if text.startswith(MARK):
                self._add_mark(time, "mark", "", text.removeprefix(MARK))
        else:
            reason = str(fields.get("reason", "")) if fields.get("state") in STOPPED else ""
            if reason not in ("", self._reason):
                self._add_mark(time, "fault", reason, str(fields.get("detail", "")))
            self._reason = reason

    def _add_mark(self, time: float, kind: str, reason: str, text: str) -> None:
        if len(self.marks) < MAX_MARKS:
            self.marks.append({"t": time, "kind": kind, "reason": reason, "text": text})

    def _add_pose(self, time: float, pose: Any) -> None:
        if type(pose) is not list or len(pose) != 3 or len(self.trail) >= 3 * MAX_TRAIL:
            return
        x, y = float(pose[0]), float(pose[1])
        if not hypot(x - self._last[0], y - self._last[1]) < TRAIL_STEP_M:
            self.trail += (time, x, y)
            self._last = x, y


def _fields(payload: bytes) -> Values:
    """The fields of a message as they are on the wire: an hour has a hundred thousand, and few of them count."""
    try:
        tree = msgpack.unpackb(payload)
    except Exception:  # msgpack raises a dozen kinds on foreign bytes: all mean the same here
        return {}
    return tree if type(tree) is dict else {}
