# SPDX-License-Identifier: Apache-2.0
"""What the core sends on its port: frames for pages as they go on the wire, and orders to the shell."""

from typing import Any

import msgpack

from services.dashboard.frames import PAGE_KEYS, SITE_KEYS
from services.dashboard.sessions import PageSession
from shared import topics
from shared.config import Robot
from shared.lasers import laser_mounts
from shared.messages import SerialData
from shared.reasons import REASONS
from shared.topics import Publication

PORT = "page"
"""The name of the service's port."""
NEEDS_ROLE_HINT = "an admin of this robot gives roles"
Id = int | str
"""What a page calls its request: the reply repeats it."""


def frame(now: int, client: int | None, fields: dict[str, Any]) -> Publication:
    """A frame for a page, or for all pages (None). now: ns."""
    return _out(now, {"client": client, "t": fields["t"], "frame": bytes(msgpack.packb(fields))})


def note(now: int, client: int | None, level: str, text: str, hint: str) -> Publication:
    """A text for the user of a page, or of all. level: "info", "warning" or "error"."""
    return frame(now, client, {"t": "note", "level": level, "text": text, "hint": hint})


def accepting_reply(now: int, client: int, answered: Id) -> Publication:
    """The reply to a frame that the core itself has carried out."""
    return frame(now, client, _reply(answered, True, "", "", ""))


def refusing_reply(now: int, client: int, answered: Id, reason: str, detail: str) -> Publication:
    """The reply to a frame that the core refuses. reason: a code of shared/reasons.py, or "role"."""
    hint = REASONS[reason].hint if reason in REASONS else NEEDS_ROLE_HINT
    return frame(now, client, _reply(answered, False, reason, detail, hint))


def hello(now: int, page: PageSession, robot: Robot, simulated: bool, version: str) -> Publication:
    """The first frame of a page. The shell adds its token against forged requests, which no recording shall hold."""
    fields = {
        "t": "hello",
        "client": page.client,
        "name": page.name,
        "role": str(page.role),
        "login": page.is_login,
        "robot": {
            "name": page.robot or robot.name,
            "outline": robot.corners.tolist(),
            **laser_mounts(robot),
            "max_speed": robot.drive.max_speed,
            "max_reverse_speed": robot.drive.max_reverse_speed,
            "max_turn_rate": robot.drive.max_turn_rate,
        },
        "simulated": simulated,
        "version": version,
        "keys": SITE_KEYS if page.robot else PAGE_KEYS,
        "reasons": {code: [row.text, row.hint, row.severity] for code, row in REASONS.items()},
    }
    if page.robot:
        fields["site"] = True
    return _out(now, {"client": page.client, "hello": fields})


def want_order(now: int, client: int, keys: list[str]) -> Publication:
    """The order to give a page the messages of these keys, and of no others."""
    return _out(now, {"client": client, "want": keys})


def ask_order(now: int, client: int | None, answered: Id | None, key: str, payload: bytes) -> Publication:
    """The order to send a request, and its reply to the page. client: None where no page waits for a reply."""
    return _out(now, {"client": client, "id": answered, "ask": key, "payload": payload})


def stop_order(now: int, client: int, robots: list[str] | None, pressed: bool, by: str) -> Publication:
    """The order to press or release STOP of robots until each confirms it; None: of all that are heard."""
    return _out(now, {"client": client, "stop": robots, "pressed": pressed, "by": by})


def do_order(now: int, client: int, answered: Id, op: str, arguments: dict[str, Any]) -> Publication:
    """The order to let a tool work, and to send its result to the page."""
    return _out(now, {"client": client, "id": answered, "do": op, "args": arguments})


def _reply(answered: Id, accepted: bool, reason: str, detail: str, hint: str) -> dict[str, Any]:
    return {
        "t": "reply",
        "id": answered,
        "accepted": accepted,
        "reason": reason,
        "detail": detail,
        "hint": hint,
        "data": None,
    }


def _out(now: int, fields: dict[str, Any]) -> Publication:
    return topics.TX(SerialData(now, PORT, bytes(msgpack.packb(fields))))
