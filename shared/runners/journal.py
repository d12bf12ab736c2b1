# SPDX-License-Identifier: Apache-2.0
"""Reader of journals: the events of a service in their order. shared/runners/host.py writes them."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import msgpack

from shared.messages import Journal
from shared.rejections import RejectionCause
from shared.runners.host import DONE, LATCHED, MESSAGE, REJECTED, REQUEST, SHUTDOWN, SOURCE, TICK

HOLE = -1
"""Kind of an event in place of lost journal entries, `number` of them."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event of a service, see shared/runners/host.py.

    number: sequence, tick, job, length of a hole, or number of rejected messages.  why, words: cause of a rejection.
    """

    kind: int
    now: int
    number: int = 0
    key: str = ""
    session: str = ""
    payload: bytes = b""
    why: str = ""
    words: str = ""


@dataclass(frozen=True, slots=True)
class Life:
    """One session of a service."""

    name: str
    session: str
    events: list[Event]


def events_of(journals: Iterable[Journal]) -> list[Event]:
    """The events of one session's journals, in any order, with a hole where some are missing or not valid."""
    events: list[Event] = []
    expected = 0
    for journal in sorted(journals, key=lambda j: j.first):
        if journal.first < expected:
            continue  # recorded twice
        try:
            sources: dict[int, tuple[str, str]] = {}
            read = [_event(entry, sources) for entry in msgpack.unpackb(journal.events, use_list=False)]
        except Exception:  # msgpack raises a dozen kinds on foreign bytes: a hole, like a journal that is missing
            continue
        if journal.first > expected:
            events.append(Event(HOLE, events[-1].now if events else 0, journal.first - expected))
        events += [event for event in read if event is not None]
        expected = journal.first + len(read)
    return events


def _event(entry: Any, sources: dict[int, tuple[str, str]]) -> Event | None:
    """An entry of a journal as an event; None for one that names a source. Raises where it is neither."""
    kind = entry[0]
    if kind == SOURCE:
        _, number, key, session = entry
        sources[number] = (str(key), str(session))
        return None
    if kind in (MESSAGE, LATCHED):
        _, now, source, sequence = entry
        key, session = sources[source]
        return Event(kind, int(now), number=int(sequence), key=key, session=session)
    if kind in (TICK, DONE):
        _, now, number = entry
        return Event(kind, int(now), int(number))
    if kind == REQUEST:
        _, now, key, payload = entry
        return Event(kind, int(now), key=str(key), payload=bytes(payload))
    if kind == REJECTED:
        _, now, key, why, words, n = entry
        return Event(kind, int(now), int(n), str(key), why=str(RejectionCause(why)), words=str(words))
    if kind == SHUTDOWN:
        return Event(kind, int(entry[1]))
    raise ValueError(f"unknown event {kind!r}")
