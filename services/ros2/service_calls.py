# SPDX-License-Identifier: Apache-2.0
"""The services that are no action's: STOP, tasks, Nav2's states, maps. Each request gets one reply. Times are ns."""

from functools import partial
from re import fullmatch
from typing import Any

import numpy as np

from services.ros2 import incoming_topics as incoming
from services.ros2.incoming_topics import CLEAR_COSTMAP, CLEAR_EXCEPT, GET_STATE, LOAD_MAP, SAVE_MAP, TRIGGER
from services.ros2.orders import reply_order
from services.ros2.ros_types import RosTypes
from services.ros2.task_requests import AskStack, AskTool, refusal_text, task_request
from shared import requests, topics
from shared.messages import GuardStatus
from shared.requests import ClearCostmaps
from shared.ros_messages import RosMessages
from shared.service import Log, Out
from shared.stop_button import StopButton
from shared.topics import Publication

BY = "ROS 2"
CLEARS = dict(incoming.CLEAR_SERVICES)
MAX_SIDE_M = 1000.0  # of shared/requests.py, ClearCostmaps
STATES = frozenset(name for name, _ in incoming.STATE_SERVICES)
ACTIVE = 3  # lifecycle_msgs/State: PRIMARY_STATE_ACTIVE
MAP_NAME = r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}"
SAVED: dict[str, tuple[object, ...]] = {
    "map_topic": ("", "map", "/map"),
    "image_format": ("", "pgm"),
    "map_mode": ("", "trinary"),
    "free_thresh": (0.0, 0.25),
    "occupied_thresh": (0.0, 0.65),
}
"""Fields of nav2_msgs/SaveMap with the values that are a saved map's; the first one is the message's default."""
LOADED, NOT_LOADED = 0, 255  # nav2_msgs/LoadMap: RESULT_SUCCESS, RESULT_UNDEFINED_FAILURE


