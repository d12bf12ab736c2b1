# SPDX-License-Identifier: Apache-2.0
"""Requests with an answer: a key, the service that answers, a typed request and a typed reply. Zenoh queries, live."""

from dataclasses import dataclass
from typing import Annotated, Generic, TypeVar

from shared import messages as m
from shared.messages import Count, Flag, Message, Pose, Text, Unit

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)


@dataclass(frozen=True, slots=True)
class Reply(Message):
    """Taken, or refused with the reason and its mend; `task_id` is the navigator's number for what was started."""

    accepted: Flag
    reason: Text
    detail: Text
    task_id: Count = 0


@dataclass(frozen=True, slots=True)
class Navigate(Message):
    """Drive through these poses in `map`, dwelling at each. NaN-free; `any_heading` ignores the poses' yaw."""

    poses: Annotated[tuple[Pose, ...], Unit("m, m, rad")]
    dwell: m.Seconds
    loops: Annotated[int, Unit("rounds; 0 is for ever"), m.Within(0, 10**6)]
    any_heading: Flag

    def problem(self) -> str | None:
        return None if self.poses else "a route of no poses"


@dataclass(frozen=True, slots=True)
class Explore(Message):
    """Explore until no reachable frontier is left."""


@dataclass(frozen=True, slots=True)
class Cancel(Message):
    """Drop the task and stand."""


@dataclass(frozen=True, slots=True)
class Pause(Message):
    """Stand where you are and keep the task (`paused`), or go on."""

    paused: Flag


@dataclass(frozen=True, slots=True)
class LoadMap(Message):
    """Take this map (its tool read the file; saving is the tool's too, from the latched `map`) and start on it."""

    map: Annotated[m.MapUpdate, Unit("tiles")]
    map_from_base: Pose


@dataclass(frozen=True, slots=True)
class Break(Message):
    """Let this fault of the emulated hardware begin, for so many seconds (0: until it is mended), or end it (`mended`).

    `fault` is a name of services/sim/hardware/faults.py; to mend, it may be empty: all of them.
    """

    fault: Text
    seconds: m.Seconds
    mended: Flag


@dataclass(frozen=True, slots=True)
class Request(Generic[Q, R]):
    """One row: `by` is the service that answers."""

    key: str
    request: type[Q]
    reply: type[R]
    by: str


NAVIGATE = Request("request/navigate", Navigate, Reply, by="navigator")
EXPLORE = Request("request/explore", Explore, Reply, by="navigator")
CANCEL = Request("request/cancel", Cancel, Reply, by="navigator")
PAUSE = Request("request/pause", Pause, Reply, by="navigator")
LOAD_MAP = Request("request/load_map", LoadMap, Reply, by="mapper")
FAULT = Request("request/fault", Break, Reply, by="sim")

REQUESTS: tuple[Request[Message, Message], ...] = tuple(r for r in list(globals().values()) if isinstance(r, Request))
