# SPDX-License-Identifier: Apache-2.0
"""The stack's messages on their way to ROS: listens only to what a ROS node subscribes to, converts, and publishes.

It has a thread and a session with the stack of its own. The session is opened when it is needed for the first time.
"""

import threading
from collections.abc import Callable
from typing import Any

from services.ros2.config import Ros2Config
from services.ros2.outgoing_markers import place_markers
from services.ros2.outgoing_topics import (
    MAP_NAME,
    PLACES_NAME,
    WATCHED,
    OutgoingState,
    WatchRequest,
    converted,
    keys_of,
)
from services.ros2.ros_types import ros_types
from services.ros2.zenav_command import saved_places
from shared import requests, topics
from shared.codec import CodecError, Envelope, decode, envelope_of
from shared.config import UserError
from shared.reasons import NOT_RUNNING
from shared.requests import REQUESTS, Watch
from shared.ros_messages import RosMessages
from shared.runners.client import Client, refusal, request_outcome
from shared.runners.transport import LatchedReader, StackAddress, oversize
from shared.stamps import is_known
from shared.topics import topic_of
from shared.types import NS_PER_S

PERIOD_S = 0.2  # between two looks whether the map is due
WATCH_EVERY_NS, WATCH_FOR_S = 2 * NS_PER_S, 10.0
ASK_LIMIT_S, MAP_LIMIT_S = 5.0, 20.0
AGAIN_S = 2.0  # between two tries to reach the stack
PLACES_AGAIN_NS = 60 * NS_PER_S  # after which the places are read again: a process of its own, for the files of the map
Payload = tuple[str, bytes, bool]
"""Key, bytes, and whether it is the value for late subscribers."""


