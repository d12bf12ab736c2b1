# SPDX-License-Identifier: Apache-2.0
"""State of the parts of a stack as diagnostics show it: name, level and text, from their status messages."""

from typing import NamedTuple

from shared.messages import BaseStatus, GuardState, GuardStatus, Health, Message, NavState, NavStatus
from shared.reasons import REASONS, reason_text

OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""
_LEVELS = {"info": OK, "hold": WARN, "stop": ERROR, "fault": ERROR}


class PartState(NamedTuple):
    """The state of one part."""

    name: str
    level: int
    text: str


def part_state(message: Message) -> PartState | None:
    """The state in a status of guard, navigator or base, or in a health message; None for other messages."""
    if isinstance(message, GuardStatus):
        level = _level(message.reason) if message.state is not GuardState.IDLE else OK
        return PartState("guard", level, _text(message.state, message.reason, message.detail))
    if isinstance(message, NavStatus):
        level = ERROR if message.state is NavState.FAILED else _level(message.reason)
        return PartState("navigator", level, _text(message.state, message.reason, message.detail))
    if isinstance(message, BaseStatus):
        return PartState("base", _level(message.fault), _text("", message.fault, message.detail))
    if isinstance(message, Health):
        level = WARN if message.bad_messages or message.intruders else OK
        return PartState(f"service {message.name}", level, _text(message.state, "", message.last_error))
    return None


def _level(reason: str) -> int:
    return _LEVELS[REASONS[reason].severity] if reason in REASONS else (WARN if reason else OK)


def _text(state: str, reason: str, detail: str) -> str:
    return ": ".join(part for part in (str(state), reason_text(reason), detail) if part) or "good"
