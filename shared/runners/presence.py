# SPDX-License-Identifier: Apache-2.0
"""Which computers run a robot of a name: a Zenoh liveliness token of each `zenav up`, which ends with its process.

Its key is NAME/@up/START/HOST/PID/VERSION. No wildcard matches a part that begins with @, so recorders do not see it.
"""

import os
import socket
import time
from dataclasses import dataclass
from importlib.metadata import version

import zenoh

from shared.config import UserError
from shared.crossing import PRESENCE

ANSWER_S = 1.0  # s that a router has to send the tokens of others


@dataclass(frozen=True, slots=True, order=True)
class Presence:
    """One `zenav up` of the robot `name`. start: ns on its host's clock."""

    start: int
    host: str
    pid: int
    version: str
    name: str

    @property
    def key(self) -> str:
        return f"{self.name}/{PRESENCE}/{self.start}/{self.host}/{self.pid}/{self.version}"

    @property
    def address(self) -> str:
        """For people: host and process."""
        return f"{self.host} (pid {self.pid})"


def presence_of(key: str) -> Presence | None:
    """What a token's key says; None where it is no such token."""
    parts = key.split("/")
    if len(parts) != 6 or parts[1] != PRESENCE or not (parts[2].isdecimal() and parts[4].isdecimal()):
        return None
    return Presence(int(parts[2]), parts[3], int(parts[4]), parts[5], parts[0])


def own_presence(name: str) -> Presence:
    """This process as the robot `name`."""
    host = "".join(c if c.isalnum() or c in "-._" else "-" for c in socket.gethostname()) or "unknown"
    return Presence(time.time_ns(), host, os.getpid(), version("zenav"), name)


def presences(session: zenoh.Session, name: str = "*") -> list[Presence]:
    """Every `zenav up` of a name that this session can see, in the order of their starts."""
    replies = session.liveliness().get(f"{name}/{PRESENCE}/**", timeout=ANSWER_S)
    found = (presence_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None)
    return sorted(presence for presence in found if presence is not None)


def announce(session: zenoh.Session, name: str, is_shared: bool) -> zenoh.LivelinessToken:
    """Shows this robot to the others until its token is undeclared, or lost.

    is_shared: whether other computers may be in the stack. Then it raises UserError where another robot of this name
    has begun before, with both addresses. A stack on loopback has one robot: its ports are taken.
    """
    own = own_presence(name)
    token = session.liveliness().declare_token(own.key)
    earlier = [other for other in presences(session, name) if other < own] if is_shared else []
    if earlier:
        token.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own
        raise UserError(
            f"{earlier[0].address} is a robot named {name} already, and {own.address} would be another",
            "give each one its own name: zenav up --name NAME",
        )
    return token
