# SPDX-License-Identifier: Apache-2.0
"""The robot's link to a site: it decides which orders of the site the robot gets, and how much the site sees.

The shell (site_device.py) has the sessions with the stack and the site. Both directions of the port are streams of
msgpack maps. Each map of topics.RX has an `event` of the shell:

- `ask`: `id`, `key`, `data`: a request of the site; `estop`: `data`: STOP of the site, or its release;
- `sent`: `rate`, bytes/s to the site.

Orders on topics.TX: `level` (of outgoing.py), `ask` with `id` and `key` (pass it on to the stack), `reply` with `id`
and `data`. So the journal has every order of the site. What the robot sends to the site is no order, and is not in it.
"""

from typing import Any

import msgpack

from services.uplink.config import UplinkConfig
from services.uplink.order_age import MAX_AHEAD_NS, age_fault
from services.uplink.outgoing import Level
from shared import reasons, requests, topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.config import Robot
from shared.crossing import CROSSING_REQUESTS
from shared.event_maps import event_maps
from shared.messages import (
    EmergencyStop,
    GuardState,
    GuardStatus,
    Message,
    NavState,
    NavStatus,
    PortState,
    SerialData,
)
from shared.ports import PortConfig
from shared.reasons import Reason
from shared.recording_requests import FetchRecording, ListRecordings
from shared.rejections import RejectionCause
from shared.requests import Reply, Request, Watch
from shared.service import Answer, Log, Out, Service, answer, every, on
from shared.stop_button import StopButton
from shared.topics import Publication
from shared.types import NS_PER_S

PORT = "site"
AFTER_DRIVING_NS = 3 * NS_PER_S  # for which it counts as driving once it stands: the site sees how it ends
AT_REST = (NavState.IDLE, NavState.REACHED, NavState.FAILED, NavState.CANCELED)


