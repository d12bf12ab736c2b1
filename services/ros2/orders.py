# SPDX-License-Identifier: Apache-2.0
"""What the core lets the shell do: maps of topics.TX. Stamps are ns."""

from typing import Any

import msgpack

from shared import topics
from shared.messages import SerialData
from shared.topics import Publication

PORT = "ros"
"""The name of the service's port."""


def publish_order(now: int, name: str, data: bytes) -> Publication:
    """The order to publish a message. name: of the topic, without the namespace.  data: CDR."""
    return _out(now, {"publish": name, "data": data})


def reply_order(now: int, request: int, data: bytes) -> Publication:
    """The order to reply to a request of a ROS node. data: CDR; empty: end it without a reply."""
    return _out(now, {"reply": request, "data": data})


def ask_order(now: int, number: int, key: str, payload: bytes) -> Publication:
    """The order to send a request to a service of the stack. The outcome comes as an event with this number."""
    return _out(now, {"ask": key, "id": number, "payload": payload})


def tool_order(now: int, number: int, command: tuple[str, ...]) -> Publication:
    """The order to run a command of zenav, as ("map", "save", "office"). Its outcome comes as an event too."""
    return _out(now, {"tool": command, "id": number})


def _out(now: int, fields: dict[str, Any]) -> Publication:
    return topics.TX(SerialData(now, PORT, bytes(msgpack.packb(fields))))
