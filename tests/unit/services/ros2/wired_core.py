# SPDX-License-Identifier: Apache-2.0
"""The bridge's shell with its core, without processes, and nodes of ROS 2 whose keys are written out by hand."""

import threading
import time
from collections.abc import Callable
from typing import Any

import msgpack
import zenoh

from services.ros2.rmw_names import attachment
from services.ros2.ros_types import Distro, RosTypes
from services.ros2.service import Ros2Service
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Message, NavState, NavStatus, PortState, SerialData, Velocity
from shared.service import Out
from shared.topics import Publication
from tests.unit.services.ros2.network import GID, LIMIT_S, ROBOT, Bridge

TASK = 7


class WiredCore(Bridge):
    """The shell gives its events to a core, and the core's orders go to the shell. hear: takes the core's messages.

    The navigator is played: it accepts each request.
    """

    def __init__(self, port: int, hear: Callable[["WiredCore", Message], None], **section: Any) -> None:
        super().__init__(port, None, **section)
        self.service = Ros2Service(self.config, load_robot(ROBOT).robot)
        self.service.name = "ros2"
        self.asked: list[str] = []
        self._hear, self._core, self._is_ended = hear, threading.RLock(), False

    def command(self, v: float, w: float = 0.0) -> None:
        """A velocity of base_driver."""
        with self._core:
            self._pass_on(self.service.velocity(Velocity(self.service.now, v, w, "")))

    def end(self) -> None:
        """The bridge's end, as its runner brings it about."""
        with self._core:
            self._pass_on(self.service.on_shutdown())
            self._is_ended = True
        self.device.close()

    def status(self, state: NavState, left: float = 0.0) -> None:
        """A status of the navigator about the task that it accepted."""
        with self._core:
            self.service.now = time.time_ns()
            status = NavStatus(self.service.now, TASK, state, "", "", "", Pose2(), left, 1.0, 0, 1, 0)
            self._pass_on(self.service.nav_status(status))

    def _take(self, publication: Publication) -> None:
        super()._take(publication)
        with self._core:
            if self._is_ended:
                return
            self.service.now = time.time_ns()
            message = publication.message
            if isinstance(message, PortState):
                self._pass_on(self.service.port_state(message))
            elif isinstance(message, SerialData):
                self._pass_on(self.service.receive(message))

    def _pass_on(self, out: Out) -> None:
        for item in out:
            if not isinstance(item, Publication):
                continue
            if item.topic is not topics.TX:
                self._hear(self, item.message)
                continue
            order = msgpack.unpackb(item.message.data)
            if "ask" not in order:
                self.device.write(item.message.data)
                continue
            self.asked.append(order["ask"])
            outcome = {"accepted": True, "reason": "", "detail": "", "hint": "", "data": {"task_id": TASK}}
            event = {"event": "outcome", "id": order["id"], **outcome}
            self._pass_on(self.service.receive(SerialData(self.service.now, "ros", msgpack.packb(event))))


class Node:
    """A node of a distribution, on rmw_zenoh or behind zenoh-bridge-ros2dds. Keys are as their sources have them."""

    def __init__(self, opened: zenoh.Session, types: RosTypes, bridge: str) -> None:
        self.session, self.types, self.bridge = opened, types, bridge
        self._n = 0

    def key(self, name: str, type_: str) -> str:
        if self.bridge == "dds":
            return name[1:]
        package, kind, short = type_.split("/")
        known = self.types.hash_of(type_) if self.types.distro is not Distro.HUMBLE else "TypeHashNotSupported"
        return f"0{name}/{package}::{kind}::dds_::{short}_/{known}"

    def publish(self, name: str, message: Any) -> None:
        self.session.put(
            self.key(name, message.__msgtype__), self.types.encode(message), attachment=self._attachment(),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )  # fmt: skip

    def subscribe(self, name: str, type_: str, hear: Callable[[Any], None]) -> list[Any]:
        """The subscription, and the token that says its type."""

        def file(sample: zenoh.Sample) -> None:
            assert (sample.attachment is None) == (self.bridge == "dds")
            hear(self.types.decode(sample.payload.to_bytes(), type_))

        declared = [self.session.declare_subscriber(self.key(name, type_), file)]
        zid = self.session.info.zid()
        if self.bridge == "dds":
            token = f"@/{zid}/@ros2_lv/MS/{name[1:]}/{type_.replace('/', '§')}/:1:0:0,10:"
        else:
            written = "/".join(self.key(name, type_).split("/")[-2:])
            token = f"@ros2_lv/0/{zid}/0/11/MS/%/%/robot/{name.replace('/', '%')}/{written}/::,10:,:,:,,"
        return [*declared, self.session.liveliness().declare_token(token)]

    def call(self, name: str, type_: str, request: Any) -> Any:
        [reply] = list(
            self.session.get(
                self.key(name, type_), payload=self.types.encode(request), attachment=self._attachment(),
                timeout=LIMIT_S, target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE,
            )
        )  # fmt: skip
        assert reply.ok is not None
        return self.types.decode(reply.ok.payload.to_bytes(), f"{type_}_Response")

    def _attachment(self) -> bytes | None:
        self._n += 1
        return None if self.bridge == "dds" else attachment(self._n, time.time_ns(), GID)
