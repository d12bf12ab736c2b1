# SPDX-License-Identifier: Apache-2.0
"""State as Foxglove's diagnostics panels show it: one name, a level, a sentence, and the values behind it."""

from dataclasses import dataclass
from typing import Any

from shared.messages import BaseStatus, GuardState, GuardStatus, Health, Message, NavState, NavStatus
from shared.reasons import REASONS, reason_text
from zenav.foxglove import as_json

OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

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
_LEVELS = {"info": OK, "hold": WARN, "stop": ERROR, "fault": ERROR}


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
    if isinstance(message, GuardStatus):
        level = _level(message.reason) if message.state is not GuardState.IDLE else OK
        return _state(message, "guard", level, f"{message.state}", message.reason, message.detail)
    if isinstance(message, NavStatus):
        level = ERROR if message.state is NavState.FAILED else _level(message.reason)
        return _state(message, "navigator", level, f"{message.state}", message.reason, message.detail)
    if isinstance(message, BaseStatus):
        return _state(message, "base", _level(message.fault), "", message.fault, message.detail)
    if isinstance(message, Health):
        level = WARN if message.bad_messages or message.intruders else OK
        return _state(message, f"service {message.name}", level, message.state, "", message.last_error)
    return None


def silent(name: str, now: int, seconds: float) -> Diagnostics:
    """A service that no longer sends its health."""
    return Diagnostics(now, f"service {name}", STALE, f"silent for {seconds:.0f} s", {})


def _level(reason: str) -> int:
    return _LEVELS[REASONS[reason].severity] if reason in REASONS else (WARN if reason else OK)


def _state(message: Message, name: str, level: int, state: str, reason: str, detail: str) -> Diagnostics:
    parts = [state, reason_text(reason), detail]
    values = {
        key: f"{value:.6g}" if isinstance(value, float) else str(value)
        for key, value in as_json.document(message).items()
        if isinstance(value, str | int | float)
    }
    return Diagnostics(message.stamp, name, level, ": ".join(part for part in parts if part) or "good", values)