class ServiceCalls:
    """See the module. ask: makes the order of a request to the stack.  tool: that of a command of zenav."""

    def __init__(self, types: RosTypes, make: RosMessages, ask: AskStack, tool: AskTool) -> None:
        self._types, self._make, self._ask, self._tool = types, make, ask, tool
        self.stop_button = StopButton()
        self._waiting: list[int] = []  # requests of STOP and its release, until the guard confirms

    def request(self, name: str, number: int, data: bytes, now: int) -> Out:
        """A request. Raises ValueError where it is none, without a reply. STOP counts whatever its bytes are."""
        if name in (incoming.ESTOP, incoming.RELEASE):
            if name == incoming.RELEASE:
                self._types.decode(data, f"{TRIGGER}_Request")
            is_pressed, what = name == incoming.ESTOP, "STOP" if name == incoming.ESTOP else "release of STOP"
            if self.stop_button.order is not None and self.stop_button.order.pressed != is_pressed:
                yield from self._reply_stops(False, f"replaced by {what}", now)
            self._waiting.append(number)
            yield topics.ESTOP(self.stop_button.set(is_pressed, BY, now))
            yield Log("INFO", f"audit: {what} by {BY}")
        elif name in STATES:
            yield reply_order(now, number, self._active_state(name))
        elif name in (incoming.SAVE, incoming.LOAD):
            yield from self._map(name, number, data)
        elif name in CLEARS:
            yield from self._clear(name, number, data, now)
        else:
            self._types.decode(data, f"{TRIGGER}_Request")
            row, message = task_request(name, now)
            yield self._ask(row, message, lambda outcome: self._task_done(number, outcome))

    def guard_status(self, status: GuardStatus, now: int) -> Out:
        """The guard's confirmation of STOP."""
        was_waiting = self.stop_button.order is not None
        self.stop_button.confirm(status)
        if was_waiting and self.stop_button.order is None:
            yield from self._reply_stops(True, f"the guard is {status.state}", now)

    def tick(self, now: int) -> Out:
        """STOP again until it is confirmed."""
        stop, is_unconfirmed = self.stop_button.tick(now)
        if stop is not None:
            yield topics.ESTOP(stop)
        if is_unconfirmed:
            yield from self._reply_stops(False, "the guard does not confirm: switch the robot off by hand", now)

    def _reply_stops(self, success: bool, message: str, now: int) -> Out:
        waiting, self._waiting = self._waiting, []
        for number in waiting:
            yield self._trigger_reply(number, success, message, now)

    def _task_done(self, number: int, outcome: dict[str, Any]) -> Out:
        words = "accepted" if outcome["accepted"] else refusal_text(outcome)
        yield self._trigger_reply(number, outcome["accepted"], words, outcome["now"])

    def _trigger_reply(self, number: int, success: bool, message: str, now: int) -> Publication:
        response = self._make.new(f"{TRIGGER}_Response", success=success, message=message)
        return reply_order(now, number, self._types.encode(response))

    def _active_state(self, name: str) -> bytes:
        """The CDR of the response of one of STATE_SERVICES."""
        if name.endswith("/is_active"):
            return self._types.encode(self._make.new(f"{TRIGGER}_Response", success=True, message=""))
        state = self._make.new("lifecycle_msgs/msg/State", id=ACTIVE, label="active")
        return self._types.encode(self._make.new(f"{GET_STATE}_Response", current_state=state))

    def _clear(self, name: str, number: int, data: bytes, now: int) -> Out:
        """Clears the local costmap. Nav2's reset_distance is the side of a square."""
        type_ = CLEARS[name]
        asked = self._types.decode(data, f"{type_}_Request")
        side = 0.0 if type_ == CLEAR_COSTMAP else float(asked.reset_distance)
        if type_ != CLEAR_COSTMAP and not 0 < side <= MAX_SIDE_M:
            raise ValueError(f"reset_distance {side:g}: give the side of a square, over 0 and up to {MAX_SIDE_M:g} m")
        if name.startswith("/global_costmap/"):
            yield self._cleared_reply(type_, number, now)
            yield Log("INFO", f"ROS 2: {name}: nothing to clear, for the global costmap is made of the map and zones")
            return
        request = ClearCostmaps(now, side, type_ == CLEAR_EXCEPT)
        yield self._ask(requests.CLEAR_COSTMAPS, request, partial(self._cleared, name, number))

    def _cleared_reply(self, type_: str, number: int, now: int) -> Publication:
        response = self._make.new(f"{type_}_Response", response=self._make.new("std_msgs/msg/Empty"))
        return reply_order(now, number, self._types.encode(response))

    def _cleared(self, name: str, number: int, outcome: dict[str, Any]) -> Out:
        """Nav2's response has no field for a refusal: then there is none, and a log line."""
        if outcome["accepted"]:
            yield self._cleared_reply(CLEARS[name], number, outcome["now"])
        else:
            yield reply_order(outcome["now"], number, b"")
            yield Log("WARNING", f"ROS 2: {name}: {refusal_text(outcome)}")

    def _map(self, name: str, number: int, data: bytes) -> Out:
        """Saves or loads a map by its name: a path of another computer means nothing here."""
        type_ = SAVE_MAP if name == incoming.SAVE else LOAD_MAP
        asked = self._types.decode(data, f"{type_}_Request")
        place = str(asked.map_url)
        command = "save" if name == incoming.SAVE else "load"
        if fullmatch(MAP_NAME, place) is None:
            raise ValueError(f"map_url {place!r} is no name of a map: letters, digits, - and _")
        if name == incoming.SAVE and (ignored := _ignored_fields(asked)):
            yield Log("WARNING", f"ROS 2: {name}: {', '.join(ignored)} does not count: maps have one format")
        yield self._tool(("map", command, place), lambda outcome: self._map_done(name, number, outcome))

    def _map_done(self, name: str, number: int, outcome: dict[str, Any]) -> Out:
        is_done, make = outcome["accepted"], self._make
        if name == incoming.SAVE:
            response = make.new(f"{SAVE_MAP}_Response", result=is_done)
        else:
            empty = make.grid(np.empty((0, 0), np.int8), 0.0, (0.0, 0.0), 0, make.frames.map)
            response = make.new(f"{LOAD_MAP}_Response", map=empty, result=LOADED if is_done else NOT_LOADED)
        yield reply_order(outcome["now"], number, self._types.encode(response))
        yield Log("INFO" if is_done else "WARNING", f"ROS 2: {name}: {'done' if is_done else refusal_text(outcome)}")


def _ignored_fields(request: Any) -> list[str]:
    """The fields of a nav2_msgs/SaveMap that ask for another map than the one that is saved."""
    values = {field: getattr(request, field) for field in SAVED}
    rounded = {field: round(value, 3) if isinstance(value, float) else value for field, value in values.items()}
    return [field for field, value in rounded.items() if value not in SAVED[field]]
