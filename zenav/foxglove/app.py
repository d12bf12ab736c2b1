# SPDX-License-Identifier: Apache-2.0
"""Input of the app to the stack, through the requests and topics that `zenav goto`, `teleop` and `estop` use.

The SDK calls from threads of its own. Poses go to one worker, so that a slow answer blocks nothing. Velocities go to
the Commander, and the server's loop publishes them. A service call waits for its answer.
"""

import json
import queue
import threading
import time
from collections.abc import Callable
from math import degrees
from typing import Any

import zenoh
from foxglove import MessageSchema, Schema, Service, ServiceRequest, ServiceSchema
from foxglove.websocket import ChannelView, ClientChannel, ServerListener
from foxglove.websocket import Client as Viewer

from shared import requests, topics
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import MapMode
from shared.requests import Cancel, Explore, Navigate, Pause, Reply, StartMap, Watch
from shared.runners.stop_confirmation import confirm_stop
from zenav.client import Client
from zenav.client.navigation_client import refusal_error, target_text
from zenav.foxglove.commander import Commander
from zenav.foxglove.inbound import Inlet, InvalidMessageError, inlet_of, pose_from, velocity_from

Say = Callable[[str, bool], None]
"""Shows a line to the user; True: it is an error."""

WAITING = 8  # requests that may wait for the worker
REPEATED = 1.0  # s in which the same refusal of a channel is shown once

TRIGGER = {"type": "object", "title": "std_srvs/Trigger_Request", "properties": {}}
TRIGGERED = {
    "type": "object",
    "title": "std_srvs/Trigger_Response",
    "properties": {"success": {"type": "boolean"}, "message": {"type": "string"}},
}


class Onlooker(ServerListener):
    """Listens to the clients of a server that takes nothing from them."""

    def __init__(self, asked: Callable[[str], None]) -> None:
        """asked: gets the topic that a client begins to listen to."""
        self._asked = asked

    def on_subscribe(self, client: Viewer, channel: ChannelView) -> None:
        self._asked(channel.topic)