class UplinkService(Service):
    """See the module."""

    config_type = UplinkConfig
    config: UplinkConfig

    def __init__(self, config: UplinkConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.stop_button = StopButton()
        self.level = Level.REST
        self.is_up, self.detail = False, ""
        self.rate = 0.0  # bytes/s to the site
        self.watched_until = 0  # ns
        self.drives_until = 0  # ns
        self.stopped_at = 0  # ns, when the newest STOP of the site was sent; at most MAX_AHEAD_NS ahead
        self.is_stopped = False

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    def state(self) -> str:
        if not self.is_up:
            return self.detail or "no link: set uplink.port.device"
        return f"linked, {self.level}: {self.rate / 1e3:.1f} kB/s to the site"

    # --- the robot ----------------------------------------------------------------------------------------------------

    @on(topics.NAV_STATUS)
    def nav_status(self, status: NavStatus) -> Out:
        """A task counts as driving."""
        if status.state not in AT_REST:
            self.drives_until = self.now + AFTER_DRIVING_NS
        return ()

    @on(topics.GUARD)
    def guard_status(self, status: GuardStatus) -> Out:
        """So does a command by hand. The status also confirms STOP."""
        self.stop_button.confirm(status)
        self.is_stopped = status.state is GuardState.STOPPED
        if status.state is GuardState.ACTIVE or status.source == "teleop":
            self.drives_until = self.now + AFTER_DRIVING_NS
        return ()

    @every(hz=10)
    def tick(self) -> Out:
        """Repeats STOP until it is confirmed, and changes the level."""
        stop, is_unconfirmed = self.stop_button.tick(self.now)
        if stop is not None:
            yield topics.ESTOP(stop)
        if is_unconfirmed:
            yield Log("ERROR", "the guard does not confirm the STOP of the site")
        yield from self._set_level()

    @answer(requests.WATCH_LINK)
    def watch(self, request: Watch) -> Answer[Reply]:
        """A page of the site shows this robot, for so long from now on."""
        yield from self._watch(request)
        refused = "" if self.is_up else reasons.NO_LINK.code
        return Reply(self.now, self.is_up, refused, "" if self.is_up else self.state())

    # --- the site -----------------------------------------------------------------------------------------------------

    @on(topics.PORT)
    def port_state(self, state: PortState) -> Out:
        """The shell has a link, or none."""
        if state.port != PORT:
            return
        if (self.is_up, self.detail) != (state.open, state.detail):
            yield Log("INFO" if state.open else "WARNING", f"site: {'linked' if state.open else state.detail}")
        self.is_up, self.detail, self.rate = state.open, state.detail, 0.0
        if not state.open:
            self.watched_until = 0  # a page asks again
        yield _order(self.now, {"level": str(self.level)})

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        """Takes events of the shell."""
        if data.port != PORT:
            return
        for event in event_maps(data.data):
            payload = event.get("data")
            match event.get("event"):
                case "ask" if type(event.get("id")) is int and type(payload) is bytes:
                    yield from self._ask(event["id"], str(event.get("key")), payload)
                case "estop" if type(payload) is bytes:
                    yield from self._estop(payload)
                case "sent" if type(event.get("rate")) is float:
                    self.rate = event["rate"]

    def _ask(self, id_: int, key: str, payload: bytes) -> Out:
        """Passes a request on, refuses it, or answers it."""
        row = next((row for row in CROSSING_REQUESTS if key in row.keys), None)
        if row is None:
            return
        try:
            request, envelope = decode(row.request, payload)
        except CodecError as error:
            yield from self._refuse(id_, row, reasons.BAD_REQUEST, str(error))
            return
        fault = age_fault(envelope.sent, self.now, self.config.max_order_age)
        if fault:
            self.rejections.count(row.key, RejectionCause.OLD, fault)
            yield from self._refuse(id_, row, reasons.EXPIRED, fault)
            yield Log("WARNING", f"audit: refused to the site: {row.key}, {fault}")
        elif row is requests.WATCH_LINK and isinstance(request, Watch):
            yield from self._watch(request)
            yield _reply(self.now, id_, Reply(self.now, True, "", ""))
        else:
            if row.request not in (ListRecordings, FetchRecording):
                yield Log("INFO", f"audit: the site asks {row.key} ({envelope.publisher} {envelope.session})")
            yield _order(self.now, {"ask": id_, "key": key})

    def _estop(self, payload: bytes) -> Out:
        """Takes STOP always. Its release only if it is recent, and was sent after the newest STOP.

        A STOP from far ahead counts as sent now: else no tool with a right clock could release it.
        """
        try:
            order, envelope = decode(EmergencyStop, payload)
        except CodecError as error:
            self.rejections.count(topics.ESTOP.key, RejectionCause.CONTENT, str(error))
            return
        by = f"site: {order.by}"
        if order.pressed:
            self.stopped_at = max(self.stopped_at, min(envelope.sent, self.now + MAX_AHEAD_NS))
            if not self.stop_button.is_pressing:
                if not self.is_stopped:
                    yield Log("INFO", f"audit: {by}: STOP")
                yield topics.ESTOP(self.stop_button.set(True, by, self.now))
            return
        fault = age_fault(envelope.sent, self.now, self.config.max_order_age)
        if not fault and min(envelope.sent, order.stamp) <= self.stopped_at:
            fault = "sent before the newest STOP"
        if fault:
            self.rejections.count(topics.ESTOP.key, RejectionCause.OLD, fault)
            yield Log("WARNING", f"audit: refused to the site: release of STOP, {fault}")
        elif self.stop_button.order is None or self.stop_button.order.pressed:
            if self.is_stopped:
                yield Log("INFO", f"audit: {by}: release of STOP")
            yield topics.ESTOP(self.stop_button.set(False, by, self.now))

    def _watch(self, request: Watch) -> Out:
        self.watched_until = self.now + round(request.seconds * NS_PER_S)
        yield from self._set_level()

    def _set_level(self) -> Out:
        level = Level.REST
        if self.watched_until - self.now > 0:
            level = Level.WATCHED
        elif self.drives_until - self.now > 0:
            level = Level.DRIVING
        if level is not self.level:
            self.level = level
            yield _order(self.now, {"level": str(level)})

    def _refuse(self, id_: int, row: Request[Any, Any], reason: Reason, detail: str) -> Out:
        yield _reply(self.now, id_, row.refusal(self.now, reason, detail))


def _reply(now: int, id_: int, reply: Message) -> Publication:
    return _order(now, {"reply": id_, "data": encode(reply, Envelope("uplink", "", 0, now))})


def _order(now: int, fields: dict[str, Any]) -> Publication:
    return topics.TX(SerialData(now, PORT, bytes(msgpack.packb(fields))))
