# SPDX-License-Identifier: Apache-2.0
"""Requests to the stack and commands of zenav that ROS 2 nodes cause, and their outcomes in words."""

from collections.abc import Callable
from typing import Any

from shared import requests
from shared.messages import Message
from shared.reasons import reason_text
from shared.requests import Cancel, Explore, Pause, Request
from shared.service import Log, Out
from shared.topics import Publication

Done = Callable[[dict[str, Any]], Out]
"""Takes the outcome of a request: accepted, reason, detail, hint, data; `now` in ns."""
AskStack = Callable[[Request[Any, Any], Message, Done], Publication]
"""Makes the order of a request to the stack."""
AskTool = Callable[[tuple[str, ...], Done], Publication]
"""Makes the order of a command of zenav, by its arguments."""
MAX_PENDING = 128  # more than the requests that the wire lets wait for a reply; then the oldest is forgotten


class PendingOutcomes:
    """Requests to the stack and commands that have no outcome yet, by their numbers."""

    def __init__(self) -> None:
        self._done: dict[int, Done] = {}
        self._newest: dict[str, int] = {}  # number by the topic that caused the request
        self._n = 0

    def add(self, done: Done, topic: str = "") -> int:
        """The number of an order, whose outcome `done` gets.

        topic: whose message caused it. Such a request has no reply, so only the outcome of the newest one counts.
        A flood of messages does not displace requests that a node waits for.
        """
        self._n += 1
        if topic:
            self._done.pop(self._newest.get(topic, 0), None)
            self._newest[topic] = self._n
        self._done[self._n] = done
        if len(self._done) > MAX_PENDING:
            del self._done[min(self._done)]
        return self._n

    def take(self, number: int) -> Done | None:
        """What gets the outcome of an order; None where it is forgotten. It gets one outcome only."""
        return self._done.pop(number, None)


def task_request(name: str, now: int) -> tuple[Request[Any, Any], Message]:
    """The request of a service of TRIGGERS that is not STOP. now: ns."""
    rows: dict[str, tuple[Request[Any, Any], Message]] = {
        "/explore": (requests.EXPLORE, Explore(now)),
        "/cancel": (requests.CANCEL, Cancel(now)),
        "/pause": (requests.PAUSE, Pause(now, True)),
        "/resume": (requests.PAUSE, Pause(now, False)),
    }
    return rows[name]


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
