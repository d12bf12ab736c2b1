# SPDX-License-Identifier: Apache-2.0
"""`zenav topic pub` and `zenav request`: messages and requests that are given as JSON."""

import json
import sys
import threading
from typing import Any

from shared.codec import Envelope, decode
from shared.config import UserError, load_robot, nearest
from shared.messages import Message
from shared.requests import REQUESTS, Request
from shared.runners.transport import stack_address
from shared.topics import Topic
from zenav.client import Client
from zenav.client.navigation_client import refusal_error
from zenav.client.topic import topic_named
from zenav.console.message_text import json_value
from zenav.console.shutdown import stop_on_signal
from zenav.wire.from_json import payload_from_json

MAX_MATCH_S = 2.0  # s until a subscriber is found
MAX_ASK_S = 20.0  # s: the mapper checks a map before it replies


def publish_json(robot: str, stack: str, key: str, text: str, hz: float, publisher: str) -> None:
    """Publishes a message once, or `hz` times a second until Ctrl-C. Raises UserError where nothing listens."""
    key, topic = topic_named(key)
    sender = publisher_for(key, topic, publisher)
    with stop_on_signal() as stop, Client(load_robot(robot).robot.name, stack_address(stack)) as client:

        def payload(sequence: int) -> bytes:
            return payload_from_json(topic.type, text, Envelope(sender, client.session_name, sequence, client.now()))

        first = payload(0)
        publishing = client.session.declare_publisher(f"{client.robot}/{key}", express=True)
        is_matched = threading.Event()
        publishing.declare_matching_listener(lambda status: is_matched.set() if status.matching else None)
        there: Any = publishing.matching_status  # zenoh calls it a bool; it is a MatchingStatus
        if not there.matching and not is_matched.wait(MAX_MATCH_S):
            raise UserError(f"nothing listens to {key}", "does the stack run? zenav doctor")
        publishing.put(first)
        n = 1
        while hz and not stop.wait(1 / hz):
            publishing.put(payload(n))
            n += 1
    sys.stdout.write(f"{key}: {n} message{'s' if n > 1 else ''} as {sender}\n")


def publisher_for(key: str, topic: Topic[Message], wanted: str) -> str:
    """The publisher of a message: the wanted one, else `operator`. Raises UserError where it may not publish."""
    allowed = (key.rpartition("/")[2],) if topic.by == "*" else topic.publishers
    sender = wanted or "operator"
    if sender not in allowed:
        names = " or ".join(allowed)
        instead = f"to publish in its place, while it does not run: --as {allowed[0]}"
        raise UserError(f"{key} is published by {names}, not by {sender}", instead)
    return sender


def request_json(robot: str, stack: str, name: str, text: str) -> int:
    """Sends a request and writes the reply; 1 where it is refused. Raises UserError where no reply comes."""
    row, service = request_named(name)
    with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        payload = payload_from_json(row.request, text, Envelope("operator", client.session_name, 0, client.now()))
        reply: Any = client.ask(row, decode(row.request, payload)[0], MAX_ASK_S, service)
    sys.stdout.write(json.dumps(json_value(reply)) + "\n")
    if reply.accepted:
        return 0
    error = refusal_error(reply)
    sys.stderr.write(f"{error.what}\nhint: {error.hint}\n")
    return 1


def request_named(name: str) -> tuple[Request[Message, Message], str]:
    """The request of a name like `navigate` or `set/planner`, and its service. Raises UserError."""
    services = {row.key_of(service).partition("/")[2]: (row, service) for row in REQUESTS for service in row.services}
    found = services.get(name.removeprefix("request/"))
    if found is None:
        raise UserError(f"{name} is not a request", nearest(name, tuple(services)))
    return found
