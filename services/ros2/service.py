# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 bridge: what ROS 2 nodes send comes in on a port, as events of the shell, so that a drive by ROS replays.

The shell passes the stack's messages on to ROS (stack_feed.py). Each map of topics.RX has an `event`:

- `message`: `name` of the topic, `type`, `data` in CDR, `gid` of its publisher. `sent` is ns on the publisher's clock,
  `came` ns on this computer's;
- `request`: `name` of the service, its number `id`, `data` in CDR;
- `outcome` of a request to the stack or of a command, by its number `id`;
- `other_teleop`: another tool drives;
- `rejected`: `n` messages of `name` that are not used, `text`: why;
- `mismatch`: `text` on an endpoint of another node that does not fit ours.

orders.py has the maps of topics.TX.
"""

from typing import Any, NamedTuple

from services.ros2 import incoming_topics as incoming
from services.ros2.action_server import ActionServer, GoalRefusedError
from services.ros2.config import Ros2Config
from services.ros2.incoming_topics import pose_in_map, velocity
from services.ros2.orders import PORT, ask_order, publish_order, reply_order, tool_order
from services.ros2.outgoing_topics import STATIC_TF
from services.ros2.robot_input import ROBOT_TOPICS, ClockDoubtError, RobotInput
from services.ros2.ros_types import RosTypes, ros_types
from services.ros2.sender_clocks import SenderClocks
from services.ros2.service_calls import BY, ServiceCalls
from services.ros2.task_requests import Done, PendingOutcomes, logged_refusal
from shared import requests, topics
from shared.codec import Envelope, encode
from shared.config import Robot
from shared.event_maps import event_maps
from shared.messages import GuardStatus, MapMode, Message, NavStatus, PortState, PoseEstimate, SerialData, Velocity
from shared.ports import PortConfig
from shared.rejections import RejectionCause
from shared.requests import Navigate, Request, StartMap
from shared.ros_messages import RosMessages
from shared.service import Log, Out, Service, every, on
from shared.teleop_arbiter import TeleopRefusedError
from shared.teleop_stream import TeleopStream
from shared.topics import Publication
from shared.types import NS_PER_S


class Loaded(NamedTuple):
    """What needs the types of the distribution."""

    types: RosTypes
    make: RosMessages
    actions: ActionServer
    calls: ServiceCalls
    robot: RobotInput


MAX_VELOCITY_AGE_S, MAX_AGE_S = 0.3, 2.0
"""of a velocity and of other messages, by their publisher's clock: an older one is from before a broken link."""
ROBOT_NAMES = frozenset(row.name for row in ROBOT_TOPICS)


