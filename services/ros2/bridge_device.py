# SPDX-License-Identifier: Apache-2.0
"""The shell of the ROS 2 bridge: the device `zenoh://tcp/HOST:7447` behind the service's port.

It opens the session with the ROS 2 nodes, passes what comes in to the core, and takes the core's orders. Events and
orders are msgpack maps (docs in service.py).
"""

import threading
import time
from collections import Counter, deque
from typing import Any, cast

import msgpack

from services.ros2.action_topics import action_services, action_topics
from services.ros2.command_subscribers import CommandSubscribers
from services.ros2.config import Ros2Config
from services.ros2.incoming_topics import (
    CLEAR_SERVICES,
    CMD_VEL,
    ESTOP,
    INCOMING,
    MAP_SERVICES,
    STATE_SERVICES,
    TRIGGERS,
    IncomingTopic,
)
from services.ros2.outgoing_topics import DEFAULT, OUTGOING, STATIC_TF, OutgoingTopic
from services.ros2.rmw_names import Endpoint, Entity, Qos, RosName, mismatch_text
from services.ros2.robot_input import COMMAND, COMMAND_TYPES, ROBOT_TF, ROBOT_TOPICS, robot_topics
from services.ros2.ros_types import ros_types
from services.ros2.router_tls import router_tls
from services.ros2.zenav_command import run_command
from shared import topics
from shared.config import UserError
from shared.messages import PortState, SerialData
from shared.reasons import BUSY
from shared.runners.client import refusal
from shared.runners.devices import DeviceContext
from shared.topics import Publication

PORT = "ros"
ROBOT_NAMES = frozenset(row.name for row in ROBOT_TOPICS)
KIND = "zenoh"
AGAIN_S = 2.0  # between two tries to reach the router
LOOK_S = 0.5  # between two looks whether it is there
MIN_INTERVAL_S = 0.02  # between two messages of one topic for the core: 50 a second
"""A node that sends faster gets its newest message through, and the others are counted."""
ROBOT_INTERVAL_S = 0.004  # the same of a robot's sensors: some have odometry of 100 Hz, and messages come unevenly
N_TRANSFORMS = 16  # messages of /tf that wait: it has several publishers, and one of them has the odometry
N_TARGET = 4  # arguments that name robot and stack; the others are settings
N_KIND = 2  # words of a command that say what it does, as `map save`
MAX_KINDS = 100  # of rejections that one report distinguishes


def bridge_device(context: DeviceContext) -> "BridgeDevice":
    """The device of a configuration, not yet open. Raises UserError where its address or its files of TLS are none."""
    return BridgeDevice(context)