class App(Onlooker):
    """Listens to the clients of a server. `close` ends its worker."""

    def __init__(self, client: Client, say: Say, asked: Callable[[str], None]) -> None:
        super().__init__(asked)
        self.commander = Commander()
        self._client, self._say = client, say
        self._inlets: dict[tuple[int, int], Inlet] = {}
        self._told: dict[str, float] = {}
        self._work: queue.Queue[Callable[[], None] | None] = queue.Queue(WAITING)
        self._worker = threading.Thread(target=self._run, name="requests", daemon=True)
        self._worker.start()

    def close(self) -> None:
        """Ends the worker after what it is doing."""
        while True:
            try:
                self._work.put_nowait(None)
                return
            except queue.Full:
                self._forget_one()

    # --- the SDK's callbacks ----------------------------------------------------------------------------------------

    def on_client_advertise(self, client: Viewer, channel: ClientChannel) -> None:
        try:
            self._inlets[client.id, channel.id] = inlet_of(channel.topic, channel.encoding, channel.schema_name)
        except InvalidMessageError as error:
            self._refuse(client.id, str(error))

    def on_client_unadvertise(self, client: Viewer, client_channel_id: int) -> None:
        """A client has ended a channel, or is gone: the SDK says so for each of its channels."""
        inlet = self._inlets.pop((client.id, client_channel_id), None)
        if inlet is not None and inlet.what == "teleop":
            if self.commander.driver == client.id:
                self._say(f"client {client.id} let go: the robot stands", False)
            self.commander.remove_client(client.id, time.monotonic())

    def on_message_data(self, client: Viewer, client_channel_id: int, data: bytes) -> None:
        inlet = self._inlets.get((client.id, client_channel_id))
        try:
            if inlet is None:
                raise InvalidMessageError("a message on a channel that was refused")
            if inlet.what == "teleop":
                self._teleop(client.id, *velocity_from(inlet, data))
            else:
                pose = pose_from(inlet, data)
                self._later(client.id, lambda: (self._goal if inlet.what == "goal" else self._here)(client.id, pose))
        except InvalidMessageError as error:
            self._refuse(client.id, str(error))

    # --- what they do -----------------------------------------------------------------------------------------------

    def watch(self, seconds: float) -> None:
        """Asks for the debug topics for so long (the stack's s)."""

        def ask() -> None:
            for row in (requests.WATCH, requests.WATCH_GRAPH):
                self._client.ask(row, Watch(self._client.now(), seconds))

        try:
            self._work.put_nowait(ask)
        except queue.Full:
            return  # the next time is soon

    def services(self) -> list[Service]:
        """STOP, its release, and tasks, as std_srvs/Trigger in JSON. STOP waits for no other call."""
        client = self._client

        def stop(press: bool) -> str:
            confirm_stop(client, press, "zenav foxglove")
            return "STOP is pressed" if press else "STOP is released; the robot waits for a new goal"

        acts: dict[str, Callable[[], str]] = {
            "/estop": lambda: stop(True),
            "/estop_release": lambda: stop(False),
            "/explore": lambda: self._accepted(client.ask(requests.EXPLORE, Explore(client.now())), "exploring"),
            "/cancel": lambda: self._accepted(client.ask(requests.CANCEL, Cancel(client.now())), "canceled"),
            "/pause": lambda: self._accepted(client.ask(requests.PAUSE, Pause(client.now(), True)), "paused"),
            "/resume": lambda: self._accepted(client.ask(requests.PAUSE, Pause(client.now(), False)), "going on"),
        }
        return [Service(name, schema=_TRIGGER, handler=self._handler(name, act)) for name, act in acts.items()]

    def _handler(self, name: str, act: Callable[[], str]) -> Callable[[ServiceRequest], bytes]:
        def handle(request: ServiceRequest) -> bytes:
            try:
                tree = json.loads(request.payload or b"{}")
            except (ValueError, RecursionError):
                tree = None
            if not isinstance(tree, dict):
                raise InvalidMessageError(f"{name}: the request is no JSON object")
            try:
                answer = {"success": True, "message": act()}
                self._say(f"{name} by client {request.client_id}: {answer['message']}", False)
            except UserError as error:
                answer = {"success": False, "message": f"{error.what}: {error.hint}"}
                self._refuse(request.client_id, f"{name}: {error.what}")
            except zenoh.ZError as error:
                answer = {"success": False, "message": f"no connection to the stack: {error}"}
            return json.dumps(answer).encode()

        return handle

    def _teleop(self, client: int, v: float, w: float) -> None:
        new = self.commander.driver is None
        self.commander.request(client, v, w, time.monotonic())
        if new:
            self._say(f"client {client} drives by hand", False)

    def _goal(self, client: int, pose: Pose2) -> None:
        request = Navigate(self._client.now(), (pose,), 0.0, 1, False)
        reply = self._client.ask(requests.NAVIGATE, request)
        self._say(f"goal {_words(pose)} of client {client}: {self._accepted(reply, f'task {reply.task_id}')}", False)

    def _here(self, client: int, pose: Pose2) -> None:
        """The robot is here on the present map; a mapper that maps goes on mapping."""
        estimate = self._client.latest(topics.POSE)
        localises = estimate is not None and estimate.mode is MapMode.LOCALISE
        mode = MapMode.LOCALISE if localises else MapMode.CONTINUE
        reply = self._client.ask(requests.START_MAP, StartMap(self._client.now(), mode, 0, (pose,)), timeout=20.0)
        self._say(f"pose {_words(pose)} of client {client}: {self._accepted(reply, str(mode))}", False)

    def _accepted(self, reply: Reply, text: str) -> str:
        if not reply.accepted:
            raise refusal_error(reply)
        return text

    # --- the worker -------------------------------------------------------------------------------------------------

    def _later(self, client: int, act: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                act()
            except UserError as error:
                self._refuse(client, f"{error.what}: {error.hint}")

        try:
            self._work.put_nowait(guarded)
        except queue.Full:
            raise InvalidMessageError("too many requests at once") from None

    def _run(self) -> None:
        while (act := self._work.get()) is not None:
            try:
                act()
            except UserError:
                continue  # `watch`: no local control, no picture
            except zenoh.ZError as error:
                self._say(f"a request could not be sent: {error}", True)

    def _forget_one(self) -> None:
        try:
            self._work.get_nowait()
        except queue.Empty:
            return

    def _refuse(self, client: int, why: str) -> None:
        now = time.monotonic()
        if now - self._told.get(why, float("-inf")) >= REPEATED:
            self._told = {text: at for text, at in self._told.items() if now - at < REPEATED} | {why: now}
            self._say(f"refused from client {client}: {why}", True)


def _words(pose: Pose2) -> str:
    return target_text((pose.x, pose.y, degrees(pose.yaw)))


def _described(schema: dict[str, Any]) -> MessageSchema:
    text = json.dumps(schema).encode()
    return MessageSchema(encoding="json", schema=Schema(name=schema["title"], encoding="jsonschema", data=text))


_TRIGGER = ServiceSchema("std_srvs/Trigger", request=_described(TRIGGER), response=_described(TRIGGERED))
