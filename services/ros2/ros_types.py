# SPDX-License-Identifier: Apache-2.0
"""Types of one ROS 2 distribution: CDR and type hashes, by rosbags. It is loaded when the bridge opens.

A service X has X_Request, X_Response and, for the hash only, X_Event. An action X has X_Goal, X_Result, X_Feedback, the
services X_SendGoal and X_GetResult, and X_FeedbackMessage. Source: rosidl_parser/definition.py, REP 2011, REP 2016.
"""

import struct
from enum import StrEnum
from functools import cache
from typing import Any

from services.ros2.interface_definitions import (
    HUMBLE_ACTIONS,
    JAZZY_ACTIONS,
    KILTED_ACTIONS,
    MESSAGES,
    SERVICES,
    Definition,
)

NO_HASH = "TypeHashNotSupported"
"""In the place of a hash in Humble, which has none."""
EMPTY_MEMBER = "structure_needs_at_least_one_member"  # what rosidl gives a structure without members
UUID = "unique_identifier_msgs/msg/UUID"
EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
EVENT_FIELDS = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number\n"
"""of EVENT_INFO. Its definition has char[16]: rosidl hashes that as uint8 (type 3), rosbags 0.11 as char (type 13)."""


class Distro(StrEnum):
    """Distribution of ROS 2 on the other side."""

    HUMBLE = "humble"
    JAZZY = "jazzy"
    KILTED = "kilted"


ACTIONS = {Distro.HUMBLE: HUMBLE_ACTIONS, Distro.JAZZY: JAZZY_ACTIONS, Distro.KILTED: KILTED_ACTIONS}


class RosTypes:
    """The types of a distribution. `types` has the class of each by its name, as std_msgs/msg/String."""

    def __init__(self, distro: Distro) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.distro = distro
        self._store = get_typestore(Stores[f"ROS2_{distro.name}"])
        if EVENT_INFO in self._store.fielddefs:
            self._store.fielddefs[EVENT_INFO] = [], _fields(EVENT_FIELDS)
        self._store.register(_definitions(distro))
        self.types = self._store.types

    def hash_of(self, type_: str) -> str:
        """The hash of a message, service or action's part, by REP 2016: RIHS01_ and SHA-256."""
        return NO_HASH if self.distro is Distro.HUMBLE else self._store.hash_rihs01(type_)

    def encode(self, message: Any) -> bytes:
        """A message as CDR, little-endian, with its header. Raises ValueError where a number does not fit its field."""
        try:
            return bytes(self._store.serialize_cdr(message, message.__msgtype__))
        except struct.error as error:  # as the seconds of a stamp after 2038, which have 32 bits
            raise ValueError(f"{message.__msgtype__}: {error}") from None

    def decode(self, data: bytes, type_: str) -> Any:
        """A message of CDR. Raises ValueError where the bytes are none."""
        try:
            return self._store.deserialize_cdr(data, type_)
        except Exception as error:  # rosbags' generated code raises whatever damaged bytes make it
            raise ValueError(f"no {type_}: {error or type(error).__name__}") from None

    def new(self, type_: str, **fields: Any) -> Any:
        """A message with these fields."""
        class_: Any = self.types[type_]
        return class_(**fields)


@cache
def ros_types(distro: Distro) -> RosTypes:
    """The types of a distribution, made once in a process."""
    return RosTypes(distro)


def _definitions(distro: Distro) -> Any:
    """What `Typestore.register` takes."""
    types: dict[str, Any] = {}
    has_events = distro is not Distro.HUMBLE
    for name, text in MESSAGES.items():
        types[name] = [], _fields(text)
    for name, (request, response) in SERVICES.items():
        _add_service(types, name, _fields(request), _fields(response), has_events)
    for name, definition in ACTIONS[distro].items():
        _add_action(types, name, definition, has_events)
    return types


def _add_action(types: dict[str, Any], name: str, definition: Definition, has_events: bool) -> None:
    for part, text in zip(("Goal", "Result", "Feedback"), definition):
        types[f"{name}_{part}"] = [], _fields(text)
    goal_id = ("goal_id", _name(UUID))
    accepted = [*_fields("bool accepted\nbuiltin_interfaces/Time stamp\n")]
    _add_service(types, f"{name}_SendGoal", [goal_id, ("goal", _name(f"{name}_Goal"))], accepted, has_events)
    result = [*_fields("int8 status\n"), ("result", _name(f"{name}_Result"))]
    _add_service(types, f"{name}_GetResult", [goal_id], result, has_events)
    types[f"{name}_FeedbackMessage"] = [], [goal_id, ("feedback", _name(f"{name}_Feedback"))]


def _add_service(types: dict[str, Any], name: str, request: list[Any], response: list[Any], has_events: bool) -> None:
    types[f"{name}_Request"], types[f"{name}_Response"] = ([], request), ([], response)
    if not has_events:
        return
    parts = [("request", f"{name}_Request"), ("response", f"{name}_Response")]
    types[f"{name}_Event"] = (
        [],
        [("info", _name(EVENT_INFO)), *((part, _sequence_of_one(type_)) for part, type_ in parts)],
    )
    types[name] = (
        [],
        [*((f"{part}_message", _name(type_)) for part, type_ in parts), ("event_message", _name(f"{name}_Event"))],
    )


def _fields(text: str) -> list[Any]:
    """The fields of a definition in the .msg format."""
    from rosbags.typesys import get_types_from_msg

    [(_, fields)] = get_types_from_msg(text or f"uint8 {EMPTY_MEMBER}", "zenav/msg/Part").values()
    return list(fields)


def _name(type_: str) -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype.NAME, type_


def _sequence_of_one(type_: str) -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype.SEQUENCE, (_name(type_), 1)
