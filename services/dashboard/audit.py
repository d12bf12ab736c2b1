# SPDX-License-Identifier: Apache-2.0
"""The audit: one line of the service's log for each command of a page. Angles are shown in degrees."""

from collections.abc import Mapping
from math import degrees
from typing import Any

from services.dashboard.sessions import PageSession
from shared import requests
from shared.roles import OPERATION_ROLES, Role
from shared.service import Log
from shared.types import NS_PER_S

MAX_TEXT = 120  # characters of a command's arguments
REFUSALS_EVERY_NS = 10 * NS_PER_S  # of one kind and page: a page that may not drive sends 20 frames a second
QUIET_REQUESTS = (requests.WATCH.key, requests.WATCH_GRAPH.key, requests.WATCH_LINK.key)
"""Requests that command nothing."""


def audit(page: PageSession, text: str) -> Log:
    """What a page does."""
    return Log("INFO", f"audit: {page.name} ({page.role}, {page.address}): {text}")


def refusal_line(page: PageSession, what: str, now: int) -> Log | None:
    """The line for a command that a page may not give; None where there was one shortly before. now: ns."""
    before = page.refused_at.get(what)
    if before is not None and 0 <= now - before < REFUSALS_EVERY_NS:
        return None
    page.refused_at[what] = now
    return audit(page, f"refused: {what}")


def request_text(key: str, arguments: Mapping[str, Any]) -> str:
    """A request in words; empty where it commands nothing. arguments: checked."""
    if key in QUIET_REQUESTS:
        return ""
    poses = arguments.get("poses", ())
    if key == requests.NAVIGATE.key and len(poses) == 1:
        return "goal " + pose_text(poses[0])
    if key == requests.NAVIGATE.key:
        return f"route of {len(poses)} poses"
    return " ".join((key.removeprefix("request/"), values_text(arguments))).strip()


def operation_text(op: str, arguments: Mapping[str, Any]) -> str:
    """An operation in words; empty where it changes nothing."""
    if OPERATION_ROLES[op] is Role.VIEWER:
        return ""
    return " ".join((op, values_text(arguments))).strip()


def pose_text(pose: Any) -> str:
    """[x, y, yaw] in m, m, rad as `3.0 4.0 90°`."""
    x, y, yaw = pose
    return f"{x:.1f} {y:.1f} {degrees(yaw) % 360:.0f}°"


def values_text(arguments: Mapping[str, Any]) -> str:
    """Arguments as `name=value`; of a list its length, of a pose its numbers."""
    return " ".join(f"{name}={_value_text(name, value)}" for name, value in arguments.items())[:MAX_TEXT]


def _value_text(name: str, value: Any) -> str:
    if name == "pose" and len(value) == 3:
        return pose_text(value)
    if isinstance(value, list | tuple):
        return f"[{len(value)}]"
    if isinstance(value, Mapping):
        return f"{{{len(value)}}}"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if text.isprintable() else repr(text)
