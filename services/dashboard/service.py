# SPDX-License-Identifier: Apache-2.0
"""The page's server: what pages send comes in on a port, what they show and what the shell shall do goes out on it.

Both directions are streams of msgpack maps. Each map of topics.RX has an `event` of the shell:

- `open` and `close` of a page (`client`; `name` and `role` of its login, `host`: its address);
- `frame`: `data` has the bytes of a frame (docs/page.md);
- `other_teleop`: another tool drives;
- what login_reports.py takes.

outgoing.py has the maps of topics.TX. So all commands of pages are in the journal.
"""

from typing import Any

from services.dashboard.audit import audit, refusal_line
from services.dashboard.config import DashboardConfig
from services.dashboard.field_checks import FrameError
from services.dashboard.frame_handlers import FRAME_HANDLERS, teleop_out
from services.dashboard.frames import checked_frame, request_payload, unpacked_frame
from services.dashboard.login_reports import LoginReports
from services.dashboard.outgoing import PORT, ask_order, frame, hello, note, refusing_reply
from services.dashboard.sessions import PageSession, PageSessions
from shared import reasons, requests, topics
from shared.config import Robot
from shared.event_maps import event_maps
from shared.messages import GuardStatus, PortState, SerialData, Velocity
from shared.ports import PortConfig
from shared.roles import FRAME_ROLES, Role, may
from shared.service import Log, Out, Service, every, on
from shared.stop_button import StopButton
from shared.teleop_arbiter import TeleopRefusedError
from shared.teleop_stream import TeleopStream
from shared.topics import Publication
from shared.types import NS_PER_S

WATCH_EVERY_NS = 2 * NS_PER_S
"""between two requests for debug topics."""
WATCH_FOR_S = 10.0
TELEOP_HOLD_S = 0.2
"""s after the last frame of a page at which the robot gets zero."""


