# SPDX-License-Identifier: Apache-2.0
"""What the records say that the gateway's process writes: Zenoh's log, and its own lines on links.

Zenoh drops a message that the access rules do not allow, and only its log shows it, at the level of LOG_FILTER. The
patterns hold for the pinned version of Zenoh; tests/stack/test_gateway.py fails where they do not.

A member chooses its keys, and a key may hold line breaks and what looks like a line of the log. So a record is what was
written at once (router_process.py), and a key only its last part.
"""

import re
from dataclasses import dataclass
from enum import StrEnum

LOG_FILTER = "error,zenoh::net::routing::interceptor=trace,zenoh_link_tls=warn"
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_HEAD = re.compile(r"(\S+ +)?[A-Z]+ [^(]*ThreadId\((?P<thread>\d+)\) (?P<part>\S+): (?P<text>.*)")
_DENIED = re.compile(
    r"\S+ on \S*\+CertCommonName\((?P<name>[^)]*)\)\S* is unauthorized to (?P<action>\w+) \(ingress\) on (?P<key>\S+)"
)
_OUTWARD = re.compile(r"\S+ on \S+ is unauthorized to \w+ \(egress\)")  # it is not sent out: no event
_LINK = r"{mark} (?P<event>listening|joined|left) (?P<name>\S+) (?P<address>\S+)"
_DROPPED = "Msg intercepted!"
_HANDSHAKE = re.compile(r"(?P<why>.+?)\.? Hint:")
_RULES, _ROUTING, _TLS = "interceptor::access_control", "routing::interceptor", "zenoh_link_tls::unicast"
"""Ends of the parts of Zenoh that write such lines."""


class LinkEvent(StrEnum):
    """What happened at the gateway."""

    LISTENING = "listening"  # the process takes connections from now on
    JOINED = "joined"
    LEFT = "left"
    REFUSED = "refused"  # a message that the rules do not allow
    REJECTED = "rejected"  # a connection without a certificate of the robot's authority


@dataclass(frozen=True, slots=True)
class LinkLine:
    """One event. name: of the certificate, empty where there is none.  text: address, or `put KEY`, or why."""

    event: LinkEvent
    name: str
    text: str


class LineReader:
    """Takes records in order, and returns the event that one completes.

    mark: begin of the process's own lines. It is secret.
    """

    def __init__(self, mark: str) -> None:
        self._link = re.compile(_LINK.format(mark=re.escape(mark)))
        self._denied: dict[str, LinkLine | None] = {}  # by thread: said, but perhaps only to remember a decision

    def read(self, record: str) -> LinkLine | None:
        """The event of a record, or None."""
        line = _COLOUR.sub("", record.partition("\n")[0]).strip()
        if (match := self._link.fullmatch(line)) is not None:
            return LinkLine(LinkEvent(match["event"]), "" if match["name"] == "-" else match["name"], match["address"])
        if (head := _HEAD.fullmatch(line)) is None:
            return None
        thread, part, text = head["thread"], head["part"], head["text"]
        if part.endswith(_TLS) and (match := _HANDSHAKE.match(text)) is not None:
            return LinkLine(LinkEvent.REJECTED, "", match["why"])
        if part.endswith(_ROUTING) and text == _DROPPED:
            return self._denied.pop(thread, LinkLine(LinkEvent.REFUSED, "", "a message"))
        if part.endswith(_RULES) and (match := _DENIED.match(text)) is not None:
            said = f"{match['action'].lower()} {match['key']}"
            self._denied[thread] = LinkLine(LinkEvent.REFUSED, match["name"], said)
        elif part.endswith(_RULES) and _OUTWARD.match(text) is not None:
            self._denied[thread] = None
        else:
            self._denied.pop(thread, None)
        return None