class StackFeed:
    """See the module. publish: sends CDR under a name of OUTGOING.  on_teleop: called while another tool drives.

    on_rejected: called with a name of OUTGOING, and why a message does not go out.
    """

    def __init__(
        self,
        config: Ros2Config,
        robot: str,
        where: StackAddress,
        publish: Callable[[str, bytes], None],
        on_teleop: Callable[[], None],
        on_rejected: Callable[[str, str], None],
    ) -> None:
        self._robot, self._where, self._publish, self._on_teleop = robot, where, publish, on_teleop
        self._on_rejected = on_rejected
        self._types = ros_types(config.distro)
        make = RosMessages(self._types.types, config.stack_frames)
        robot_odom = config.ros_frames.odom if config.drives else ""
        self._state = OutgoingState(make, round(config.map_interval * NS_PER_S), robot_odom)
        self._wanted: frozenset[str] = frozenset()
        self._served: frozenset[str] = frozenset()
        self._client: Client | None = None
        self._endings: dict[str, list[Callable[[], None]]] = {}  # by key
        self._latched: dict[str, tuple[Any, Envelope]] = {}  # newest message by key
        self._incoming: list[Payload] = []
        self._changed = threading.Condition()
        self._is_closing = self._is_needed = False
        self._watched_at: dict[WatchRequest, int] = {}  # ns
        self._places_read: tuple[str, int] | None = None  # name of the map, and when, ns
        self._places_thread: threading.Thread | None = None
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def start(self) -> None:
        """Begins to work."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread and the session."""
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        self._thread.join(2.0)

    def want(self, name: str, is_wanted: bool) -> None:
        """Whether a ROS node subscribes to a topic of OUTGOING. From any thread."""
        with self._changed:
            self._wanted = self._wanted | {name} if is_wanted else self._wanted - {name}
            self._is_needed |= is_wanted
            self._changed.notify_all()

    def need(self) -> None:
        """A ROS node may drive the robot: other tools that do so are listened to from now on. From any thread."""
        with self._changed:
            self._is_needed = True
            self._changed.notify_all()

    def ask(self, key: str, payload: bytes, done: Callable[[dict[str, Any]], None]) -> None:
        """Sends a request to a service of the stack, on a thread of its own; `done` gets its outcome."""
        threading.Thread(target=self._ask, args=(key, payload, done), daemon=True).start()

    # --- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_work, PERIOD_S if self._wanted else None)
                if self._is_closing:
                    break
                incoming, self._incoming = self._incoming, []
                wanted = self._wanted
            if self._client is None and self._is_needed and not self._open():
                with self._changed:
                    self._changed.wait_for(lambda: self._is_closing, AGAIN_S)
                continue
            if wanted != self._served:
                self._serve(wanted)
            if self._client is not None:
                self._take(self._client, incoming)
            self._tick()
        if self._client is not None:
            self._client.__exit__(None, None, None)

    def _has_work(self) -> bool:
        has_session_to_open = self._is_needed and self._client is None
        return self._is_closing or bool(self._incoming) or self._wanted != self._served or has_session_to_open

    def _open(self) -> bool:
        client = Client(self._robot, self._where)
        try:
            client.__enter__()
        except UserError:  # the stack's router is away
            return False
        client.listen_raw(topics.TELEOP.key, self._hear_teleop)
        with self._changed:
            self._client = client
            self._changed.notify_all()
        return True

    def _serve(self, wanted: frozenset[str]) -> None:
        """Listens to what these topics need, and gives new ones what is known already."""
        assert self._client is not None
        added, self._served = wanted - self._served, wanted
        keys = keys_of(wanted)
        for key in self._endings.keys() - keys:
            for end in self._endings.pop(key):
                end()
            self._latched.pop(key, None)
        for key in keys - self._endings.keys():
            self._endings[key] = self._listen(self._client, key)
        for key, (message, envelope) in list(self._latched.items()):
            self._convert(added, key, message, envelope.publisher)
        if MAP_NAME in added:
            self._state.map.send_now()
        if PLACES_NAME in added:
            self._places_read = None

    def _listen(self, client: Client, key: str) -> list[Callable[[], None]]:
        end = client.listen_raw(key, lambda key, payload: self._file(key, payload, False))
        topic = topic_of(key)
        if topic is None or not topic.latched:
            return [end]
        reader = LatchedReader(client.session, f"{self._robot}/{key}", lambda payload: self._file(key, payload, True))
        return [end, reader.close]

    def _file(self, key: str, payload: bytes, is_latched: bool) -> None:
        """On a thread of Zenoh's. Of a topic that keeps the latest message an unread one is replaced."""
        if oversize(payload):
            return
        topic = topic_of(key)
        with self._changed:
            if topic is not None and topic.keep == "latest":
                self._incoming = [row for row in self._incoming if row[0] != key or (is_latched and not row[2])]
            self._incoming.append((key, payload, is_latched))
            self._changed.notify_all()

    def _take(self, client: Client, incoming: list[Payload]) -> None:
        for key, payload, is_latched in incoming:
            topic = topic_of(key)
            if topic is None:
                continue
            try:
                message, envelope = decode(topic.type, payload)
            except CodecError:
                continue  # its readers among the services count and report it
            if is_latched and key in self._latched and is_known(envelope, self._latched[key][1], client.now()):
                continue  # a newer message came before the value for late subscribers
            if topic.latched and topic is not topics.MAP:
                self._latched[key] = message, envelope
            self._convert(self._served, key, message, envelope.publisher)

    def _convert(self, names: frozenset[str], key: str, message: Any, publisher: str) -> None:
        topic = topic_of(key)
        if topic is not None:
            for name, made in converted(self._state, names, topic, message, publisher):
                self._send(name, made)

    def _send(self, name: str, made: Any) -> None:
        """A message of ROS. One that its type cannot hold is left out."""
        try:
            data = self._types.encode(made)
        except ValueError as error:
            self._on_rejected(name, str(error))
            return
        self._publish(name, data)

    def _tick(self) -> None:
        if self._client is None:
            return
        now = self._client.now()
        if MAP_NAME in self._served:
            grid = self._state.map.due(now)
            if grid is not None:
                self._send(MAP_NAME, grid)
        if PLACES_NAME in self._served:
            self._read_places(now)
        rows = {WATCHED[key] for key in WATCHED.keys() & self._endings.keys()}
        self._watched_at = {row: at for row, at in self._watched_at.items() if row in rows}
        for row in rows:
            if not 0 <= now - self._watched_at.get(row, -WATCH_EVERY_NS) < WATCH_EVERY_NS:
                self._watched_at[row] = now
                arguments = (self._client, row, Watch(now, WATCH_FOR_S))
                threading.Thread(target=self._watch, args=arguments, daemon=True).start()

    def _read_places(self, now: int) -> None:
        """Sends the places where the map has another name, and again after a while."""
        name, before = self._state.map_name, self._places_read
        if name is None or (self._places_thread is not None and self._places_thread.is_alive()):
            return
        if before is None or before[0] != name or not 0 <= now - before[1] < PLACES_AGAIN_NS:
            self._places_read = name, now
            self._places_thread = threading.Thread(target=self._send_places, args=(name, now), daemon=True)
            self._places_thread.start()

    def _send_places(self, map_name: str, now: int) -> None:
        self._send(PLACES_NAME, place_markers(self._state.make, saved_places(map_name), now))

    def _watch(self, client: Client, row: WatchRequest, request: Watch) -> None:
        try:
            client.ask(row, request, ASK_LIMIT_S)
        except UserError:
            return  # no such service, no costmap

    def _ask(self, key: str, payload: bytes, done: Callable[[dict[str, Any]], None]) -> None:
        self.need()
        row = next((row for row in REQUESTS if row.key == key), None)
        client = self._waited_client()
        if row is None or client is None:
            done(refusal(NOT_RUNNING.code, "no connection to the stack", NOT_RUNNING.hint))
            return
        done(request_outcome(client, row, payload, MAP_LIMIT_S if row is requests.START_MAP else ASK_LIMIT_S))

    def _waited_client(self) -> Client | None:
        with self._changed:
            self._changed.wait_for(lambda: self._client is not None or self._is_closing, ASK_LIMIT_S)
            return self._client

    def _hear_teleop(self, key: str, payload: bytes) -> None:
        try:
            is_other = envelope_of(payload).publisher != "ros2"
        except CodecError:
            return
        if is_other:
            self._on_teleop()
