# SPDX-License-Identifier: Apache-2.0
"""`zenav foxglove`: the running stack on a Foxglove WebSocket, until Ctrl-C.

One loop sends messages to the clients, publishes the Commander's velocities, and reports silent services. It only reads
from the stack, except for the input that app.py accepts. A slow client loses messages, oldest first: the SDK has a
bounded queue for each. On a network it serves through the gate (gate.py).
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from ipaddress import ip_address
from pathlib import Path

import foxglove
from foxglove import StatusLevel
from foxglove.websocket import Capability, WebSocketServer

from shared import topics
from shared.codec import CodecError, envelope_of
from shared.config import Robot, UserError, load_robot
from shared.messages import MapUpdate, Velocity
from shared.runners.client import CLOCK_AGE
from shared.runners.inbox import Inbox, Slot
from shared.runners.transport import LatchedReader, stack_address
from shared.secure_folder import secure_folder
from shared.topics import topic_of
from shared.types import NS_PER_S
from zenav.client import Client
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.foxglove.app import App, Onlooker
from zenav.foxglove.channels import Channels
from zenav.foxglove.diagnostics import silent
from zenav.foxglove.gate import Gate, GateCredentials
from zenav.foxglove.schemas import MAP_ROW, STATE, MapPicture, rows_of

HERE = "127.0.0.1"
PERIOD = 0.05  # s between two commands, and two ticks of the clock
SILENT = 3.0  # s without health after which a service counts as silent: three are missing
ENDING = 2.0  # s within which a stack's services end one after the other
FIRST_WORD = 3.0  # s without any message after which the stack is reported as absent
BACKLOG = 128  # messages that wait for a slow client: under half a second of everything
WAITING = 64  # messages of a key that may wait for this loop
WATCH_EVERY, WATCH_FOR = 2.0, 10.0  # s: how often debug topics are asked for, and for how long
WATCHED = (topics.COSTMAP, topics.ROLLOUTS, topics.GRAPH)
EXPECTED = (
    topics.SCAN, topics.ODOM, topics.POSE, topics.PLAN, topics.GOAL, topics.NAV_STATUS, topics.GUARD, topics.LOG,
)  # fmt: skip
"""What clients may listen to before anything of it has come."""


def serve(robot: str, stack: str, host: str, port: int, certificate: Path | None, key: Path | None) -> None:
    """Serves until SIGINT or SIGTERM. Raises UserError where the port is taken, or the stack is named wrongly.

    certificate, key: PEM; without them the robot's own, if the host is an address of a network.
    """
    described = load_robot(robot).robot
    credentials = gate_credentials(host, certificate, key)
    with (
        stop_on_signal() as stop,
        Client(described.name, stack_address(stack)) as client,
        live_view(client, described, host, port, credentials) as view,
    ):
        address = f"ws://{host}:{view.port}" if credentials is None else f"wss://{host}:{view.port}/?token=TOKEN"
        sys.stderr.write(f"{described.name} is at {address}: in Foxglove, open a Foxglove WebSocket\n")
        view.run(stop)


def gate_credentials(host: str, certificate: Path | None, key: Path | None) -> GateCredentials | None:
    """What a server on a host's address serves with; None on loopback without a certificate.

    Raises UserError where an address of a network has no certificate.
    """
    if (certificate is None) != (key is None):
        raise UserError("a certificate and its key belong together", "give --cert FILE and --key FILE, or neither")
    if certificate is None and _is_loopback(host):
        return None
    folder = secure_folder().require()
    return GateCredentials(folder, certificate or folder.robot_certificate, key or folder.robot_key)


@contextmanager
def live_view(
    client: Client, robot: Robot, host: str, port: int, credentials: GateCredentials | None = None
) -> Iterator["LiveView"]:
    """A server on a port (0: any free one) that shows an open client's stack; `run` feeds it. Raises UserError.

    credentials: it then serves TLS, and each client gives a token.
    """
    view = LiveView(client, robot, credentials)
    try:
        view.open(host, port)
        yield view
    finally:
        view.close()


class LiveView:
    """See `live`."""

    def __init__(self, client: Client, robot: Robot, credentials: GateCredentials | None) -> None:
        self.client = client
        self.port = 0
        self._credentials = credentials
        self._context = foxglove.Context()
        self._channels = Channels(self._context, robot)
        self._app = App(client, self._say, self._channels.ask)
        self._servers: list[WebSocketServer] = []
        self._gate: Gate | None = None
        self._inbox = Inbox()
        self._places: dict[str, Slot] = {}
        self._picture = MapPicture()
        self._map: MapUpdate | None = None
        self._health: dict[str, float] = {}  # monotonic s, by service
        self._missing: set[str] = set()
        self._there: bool | None = None
        self._begun = time.monotonic()
        self._watched = float("-inf")
        self._told = 0  # ns, the time that the app has
        self._driving = False

    def open(self, host: str, port: int) -> None:
        """Takes the port and listens to the stack. Raises UserError where the port cannot be had."""
        for row in (row for topic in (*EXPECTED, *WATCHED) for row in rows_of(topic.key)):
            self._channels.declare(row)
        self._channels.declare(MAP_ROW, lambda: self._picture.whole() if self._look() else None)
        try:
            self.port = self._listen(host, port)
        except (RuntimeError, OverflowError, ValueError, OSError) as error:
            why = str(error).rpartition(": ")[2]
            raise UserError(
                f"cannot listen on {host}:{port}: {why}", "another `zenav foxglove`? choose --port"
            ) from None
        self.client.follow(topics.MAP, topics.GUARD, topics.POSE)
        self.client.listen_raw("**", self._file)
        self._readers = [
            LatchedReader(self.client.session, f"{self.client.robot}/{key}", partial(self._file, key))
            for key in topics.LATCHED_KEYS
            if key != topics.MAP.key
        ]

    def _listen(self, host: str, port: int) -> int:
        """Starts the servers, and the gate before them; returns the port that clients reach."""
        if self._credentials is None:
            return self._start(host, port, operator=True)
        backends = self._start(HERE, 0, operator=False), self._start(HERE, 0, operator=True)
        self._gate = Gate(self._credentials, backends, self._say)
        return self._gate.open(host, port)

    def _start(self, host: str, port: int, operator: bool) -> int:
        """Starts a server of the SDK for operators, or for viewers (they can only look); returns its port."""
        input_ = [Capability.ClientPublish, Capability.Services] if operator else []
        server = foxglove.start_server(
            name=f"zenav {self.client.robot}",
            host=host,
            port=port,
            context=self._context,
            capabilities=[*input_, Capability.Time],
            supported_encodings=["json"],
            server_listener=self._app if operator else Onlooker(self._channels.ask),
            services=self._app.services() if operator else None,
            message_backlog_size=BACKLOG,
        )
        self._servers.append(server)
        return server.port

    def close(self) -> None:
        """Ends the server; a robot that is driven from it stands."""
        self._app.close()
        try:
            if self._driving:
                self.client.publish(topics.TELEOP(Velocity(self.client.now(), 0.0, 0.0, "")))
        finally:
            if self._gate is not None:
                self._gate.close()
            for server in self._servers:
                server.stop()

    def run(self, stop: StopFlag) -> None:
        """Serves until `stop` is set."""
        due = second = time.monotonic()
        while not stop.is_set():
            entry = self._inbox.take(max(0.0, min(due - time.monotonic(), PERIOD)))
            if entry is not None:
                place, payload = entry
                self._take(place.key, payload)
            now = time.monotonic()
            if now >= due:
                due = max(due + PERIOD, now)
                self._tick(now)
            if now >= second:
                second = now + 1.0
                self._look_around(now)

    # --- in -----------------------------------------------------------------------------------------------------------

    def _file(self, key: str, payload: bytes) -> None:
        """On Zenoh's thread: files, and returns."""
        if key == topics.TELEOP.key and self._is_anothers(payload):  # here: filed, our own next one would hide it
            self._app.commander.on_other_command(time.monotonic())
        place = self._places.get(key)
        if place is None:
            topic = topic_of(key)
            if topic is None or topic in (topics.MAP, topics.JOURNAL):
                return
            place = self._places[key] = self._inbox.slot(key, topic.keep, WAITING)
        self._inbox.file(place, payload)

    def _take(self, key: str, payload: bytes) -> None:
        family = key.rpartition("/")
        if family[0] == topics.HEALTH.key:
            self._health[family[2]] = time.monotonic()
        self._channels.show(key, payload)

    def _is_anothers(self, payload: bytes) -> bool:
        try:
            return envelope_of(payload).session != self.client.session_name
        except CodecError:
            return False

    # --- each tick, and each second -----------------------------------------------------------------------------------

    def _tick(self, now: float) -> None:
        command = self._app.commander.command(now)
        self._driving = command is not None and command != (0.0, 0.0)
        if command is not None:
            self.client.publish(topics.TELEOP(Velocity(self.client.now(), *command, "")))
        at = self._told = time_to_show(self.client.now(), self._told)
        for server in self._servers:
            server.broadcast_time(at)
        if self._channels.wanted(MAP_ROW.topic) and self._look():
            self._channels.send(MAP_ROW, self._picture.due(time.monotonic_ns()), at)
        self._channels.answer(at)
        watched = any(self._channels.wanted(row.topic) for topic in WATCHED for row in rows_of(topic.key))
        if watched and now - self._watched >= WATCH_EVERY:
            self._watched = now
            self._app.watch(WATCH_FOR)

    def _look(self) -> bool:
        """Takes the newest map into the picture; whether there is one."""
        newest = self.client.latest(topics.MAP)
        if newest is not None and newest is not self._map:
            self._map = newest
            self._picture.add(newest)
        return newest is not None

    def _look_around(self, now: float) -> None:
        """Reports services that fell silent, and a stack that is absent."""
        quiet = {name: now - received for name, received in self._health.items() if now - received > SILENT}
        at = self.client.now()
        for name, seconds in quiet.items():
            self._channels.send(STATE, silent(name, at, seconds), at)
        there = len(quiet) < len(self._health)
        # a stack that ends falls silent within a second or two: that is one line, not one a service
        missing = {name for name, seconds in quiet.items() if seconds > SILENT + ENDING} if there else set()
        for name in missing - self._missing:
            self._say(f"{name} is silent", True)
        for name in self._missing - missing if there else ():
            self._say(f"{name} is back", False)
        self._missing = missing
        if there != self._there and (there or now - self._begun >= FIRST_WORD):
            self._there = there
            text = "the stack is there" if there else "no stack answers: waiting for it (start one: zenav up)"
            self._say(text, not there)

    def _say(self, text: str, trouble: bool) -> None:
        """Shows a line on the terminal and to every client."""
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
        for server in self._servers:
            server.publish_status(text, StatusLevel.Warning if trouble else StatusLevel.Info)


def time_to_show(at: int, shown: int) -> int:
    """The time that clients get at `at` after they got `shown` (ns of the stack's clock).

    The client's clock runs on between the simulator's ticks, so a late tick sets it back. An app takes that for a seek.
    The time stands until the clock has caught up, unless it went back farther than a late tick can set it.
    """
    return shown if 0 < shown - at <= round(CLOCK_AGE * NS_PER_S) else at


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