class BridgeDevice:
    """See the module. Its events are messages of topics.RX, and it takes those of topics.TX."""

    def __init__(self, context: DeviceContext) -> None:
        self._context = context
        self.endpoint = zenoh_endpoint(context.config.device)
        self._config = cast(Ros2Config, context.section)
        self._tls = router_tls(self.endpoint, self._config.tls)
        self._changed = threading.Condition()
        self._is_closing = False
        self._pending: dict[str, deque[dict[str, Any]]] = {}  # newest messages by name
        self._sent_at: dict[str, float] = {}
        self._counts: Counter[tuple[str, str]] = Counter()
        self._events: list[dict[str, Any]] = []
        self._orders: list[dict[str, Any]] = []
        self._running: set[tuple[str, ...]] = set()  # commands of zenav, without the map's name
        self._state: tuple[bool, str] | None = None
        self._endpoints: dict[tuple[str, Entity], list[tuple[RosName, Qos]]] = {}  # ours, by name and kind of theirs
        self._mismatches: set[str] = set()
        self._commands: dict[str, RosName] = {}  # publishers of velocity that a driven robot may want, by label
        self._subscribers = CommandSubscribers(self._commands)
        self._commanded: frozenset[str] = frozenset()  # labels of the publishers of velocity that are there
        self._thread = threading.Thread(target=self._run, name="ros2", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Orders of the core."""
        with self._changed:
            self._orders.append(msgpack.unpackb(data))
            self._changed.notify_all()

    def plug(self, plugged: bool) -> None:
        """There is nothing to unplug."""

    def close(self) -> None:
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(4.0)

    # --- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        from services.ros2.wire import RosWire, WireEvents  # Zenoh's extension, loaded with the first bridge

        config = self._config
        events = WireEvents(self._on_message, self._on_request, self._on_wanted, self._on_endpoint, self._on_rejected)
        while not self._is_closing:
            try:
                self._wire = RosWire(self.endpoint, self._tls, config.ros_format, events)
            except UserError as error:
                self._publish_state(False, f"{error.what}: {error.hint}")
                with self._changed:
                    self._changed.wait_for(lambda: self._is_closing, AGAIN_S)
                continue
            self._serve()
            return

    def _serve(self) -> None:
        from services.ros2.stack_feed import StackFeed

        context = self._context
        self._feed = StackFeed(
            self._config,
            context.robot,
            context.where,
            publish=self._publish_ros,
            on_teleop=self._on_teleop,
            on_rejected=self._on_rejected,
        )
        self._declare()
        self._publish_state(True, "")
        self._feed.start()
        look_at = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(self._has_work, min(map(_interval, self._pending), default=LOOK_S))
                is_closing, orders, self._orders = self._is_closing, self._orders, []
                events, self._events = self._events, []
                commanded = self._subscribers.labels
            self._advertise_commands(commanded)
            for order in orders:
                if not is_closing or "publish" in order:  # the last velocity of a driven robot is zero
                    self._obey(order)
            if is_closing:
                break
            now = time.monotonic()
            events += self._due_messages(now)
            if now >= look_at:
                look_at = now + LOOK_S
                events += self._report()
                is_there = self._wire.is_connected
                self._publish_state(is_there, "" if is_there else f"the router at {self.endpoint} is away")
            self._publish_events(events)
        self._feed.close()
        self._wire.close()

    def _has_work(self) -> bool:
        now = time.monotonic()
        is_told = bool(self._orders or self._events) or self._subscribers.labels != self._commanded
        return self._is_closing or is_told or any(self._is_due(name, now) for name in self._pending)

    def _is_due(self, name: str, now: float) -> bool:
        return now - self._sent_at.get(name, float("-inf")) >= _interval(name)

    def _declare(self) -> None:
        """Everything that our node has in ROS 2."""
        config, ros_name = self._config, self._ros_name
        rows = [(row.name, row.type, row.qos) for row in published_rows(config.drives)]
        rows += [(row.name, row.type, row.qos) for row in action_topics(config.distro)]
        self._own = {config.name(name): name for name, _, _ in rows}
        if config.drives:
            self._commands |= {label: ros_name(label, type_) for label, type_ in COMMAND_TYPES.items()}
            self._own[config.name(COMMAND)] = COMMAND
            self._endpoints[COMMAND, Entity.SUBSCRIPTION] = [(topic, DEFAULT) for topic in self._commands.values()]
        for row in received_rows(config):
            self._own[config.name(row.name)] = row.name
            received = tuple(ros_name(row.name, type_) for type_ in row.types)
            self._endpoints[row.name, Entity.PUBLISHER] = [(topic, row.qos) for topic in received]
            self._wire.subscribe(config.name(row.name), received, row.qos)
        for name, type_, qos in rows:
            topic = ros_name(name, type_)
            self._endpoints[name, Entity.SUBSCRIPTION] = [(topic, qos)]
            self._wire.advertise(name, topic, qos)
        for name, type_ in (
            *TRIGGERS,
            *STATE_SERVICES,
            *MAP_SERVICES,
            *CLEAR_SERVICES,
            *action_services(config.distro),
        ):
            self._own[config.name(name)] = name
            self._wire.serve(ros_name(name, type_), is_urgent=name == ESTOP)
        self._wire.discover()

    def _ros_name(self, name: str, type_: str) -> RosName:
        return RosName(self._config.name(name), type_, ros_types(self._config.distro).hash_of(type_))

    def _advertise_commands(self, labels: frozenset[str]) -> None:
        """Publishers of velocity, of the types that have a subscriber."""
        for label in self._commanded - labels:
            self._wire.withdraw(label)
        for label in labels - self._commanded:
            self._wire.advertise(label, self._commands[label], DEFAULT)
        self._commanded = labels

    def _obey(self, order: dict[str, Any]) -> None:
        if "publish" in order:
            if order["publish"] not in self._commands or order["publish"] in self._commanded:
                self._wire.publish(order["publish"], order["data"])
        elif "reply" in order:
            self._wire.reply(order["reply"], order["data"])
        elif "tool" in order:
            self._start_tool(tuple(order["tool"]), order["id"])
        elif "ask" in order:
            number = order["id"]
            self._feed.ask(order["ask"], order["payload"], lambda outcome: self._on_outcome(number, outcome))

    def _due_messages(self, now: float) -> list[dict[str, Any]]:
        due = []
        with self._changed:
            for name in list(self._pending):
                if self._is_due(name, now):
                    due += [{"event": "message", "name": name, **fields} for fields in self._pending.pop(name)]
                    self._sent_at[name] = now
        return due

    def _report(self) -> list[dict[str, Any]]:
        with self._changed:
            counts, self._counts = self._counts, Counter()
        return [{"event": "rejected", "name": name, "text": text, "n": n} for (name, text), n in counts.items()]

    def _publish_ros(self, name: str, data: bytes) -> None:
        """On the feed's thread."""
        self._wire.publish(name, data)

    # --- on threads of Zenoh's, of the feed and of requests ---------------------------------------------------------

    def _on_message(self, name: str, type_: str, data: bytes, gid: bytes, sent: int, came: int) -> None:
        own = self._own.get(name, name)
        with self._changed:
            waiting = self._pending.setdefault(own, deque(maxlen=N_TRANSFORMS if own == ROBOT_TF else 1))
            if len(waiting) == waiting.maxlen:
                self._count(own, f"faster than {1 / _interval(own):.0f} a second: the newest counts")
            waiting.append({"type": type_, "data": data, "gid": gid, "sent": sent, "came": came})
            self._changed.notify_all()

    def _on_request(self, name: str, number: int, data: bytes) -> None:
        self._file({"event": "request", "name": self._own[name], "id": number, "data": data})

    def _on_wanted(self, name: str, is_wanted: bool) -> None:
        if any(row.name == name for row in OUTGOING):
            self._feed.want(name, is_wanted)

    def _on_endpoint(self, token: str, endpoint: Endpoint, is_there: bool) -> None:
        """Another node's publisher or subscription came or went. What does not match ours is reported once."""
        with self._changed:
            self._subscribers.update(token, endpoint, is_there)
            self._changed.notify_all()
        own = self._own.get(endpoint.topic.name)
        if own is None or not is_there:
            return
        if own == CMD_VEL and endpoint.entity is Entity.PUBLISHER:
            self._feed.need()
        ours = self._endpoints.get((own, endpoint.entity), [])
        texts = [mismatch_text(endpoint, topic, qos) for topic, qos in ours]
        is_new = len(self._mismatches) < MAX_KINDS and texts[:1] != [] and texts[0] not in self._mismatches
        if is_new and all(texts):
            self._mismatches.add(texts[0])
            self._file({"event": "mismatch", "name": own, "text": texts[0]})

    def _on_rejected(self, name: str, text: str) -> None:
        with self._changed:
            self._count(self._own.get(name, name), text)

    def _on_teleop(self) -> None:
        self._file({"event": "other_teleop"})

    def _on_outcome(self, number: int, outcome: dict[str, Any]) -> None:
        self._file({"event": "outcome", "id": number, **outcome})

    def _start_tool(self, command: tuple[str, ...], number: int) -> None:
        """A command of zenav, on a thread of its own. Each is a process: a second one of its kind is refused."""
        with self._changed:
            is_running = command[:N_KIND] in self._running
            self._running.add(command[:N_KIND])
        if is_running:
            self._on_outcome(number, refusal(BUSY.code, BUSY.text, BUSY.hint))
        else:
            threading.Thread(target=self._run_tool, args=(command, number), daemon=True).start()

    def _run_tool(self, command: tuple[str, ...], number: int) -> None:
        try:
            error = run_command(*command, *self._context.arguments[:N_TARGET]).error
        finally:
            with self._changed:
                self._running.discard(command[:N_KIND])
        self._on_outcome(number, {"accepted": not error, "reason": "", "detail": error, "hint": ""})

    def _file(self, event: dict[str, Any]) -> None:
        with self._changed:
            self._events.append(event)
            self._changed.notify_all()

    def _count(self, name: str, text: str) -> None:
        if len(self._counts) >= MAX_KINDS and (name, text) not in self._counts:
            text = "other messages"
        self._counts[name, text] += 1

    def _publish_events(self, events: list[dict[str, Any]]) -> None:
        if events:
            data = b"".join(bytes(msgpack.packb(event)) for event in events)
            self._publish(topics.RX(SerialData(self._context.clock.now(), PORT, data)))

    def _publish_state(self, is_open: bool, detail: str) -> None:
        if self._state != (is_open, detail):
            self._state = is_open, detail
            self._publish(topics.PORT(PortState(self._context.clock.now(), PORT, is_open, detail)))

    def _publish(self, publication: Publication) -> None:
        self._context.publish(publication)


def _interval(name: str) -> float:
    """s between two messages of a topic for the core."""
    return ROBOT_INTERVAL_S if name in ROBOT_NAMES else MIN_INTERVAL_S


def published_rows(drives: bool) -> tuple[OutgoingTopic, ...]:
    """The topics of our node but for those of actions and of COMMAND_TYPES.

    drives: a robot with ROS 2, which has sensors of its own.
    """
    if not drives:
        return (*OUTGOING, STATIC_TF)
    return tuple(row for row in OUTGOING if row.name not in ROBOT_NAMES or row.name == ROBOT_TF)


def received_rows(config: Ros2Config) -> tuple[IncomingTopic, ...]:
    """The topics that our node subscribes to."""
    if not config.drives:
        return INCOMING
    return (*(row for row in INCOMING if row.name != CMD_VEL), *robot_topics(config))


def zenoh_endpoint(device: str) -> str:
    """Zenoh's endpoint of zenoh://tcp/HOST:7447. Raises UserError where it is none."""
    kind, _, endpoint = device.partition("://")
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if kind != KIND or not protocol or not host or not port.isdecimal():
        raise UserError(f"ros2.port.device: {device!r} is no router", "write zenoh://tcp/HOST:7447")
    return endpoint
