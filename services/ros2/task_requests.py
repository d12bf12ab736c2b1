# SPDX-License-Identifier: Apache-2.0
"""What is behind the services without arguments: requests to the stack, and Nav2's states; outcomes in words."""

from collections.abc import Callable
from typing import Any

from services.ros2.incoming_topics import GET_STATE, TRIGGER
from services.ros2.ros_types import RosTypes
from shared import requests
from shared.messages import Message
from shared.reasons import reason_text
from shared.requests import Cancel, Explore, Pause, Request
from shared.ros_messages import RosMessages
from shared.service import Log, Out

ACTIVE = 3  # lifecycle_msgs/State: PRIMARY_STATE_ACTIVE
Done = Callable[[dict[str, Any]], Out]
"""Takes the outcome of a request: accepted, reason, detail, hint, data."""


def task_request(name: str, now: int) -> tuple[Request[Any, Any], Message]:
    """The request of a service of TRIGGERS that is not STOP. now: ns."""
    rows: dict[str, tuple[Request[Any, Any], Message]] = {
        "/explore": (requests.EXPLORE, Explore(now)),
        "/cancel": (requests.CANCEL, Cancel(now)),
        "/pause": (requests.PAUSE, Pause(now, True)),
        "/resume": (requests.PAUSE, Pause(now, False)),
    }
    return rows[name]


def active_state(types: RosTypes, make: RosMessages, name: str) -> bytes:
    """The CDR of the response of one of STATE_SERVICES: active."""
    if name.endswith("/is_active"):
        return types.encode(make.new(f"{TRIGGER}_Response", success=True, message=""))
    state = make.new("lifecycle_msgs/msg/State", id=ACTIVE, label="active")
    return types.encode(make.new(f"{GET_STATE}_Response", current_state=state))


def logged_refusal(what: str) -> Done:
    """Logs a refusal of a message that has no reply."""

    def done(outcome: dict[str, Any]) -> Out:
        if not outcome["accepted"]:
            yield Log("WARNING", f"ROS 2: {what} refused: {refusal_text(outcome)}")

    return done


def refusal_text(outcome: dict[str, Any]) -> str:
    """Why a request was refused, with its hint."""
    text = outcome.get("detail") or reason_text(outcome["reason"]) or str(outcome["reason"])
    hint = outcome.get("hint", "")
    return text if hint in text else f"{text}: {hint}"
