# SPDX-License-Identifier: Apache-2.0
"""State as Foxglove's diagnostics panels show it: one name, a level, a sentence, and the values behind it."""

from dataclasses import dataclass
from typing import Any

from shared.messages import Message
from shared.part_state import STALE, part_state
from zenav.foxglove import as_json

_TEXT = {"type": "string"}
_PAIR = {"type": "object", "properties": {"key": _TEXT, "value": _TEXT}}
_STATUS = {
    "type": "object",
    "properties": {
        "level": {"type": "integer"},
        "name": _TEXT,
        "message": _TEXT,
        "hardware_id": _TEXT,
        "values": {"type": "array", "items": _PAIR},
    },
}
DIAGNOSTICS: dict[str, Any] = {
    "type": "object",
    "title": "diagnostic_msgs/DiagnosticArray",
    "properties": {
        "header": {"type": "object", "properties": {"stamp": as_json.TIME, "frame_id": _TEXT}},
        "status": {"type": "array", "items": _STATUS},
    },
}


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """One part's state at `stamp` (ns)."""

    stamp: int
    name: str
    level: int
    text: str
    values: dict[str, str]

    def document(self) -> dict[str, Any]:
        """As diagnostic_msgs/DiagnosticArray in JSON."""
        values = [{"key": key, "value": value} for key, value in self.values.items()]
        status = {
            "level": self.level,
            "name": self.name,
            "message": self.text,
            "hardware_id": "zenav",
            "values": values,
        }
        return {"header": {"stamp": as_json.time_of(self.stamp), "frame_id": ""}, "status": [status]}


def diagnostics_of(message: Message) -> Diagnostics | None:
    """The state in a status of guard, navigator or base, or in a health message; None for other messages."""
    state = part_state(message)
    if state is None:
        return None
    values = {
        key: f"{value:.6g}" if isinstance(value, float) else str(value)
        for key, value in as_json.document(message).items()
        if isinstance(value, str | int | float)
    }
    return Diagnostics(message.stamp, *state, values)


def silent(name: str, now: int, seconds: float) -> Diagnostics:
    """A service that no longer sends its health."""
    return Diagnostics(now, f"service {name}", STALE, f"silent for {seconds:.0f} s", {})