class DashboardService(Service):
    """Decides what each page may do, which page drives, and what goes to which page."""

    config_type = DashboardConfig
    config: DashboardConfig

    def __init__(self, config: DashboardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.pages = PageSessions()
        self.driving = TeleopStream(TELEOP_HOLD_S)
        self.stop_button = StopButton()
        self.is_open, self.detail = False, ""
        self.source = ""  # of commands, in the guard
        self.watched_at: int | None = None  # ns, of the last request for debug topics
        self.shown_drivers: dict[str, Any] = {}
        self.audited_driver: PageSession | None = None
        self.reports = LoginReports()

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    def state(self) -> str:
        if not self.is_open:
            return self.detail or "no port: set dashboard.port.device"
        pages = f"{len(self.pages)} page{'' if len(self.pages) == 1 else 's'} open"
        return "; ".join((pages, *self.reports.detail(self.now)))

    @on(topics.PORT)
    def port_state(self, state: PortState) -> Out:
        """The shell listens, or cannot: then no page is open."""
        if state.port != PORT:
            return
        self.is_open, self.detail = state.open, state.detail
        if not state.open:
            for client in self.pages.clients:
                yield from self._close(client)
            if state.detail:
                yield Log("WARNING", f"page: {state.detail}")

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        """Takes events of the shell."""
        if data.port != PORT:
            return
        for event in event_maps(data.data):
            yield from self._event(event)
        yield from self._drivers()

    @on(topics.GUARD)
    def guard_status(self, status: GuardStatus) -> Out:
        """Takes the source of commands, and the guard's confirmation of STOP."""
        self.source = status.source
        self.stop_button.confirm(status)
        yield from self._drivers()

    @every(hz=20)
    def drive(self) -> Out:
        """Publishes the driver's command, zero after its end, and STOP until it is confirmed."""
        yield from teleop_out(self.driving.tick(self.now))
        stop, is_unconfirmed = self.stop_button.tick(self.now)
        if stop is not None:
            yield topics.ESTOP(stop)
        if is_unconfirmed:
            yield note(self.now, None, "error", "the guard does not confirm", "switch the robot off by hand")
        yield from self.watch()
        yield from self._drivers()

    def on_shutdown(self) -> Out:
        """A robot that a page drives stands."""
        if self.driving.arbiter.driver is not None:
            yield topics.TELEOP(Velocity(self.now, 0.0, 0.0, ""))

    # --- events -------------------------------------------------------------------------------------------------------

    def _event(self, event: dict[Any, Any]) -> Out:
        client, kind = event.get("client"), event.get("event")
        if kind == "other_teleop":
            self.driving.on_other_command(self.now)
        elif kind == "open" and type(client) is int:
            yield from self._open(client, event)
        elif kind == "close" and type(client) is int:
            yield from self._close(client)
        elif kind == "frame" and type(event.get("data")) is bytes:
            page = self.pages.get(client)
            if page is not None:
                yield from self._frame(page, event["data"])
        else:
            yield from self.reports.take(event, self.now)

    def _open(self, client: int, event: dict[Any, Any]) -> Out:
        given = event.get("role")
        role = Role(given) if given in tuple(Role) else None
        page = self.pages.open(client, str(event.get("host", "")), str(event.get("name", "")), role)
        page.robot = str(event.get("robot", "")) if self.config.fleet else ""
        version = str(event.get("version", ""))
        yield hello(self.now, page, self.robot, event.get("simulated") is True, version)
        yield self.clients()
        yield frame(self.now, client, {"t": "drivers", **self._drivers_now()})
        warning = self.reports.certificate_detail(self.now)
        if warning:
            yield note(self.now, client, "warning", warning, "zenav secure renew")

    def _close(self, client: int) -> Out:
        yield from teleop_out(self.driving.let_go(client, self.now))
        if self.pages.close(client):
            yield self.clients()

    def _frame(self, page: PageSession, data: bytes) -> Out:
        answered = None
        try:
            kind, values = unpacked_frame(data)
            answered = values.get("id") if kind in ("ask", "do") else None
            fields = checked_frame(kind, values)
            if not may(page.role, FRAME_ROLES[kind]):
                line = refusal_line(page, kind, self.now)
                if line is not None:
                    yield line
                raise FrameError(f"a {page.role} may not send {kind}")
            yield from FRAME_HANDLERS[kind](self, page, fields)
        except FrameError as error:
            if isinstance(answered, int | str):
                yield refusing_reply(self.now, page.client, answered, reasons.BAD_REQUEST.code, str(error))
            else:
                yield note(self.now, page.client, "error", str(error), "reload the page")
        except TeleopRefusedError as error:
            yield note(self.now, page.client, "warning", str(error), "ask the driver to let go, or press STOP")

    # --- what pages see -----------------------------------------------------------------------------------------------

    def watch(self) -> Out:
        """Repeats the requests for debug topics while a page shows them; at a site, that for what a page shows."""
        if not self.pages.is_watching and not (self.config.fleet and len(self.pages)):
            self.watched_at = None
        elif self.watched_at is None or not 0 <= self.now - self.watched_at < WATCH_EVERY_NS:
            self.watched_at = self.now
            for page in self.pages.of_each_robot():
                payload = request_payload(requests.WATCH_LINK, {"seconds": WATCH_FOR_S}, self.now)
                yield ask_order(self.now, page.client, None, requests.WATCH_LINK.key, payload)
            if self.config.fleet:
                return
            for row in (requests.WATCH, requests.WATCH_GRAPH):
                payload = request_payload(row, {"seconds": WATCH_FOR_S}, self.now)
                yield ask_order(self.now, None, None, row.key, payload)

    def _drivers_now(self) -> dict[str, Any]:
        driver = self.driving.arbiter.driver
        return {
            "driver": None if driver is None else {"client": driver.client, "name": driver.name},
            "other": self.driving.is_driven_elsewhere(self.now),
            "source": self.source,
        }

    def _drivers(self) -> Out:
        """Shows all pages which one drives, at changes, and the audit when that begins and ends."""
        driver, before = self.driving.arbiter.driver, self.audited_driver
        if (driver and driver.client) != (before and before.client):
            self.audited_driver = self.pages.get(driver.client) if driver else None
            for page, text in ((before, "teleop ends"), (self.audited_driver, "teleop begins")):
                if page is not None:
                    yield audit(page, text)
        shown = self._drivers_now()
        if len(self.pages) and shown != self.shown_drivers:
            yield frame(self.now, None, {"t": "drivers", **shown})
        self.shown_drivers = shown

    def clients(self) -> Publication:
        """Shows all pages the list of pages."""
        return frame(self.now, None, {"t": "clients", "clients": self.pages.listed()})
