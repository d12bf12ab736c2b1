# SPDX-License-Identifier: Apache-2.0
"""What the lines say that the gateway's process writes: Zenoh's log, and its own lines on links.

Zenoh drops a message that the access rules do not allow, and only its log shows it, at the level of LOG_FILTER. The
patterns hold for the pinned version of Zenoh; tests/stack/test_gateway.py fails where they do not.
"""

import re
from dataclasses import dataclass
from enum import StrEnum

LOG_FILTER = "error,zenoh::net::routing::interceptor=trace,zenoh_link_tls=warn"
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_DENIED = re.compile(
    r"\+CertCommonName\((?P<name>[^)]*)\).* is unauthorized to (?P<action>\w+) \(ingress\) on (?P<key>\S+)"
)
_OUTWARD = re.compile(r"is unauthorized to \w+ \(egress\)")  # it is not sent out: no event
_LINK = r"{mark} (?P<event>joined|left) (?P<name>\S+) (?P<address>\S+)"
_DROPPED = "interceptor: Msg intercepted!"
_HANDSHAKE = re.compile(r"WARN.*zenoh_link_tls::unicast: (?P<why>.+?)\.? Hint:")


class LinkEvent(StrEnum):
    """What happened at the gateway."""

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
    """Takes lines in order, and returns the event that one completes.

    mark: begin of the process's own lines. It is secret: a key in Zenoh's log may hold line breaks, and what looks like
    such a line.
    """

    def __init__(self, mark: str) -> None:
        self._link = re.compile(_LINK.format(mark=re.escape(mark)))
        self._denied: dict[str, LinkLine | None] = {}  # by thread: said, but perhaps only to remember a decision

    def read(self, line: str) -> LinkLine | None:
        """The event of a line, or None."""
        line = _COLOUR.sub("", line).strip()
        if (match := self._link.fullmatch(line)) is not None:
            return LinkLine(LinkEvent(match["event"]), "" if match["name"] == "-" else match["name"], match["address"])
        if (match := _HANDSHAKE.search(line)) is not None:
            return LinkLine(LinkEvent.REJECTED, "", match["why"])
        thread = _thread(line)
        if (match := _DENIED.search(line)) is not None:
            self._denied[thread] = LinkLine(
                LinkEvent.REFUSED, match["name"], f"{match['action'].lower()} {match['key']}"
            )
        elif _OUTWARD.search(line) is not None:
            self._denied[thread] = None
        elif _DROPPED in line:
            return self._denied.pop(thread, LinkLine(LinkEvent.REFUSED, "", "a message"))
        else:
            self._denied.pop(thread, None)
        return None


def _thread(line: str) -> str:
    match = re.search(r"ThreadId\(\d+\)", line)
    return match[0] if match is not None else ""
