# SPDX-License-Identifier: Apache-2.0
"""A router in this process, our bridge's shell, a stack that a test plays, and a ROS 2 node by Zenoh alone."""

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import zenoh

from services.ros2.bridge_device import BridgeDevice
from services.ros2.config import Ros2Config
from services.ros2.rmw_names import RosName, attachment, topic_key
from services.ros2.ros_types import RosTypes, ros_types
from shared.messages import PortState, SerialData
from shared.ports import PortConfig
from shared.ros_messages import RosMessages
from shared.runners.client import Client
from shared.runners.clock import clock_from
from shared.runners.devices import DeviceContext
from shared.topics import Publication
from zenav.stack.launch import free_stack

ROBOT, LIMIT_S = "x80sv", 10.0
GID = bytes(range(16))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def session(mode: str, port: int, listens: bool = False, protocol: str = "tcp", **settings: Any) -> zenoh.Session:
    config = zenoh.Config()
    endpoints = [f"{protocol}/127.0.0.1:{port}"]
    for key, value in {
        "mode": mode,
        "listen/endpoints": endpoints if listens else [],
        "connect/endpoints": [] if listens else endpoints,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
        **settings,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def router(port: int, protocol: str = "tcp", **settings: Any) -> Iterator[zenoh.Session]:
    with session("router", port, listens=True, protocol=protocol, **settings) as opened:
        yield opened


class Bridge:
    """The shell of the bridge, with what it gave to the core, and the stack that it listens to."""

    def __init__(self, port: int, where: Any, protocol: str = "tcp", **section: Any) -> None:
        device = f"zenoh://{protocol}/127.0.0.1:{port}"
        self.config = Ros2Config(port=PortConfig(device=device), **section)
        self.types = ros_types(self.config.distro)
        self.make = RosMessages(self.types.types, self.config.ros_frames)
        self.events: list[dict[str, Any]] = []
        self.states: list[tuple[bool, str]] = []
        self._changed = threading.Condition()
        context = DeviceContext(
            port="ros", config=self.config.port, section=self.config, robot=ROBOT, where=where,
            arguments=("--robot", ROBOT, "--stack", str(where.domain if where else 0)),
            clock=clock_from(""), publish=self._take,
        )  # fmt: skip
        self.device = BridgeDevice(context)

    def order(self, **fields: Any) -> None:
        self.device.write(msgpack.packb(fields))

    def wait(self, holds: Callable[[], Any], limit: float = LIMIT_S) -> Any:
        with self._changed:
            found = self._changed.wait_for(holds, limit)
        assert found, (self.events[-5:], self.states)
        return found

    def wait_open(self) -> None:
        self.wait(lambda: self.states and self.states[-1][0])

    def wait_event(self, kind: str, limit: float = LIMIT_S) -> dict[str, Any]:
        found = self.wait(lambda: [event for event in self.events if event["event"] == kind], limit)
        return found[0]

    def _take(self, publication: Publication) -> None:
        message = publication.message
        with self._changed:
            if isinstance(message, PortState):
                self.states.append((message.open, message.detail))
            if isinstance(message, SerialData):
                self.events += msgpack_maps(message.data)
            self._changed.notify_all()


def msgpack_maps(data: bytes) -> list[dict[str, Any]]:
    unpacker = msgpack.Unpacker()
    unpacker.feed(data)
    return list(unpacker)


@contextmanager
def bridged(**section: Any) -> "Iterator[tuple[Bridge, Client, RosPeer]]":
    """An open bridge, the stack that a test plays, and a ROS 2 node."""
    port = free_port()
    with router(port), free_stack() as claim, Client(ROBOT, claim.where, instead_of="mapper") as stack:
        bridge = Bridge(port, claim.where, **section)
        bridge.device.start()
        try:
            bridge.wait_open()
            with session("client", port) as opened:
                yield bridge, stack, RosPeer(opened, bridge.types, bridge.config.domain)
        finally:
            bridge.device.close()


class RosPeer:
    """A ROS 2 node by Zenoh alone."""

    def __init__(self, opened: zenoh.Session, types: RosTypes, domain: int = 0) -> None:
        self.session, self._types, self._domain = opened, types, domain
        self.received: list[zenoh.Sample] = []
        self._changed = threading.Condition()
        self._declared: list[Any] = []

    def tokens(self) -> list[str]:
        replies = self.session.liveliness().get(f"@ros2_lv/{self._domain}/**", timeout=5.0)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def key(self, name: str, type_: str) -> str:
        return topic_key(self._domain, RosName(name, type_, self._types.hash_of(type_)))

    def subscribe(self, name: str, type_: str) -> None:
        self._declared.append(self.session.declare_subscriber(self.key(name, type_), self._file))

    def wait(
        self, type_: str, holds: Callable[[Any], bool] = lambda message: True, limit: float = LIMIT_S
    ) -> tuple[Any, zenoh.Sample]:
        """The first message of this type for which the condition holds."""

        def first() -> tuple[Any, zenoh.Sample] | None:
            for sample in self.received:
                if f"::{type_.rsplit('/', 1)[1]}_/" in str(sample.key_expr):
                    message = self._types.decode(sample.payload.to_bytes(), type_)
                    if holds(message):
                        return message, sample
            return None

        with self._changed:
            found = self._changed.wait_for(first, limit)
        assert found, f"no {type_}"
        return found

    def publish(self, name: str, message: Any, number: int = 1) -> None:
        key = self.key(name, message.__msgtype__)
        data, block = self._types.encode(message), zenoh.CongestionControl.BLOCK  # Zenoh drops by default
        self.session.put(key, data, attachment=attachment(number, 5, GID), congestion_control=block)

    def call(self, name: str, type_: str, request: Any, limit: float = LIMIT_S) -> tuple[Any, bytes]:
        """Response and attachment."""
        replies = self.session.get(
            self.key(name, type_), payload=self._types.encode(request), attachment=attachment(7, 5, GID),
            timeout=limit, target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE,
        )  # fmt: skip
        [reply] = list(replies)
        assert reply.ok is not None
        return self._types.decode(reply.ok.payload.to_bytes(), f"{type_}_Response"), reply.ok.attachment.to_bytes()

    def _file(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self.received.append(sample)
            self._changed.notify_all()


def repeated(stack: Client, publication_of: Callable[[], Publication], wait: Callable[[float], Any]) -> Any:
    """Publishes again and again until what is waited for (s) is there: a subscription of the bridge takes a moment."""
    for _ in range(100):
        stack.publish(publication_of())
        try:
            if found := wait(0.1):
                return found
        except AssertionError:
            continue
    return wait(1.0)
