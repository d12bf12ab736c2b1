# SPDX-License-Identifier: Apache-2.0
"""What stands for the Foxglove app in tests: a client of its WebSocket protocol, subprotocol foxglove.sdk.v1."""

import json
import struct
import time
from base64 import b64decode
from collections.abc import Callable
from contextlib import ExitStack
from ssl import SSLContext
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from tests.protobuf import schema_of
from tests.websocket import WebSocketClient

SUBPROTOCOL = Subprotocol("foxglove.sdk.v1")
CLOSING = 0.5  # s that the server's goodbye may take: it stands behind what was not read
MESSAGE, TIME, SERVICE_RESPONSE = 1, 2, 3  # opcodes of the server's binary messages


class FakeApp:
    """One client. Everything that comes is kept: `messages` by topic as (log time, content), `statuses`, `times`."""

    def __init__(self, port: int, token: str = "", tls: SSLContext | None = None) -> None:
        """token, tls: for a server that serves TLS."""
        self._open = ExitStack()
        address = f"ws://127.0.0.1:{port}" if tls is None else f"wss://127.0.0.1:{port}/?token={token}"
        self.socket = self._open.enter_context(
            WebSocketClient(address, ssl=tls, subprotocols=[SUBPROTOCOL], max_size=None, close_timeout=CLOSING)
        )
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, int] = {}
        self.messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}
        self.statuses: list[str] = []
        self.times: list[int] = []
        self.answers: dict[int, dict[str, Any]] = {}
        self._subscribed: dict[int, str] = {}
        self._announced: dict[str, int] = {}
        self._n_calls = 0
        self.capabilities: list[str] | None = None
        self.until(lambda: self.capabilities is not None and (self.services or "services" not in self.capabilities))

    def __enter__(self) -> "FakeApp":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def until(self, holds: Callable[[], Any], seconds: float = 60.0, meanwhile: Callable[[], Any] | None = None) -> Any:
        """Receives until the condition holds; fails with the received statuses and channels."""
        limit = time.monotonic() + seconds
        while not (found := holds()):
            assert time.monotonic() < limit, (self.statuses, sorted(self.channels))
            if meanwhile is not None:
                meanwhile()
            self._receive(0.05)
        return found

    def subscribe(self, *topics: str) -> None:
        """Subscribes to topics, as soon as they are there."""
        for topic in topics:
            channel = self.until(lambda topic=topic: self.channels.get(topic))  # type: ignore[misc]
            number = len(self._subscribed) + 1
            self._subscribed[number] = topic
            subscription = {"id": number, "channelId": channel["id"]}
            self.socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))

    def last(self, topic: str) -> dict[str, Any] | None:
        found = self.messages.get(topic)
        return found[-1][1] if found else None

    def announce(self, topic: str, schema: str, encoding: str = "json") -> None:
        """Advertises a channel of the client's own."""
        number = self._announced[topic] = len(self._announced) + 1
        channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": schema}
        self.socket.send(json.dumps({"op": "advertise", "channels": [channel]}))

    def publish(self, topic: str, content: Any) -> None:
        """Sends on an advertised channel; bytes go as they are."""
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.socket.send(struct.pack("<BI", 1, self._announced[topic]) + data)

    def call(self, service: str, content: bytes = b"{}") -> dict[str, Any]:
        """The answer of a service; one with the key `failure` where the call failed."""
        self._n_calls += 1
        number = self._n_calls
        header = struct.pack("<BIII", 2, self.services.get(service, 1), number, 4)
        self.socket.send(header + b"json" + content)
        return dict(self.until(lambda: self.answers.get(number)))

    def told(self, words: str) -> bool:
        """Whether a status with these words came."""
        return any(words in status for status in self.statuses)

    def _receive(self, seconds: float) -> None:
        try:
            message = self.socket.recv(timeout=seconds)
        except TimeoutError:
            return
        except ConnectionClosed:
            raise AssertionError("the server closed the connection") from None
        if isinstance(message, str):
            self._hear(json.loads(message))
        elif message[0] == MESSAGE:
            number, at = struct.unpack_from("<IQ", message, 1)
            topic = self._subscribed[number]
            self.messages.setdefault(topic, []).append((at, self._decoded(topic, message[13:])))
        elif message[0] == TIME:
            self.times.append(struct.unpack_from("<Q", message, 1)[0])
        elif message[0] == SERVICE_RESPONSE:
            _, call, length = struct.unpack_from("<III", message, 1)
            self.answers[call] = json.loads(message[13 + length :])

    def _hear(self, message: dict[str, Any]) -> None:
        if message["op"] == "serverInfo":
            self.capabilities = message["capabilities"]
        elif message["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in message["channels"]}
        elif message["op"] == "advertiseServices":
            self.services |= {service["name"]: service["id"] for service in message["services"]}
        elif message["op"] == "status":
            self.statuses.append(message["message"])
        elif message["op"] == "serviceCallFailure":
            self.answers[message["callId"]] = {"failure": message["message"]}

    def _decoded(self, topic: str, data: bytes) -> dict[str, Any]:
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return dict(json.loads(data))
        return schema_of(b64decode(channel["schema"])).decode(channel["schemaName"], data)


def stamped(x: float, y: float, frame: str = "map", z: float = 0.0, w: float = 1.0) -> dict[str, Any]:
    """geometry_msgs/PoseStamped as the 3D panel sends it; z, w: of the orientation."""
    return {
        "header": {"seq": 0, "stamp": {"sec": 0, "nsec": 0}, "frame_id": frame},
        "pose": {"position": {"x": x, "y": y, "z": 0}, "orientation": {"x": 0, "y": 0, "z": z, "w": w}},
    }


def twist(v: float, w: float) -> dict[str, Any]:
    """geometry_msgs/Twist as the Teleop panel sends it."""
    return {"linear": {"x": v, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": w}}