class Ros2Service(Service):
    """Decides what ROS 2 nodes may do, and serves the actions."""

    config_type = Ros2Config
    config: Ros2Config

    def __init__(self, config: Ros2Config, robot: Robot) -> None:
        super().__init__(config, robot)
        self.teleop = TeleopStream(config.teleop_hold)
        self.is_open, self.detail = False, ""
        self.mode = MapMode.MAP
        self._pending = PendingOutcomes()
        self.sender_clocks = SenderClocks()
        self._logged: dict[str, int] = {}  # ns, of the last line on a name: a flood is one line a second
        self._loaded: Loaded | None = None

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    def state(self) -> str:
        if not self.is_open:
            return self.detail or "no router: set ros2.port.device"
        text = "with a bridge to DDS" if self.config.bridge == "dds" else f"in domain {self.config.domain}"
        parts = () if self._loaded is None else (self._loaded.robot.state, self._loaded.actions.state)
        return "; ".join((text, *filter(None, parts)))

    @on(topics.PORT)
    def port_state(self, state: PortState) -> Out:
        """The router is there, or is not: then nothing drives."""
        if state.port != PORT:
            return
        self.is_open, self.detail = state.open, state.detail
        if state.open:
            types, make = self._ros.types, self._ros.make
            if not self.config.drives:  # such a robot has its own
                mounts = (make.mount(self.now, laser.mount, i) for i, laser in enumerate(self.robot.all_lasers))
                yield publish_order(self.now, STATIC_TF.name, types.encode(make.transforms(*mounts)))
            yield Log("INFO", f"ROS 2: connected, {self.state()}")
        else:
            yield from self._let_go()
            yield Log("WARNING", f"ROS 2: {state.detail}")

    @on(topics.RX)
    def receive(self, data: SerialData) -> Out:
        """Takes events of the shell."""
        if data.port == PORT:
            for event in event_maps(data.data):
                yield from self._event(event)

    @on(topics.GUARD)
    def guard_status(self, status: GuardStatus) -> Out:
        """Takes the guard's confirmation of STOP."""
        if self._loaded is not None:
            yield from self._loaded.calls.guard_status(status, self.now)

    @on(topics.POSE)
    def pose(self, estimate: PoseEstimate) -> Out:
        """Takes the pose, for the feedback of goals."""
        self.mode = estimate.mode
        if self._loaded is not None:
            self._loaded.actions.estimate = estimate
        return ()

    @on(topics.NAV_STATUS)
    def nav_status(self, status: NavStatus) -> Out:
        """Takes the navigator's status, for the goals."""
        if self._loaded is not None:
            yield from self._loaded.actions.nav_status(status, self.now)

    @on(topics.VELOCITY)
    def velocity(self, command: Velocity) -> Out:
        """Passes the velocity on to a robot with ROS 2."""
        if self.config.drives and self.is_open:
            yield from self._ros.robot.velocity(command, self.now)

    @every(hz=20)
    def drive(self) -> Out:
        """Publishes the driver's command, zero after its end, and STOP until it is confirmed."""
        yield from _teleop(self.teleop.tick(self.now))
        if self._loaded is not None:
            yield from self._loaded.calls.tick(self.now)
            yield from self._loaded.robot.tick(self.now)

    def on_shutdown(self) -> Out:
        """A robot that ROS drives stands, and a robot with ROS 2 that is driven, too."""
        yield from self._let_go()
        if self._loaded is not None:
            yield from self._loaded.robot.on_shutdown(self.now)

    # --- events -------------------------------------------------------------------------------------------------------

    def _event(self, event: dict[Any, Any]) -> Out:
        kind, name = event.get("event"), str(event.get("name", ""))
        try:
            if kind == "message":
                yield from self._message(name, event)
            elif kind == "request":
                yield from self._request(name, event["id"], event["data"])
            elif kind == "outcome":
                done = self._pending.take(event["id"])
                if done is not None:
                    yield from done({**event, "now": self.now})
            elif kind == "other_teleop":
                self.teleop.on_other_command(self.now)
            elif kind == "rejected":
                self._reject(name, str(event["text"]), event["n"])
            elif kind == "mismatch":
                yield Log("WARNING", f"ROS 2: {event['text']}")
        except (TeleopRefusedError, ClockDoubtError) as error:
            self._reject(name, str(error))
        except ValueError as error:
            self._reject(name, str(error))
            if not 0 <= self.now - self._logged.get(name, -NS_PER_S) < NS_PER_S:
                self._logged[name] = self.now
                yield Log("WARNING", f"ROS 2: {name}: {error}")

    def _message(self, name: str, event: dict[Any, Any]) -> Out:
        if name in ROBOT_NAMES:
            yield from self._ros.robot.message(name, event["type"], event["data"], self.now)
            return
        types, make = self._ros.types, self._ros.make
        message = types.decode(event["data"], event["type"])
        age = self.sender_clocks.age(event["gid"], event["sent"], event["came"]) / NS_PER_S
        if age > (MAX_VELOCITY_AGE_S if name == incoming.CMD_VEL else MAX_AGE_S):
            raise ValueError(f"a message that came {age:.1f} s later than others of its publisher")
        if name == incoming.CMD_VEL:
            driver = int.from_bytes(event["gid"])
            yield from _teleop(self.teleop.take(driver, BY, *velocity(message), self.now))
        elif name == incoming.GOAL_POSE:
            pose = pose_in_map(message.header, message.pose, make.frames.map)
            goal = Navigate(self.now, (pose,), 0.0, 1, False)
            yield self._ask(requests.NAVIGATE, goal, logged_refusal("goal"), name)
        elif name == incoming.INITIAL_POSE:
            pose = pose_in_map(message.header, message.pose.pose, make.frames.map)
            mode = MapMode.LOCALISE if self.mode is MapMode.LOCALISE else MapMode.CONTINUE
            start = StartMap(self.now, mode, 0, (pose,))
            yield self._ask(requests.START_MAP, start, logged_refusal("initial pose"), name)

    def _request(self, name: str, number: int, data: bytes) -> Out:
        ros = self._ros
        try:
            yield from (ros.actions if ros.actions.serves(name) else ros.calls).request(name, number, data, self.now)
        except GoalRefusedError:
            raise
        except ValueError:
            yield reply_order(self.now, number, b"")
            raise

    def _ask(self, row: Request[Any, Any], message: Message, done: Done, topic: str = "") -> Publication:
        number = self._pending.add(done, topic)
        return ask_order(self.now, number, row.key, encode(message, Envelope(self.name, "", number, self.now)))

    def _ask_tool(self, command: tuple[str, ...], done: Done) -> Publication:
        return tool_order(self.now, self._pending.add(done), command)

    def _let_go(self) -> Out:
        driver = self.teleop.arbiter.driver
        if driver is not None:
            yield from _teleop(self.teleop.let_go(driver.client, self.now))

    def _reject(self, name: str, text: str, n: int = 1) -> None:
        self.rejections.count(f"ros{name}", RejectionCause.CONTENT, text, n)

    @property
    def _ros(self) -> Loaded:
        """Types, messages, actions and services of the distribution, loaded with the first event."""
        if self._loaded is None:
            types = ros_types(self.config.distro)
            make = RosMessages(types.types, self.config.ros_frames)
            calls = ServiceCalls(types, make, self._ask, self._ask_tool)
            actions = ActionServer(types, make, self._ask)
            robot = RobotInput(self.config, types, make, self.robot)
            self._loaded = Loaded(types, make, actions, calls, robot)
        return self._loaded


def _teleop(command: Velocity | None) -> Out:
    if command is not None:
        yield topics.TELEOP(command)
