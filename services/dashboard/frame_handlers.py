# SPDX-License-Identifier: Apache-2.0
"""What each type of frame of a page does: docs/page.md has the protocol."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from services.dashboard.audit import audit, operation_text, refusal_line, request_text
from services.dashboard.field_checks import FrameError
from services.dashboard.frames import MARK, PAGE_KEYS, checked_operation, request_named, request_payload
from services.dashboard.outgoing import (
    accepting_reply,
    ask_order,
    do_order,
    frame,
    note,
    refusing_reply,
    stop_order,
    want_order,
)
from services.dashboard.sessions import PageSession
from shared import reasons, topics
from shared.messages import Velocity
from shared.roles import OPERATION_ROLES, REQUEST_ROLES, may, operation_role
from shared.service import Log, Out
from shared.types import NS_PER_S

if TYPE_CHECKING:
    from services.dashboard.service import DashboardService

STOP_LINES_NS = 3 * NS_PER_S  # between two lines of the audit for one STOP
DEBUG_KEYS = frozenset((topics.COSTMAP.key, topics.ROLLOUTS.key, topics.GRAPH.key))


def want(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """The topics that a page shows from now on."""
    wanted = frozenset(fields["keys"])
    unknown = sorted(wanted - frozenset(PAGE_KEYS))
    if unknown:
        yield note(service.now, page.client, "warning", f"{unknown[0]!r} is no topic of a page", "see keys of hello")
    page.keys, page.debug = wanted & frozenset(PAGE_KEYS), fields.get("debug", False)
    yield want_order(service.now, page.client, sorted(page.keys | (DEBUG_KEYS if page.debug else frozenset())))
    yield from service.watch()


def teleop(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """A command of a page that drives, or wants to."""
    if page.robot:
        raise FrameError("a page of a site does not drive by hand")
    if fields["n"] <= page.n:
        return
    command = service.driving.take(page.client, page.name, fields["v"], fields["w"], service.now)
    page.n = fields["n"]
    yield from teleop_out(command)


def let_go(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """A page drives no more."""
    yield from teleop_out(service.driving.let_go(page.client, service.now))


def stop(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """STOP. Any page may."""
    if page.robot:
        yield from _order_stop(service, page, [page.robot], True)
        return
    is_repeated = service.stop_button.is_pressing  # a page repeats it until it is confirmed
    yield topics.ESTOP(service.stop_button.set(True, page.name, service.now))
    if not is_repeated:
        yield audit(page, "STOP")


def release(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """Releases STOP. The robot stands until its next command."""
    if page.robot:
        yield from _order_stop(service, page, [page.robot], False)
        return
    yield topics.ESTOP(service.stop_button.set(False, page.name, service.now))
    yield audit(page, "release of STOP")


def stop_all(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """STOP of every robot that the page's process hears."""
    yield from _order_stop(service, page, None, True)


def ask(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """A request to a service."""
    row = request_named(fields["request"])
    if row is None:
        raise FrameError(f"{fields['request']!r} is no request of a page")
    needed = REQUEST_ROLES[row.key]
    if not may(page.role, needed):
        yield refusing_reply(service.now, page.client, fields["id"], "role", f"{row.key} needs the role {needed}")
        yield from _lines(refusal_line(page, row.key, service.now))
        return
    if page.robot and not row.crosses:
        yield refusing_reply(service.now, page.client, fields["id"], reasons.NOT_RUNNING.code, "it does not cross")
        return
    payload = request_payload(row, fields.get("args", {}), service.now)
    if text := request_text(row.key, fields.get("args", {})):
        yield audit(page, text)
    yield ask_order(service.now, page.client, fields["id"], row.key, payload)


def do(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """An operation of the tools."""
    op = fields["op"]
    values = fields.get("args", {})
    needed = operation_role(op, values) if op in OPERATION_ROLES else None
    if needed is not None and not may(page.role, needed):
        yield refusing_reply(service.now, page.client, fields["id"], "role", f"{op} needs the role {needed}")
        yield from _lines(refusal_line(page, op, service.now))
        return
    arguments = checked_operation(op, values)
    if op == "recording_mark":  # the log is recorded, so the mark is there
        yield Log("INFO", f"{MARK}{page.name}: {arguments['text']}")
        yield accepting_reply(service.now, page.client, fields["id"])
        return
    if text := operation_text(op, arguments):
        yield audit(page, text)
    yield do_order(service.now, page.client, fields["id"], op, arguments)


def name(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """The name that other users see. A page that has logged in has the name of its login."""
    if page.is_login:
        raise FrameError("the name is that of the login")
    page.name = fields["name"].strip() or f"page {page.client}"
    yield service.clients()


def ping(service: "DashboardService", page: PageSession, fields: dict[str, Any]) -> Out:
    """The time of a page's link."""
    yield frame(service.now, page.client, {"t": "pong", "id": fields["id"], "now": service.now})


def _order_stop(service: "DashboardService", page: PageSession, robots: list[str] | None, press: bool) -> Out:
    who = "all robots" if robots is None else ", ".join(robots)
    yield stop_order(service.now, page.client, robots, press, page.name)
    if service.now - page.stopped_at.get((who, press), 0) > STOP_LINES_NS:  # a page repeats it until it is confirmed
        page.stopped_at[who, press] = service.now
        yield audit(page, f"{'STOP' if press else 'release of STOP'} of {who}")


def _lines(line: Log | None) -> Out:
    if line is not None:
        yield line


def teleop_out(velocity: Velocity | None) -> Out:
    """A command by hand, where there is one."""
    if velocity is not None:
        yield topics.TELEOP(velocity)


FRAME_HANDLERS: dict[str, Callable[["DashboardService", PageSession, dict[str, Any]], Out]] = {
    "want": want,
    "teleop": teleop,
    "let_go": let_go,
    "stop": stop,
    "stop_all": stop_all,
    "release": release,
    "ask": ask,
    "do": do,
    "name": name,
    "ping": ping,
}
