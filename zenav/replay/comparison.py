# SPDX-License-Identifier: Apache-2.0
"""Two runs, message by message and field by field: how many differ, which first, which most, and within what."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from math import inf, isnan
from typing import Any, NamedTuple

import numpy as np

from shared import topics
from shared.codec import CodecError, Envelope, decode, envelope_of, fields_of
from shared.config import UserError, nearest
from shared.geometry import Pose2, wrapped
from shared.messages import Message
from shared.topics import SERVICES, TOPICS, Topic

Tolerances = Mapping[str, float]
"""By `topic`, `topic.field` or `topic.field.x`, how far a number may be off, in its unit."""
POSE = ("x", "y", "yaw")


class FieldDifference(NamedTuple):
    """One field of one message: how far it is off (infinite where that is no number), and in words."""

    field: str
    by: float
    text: str


@dataclass(frozen=True, slots=True)
class DifferencePosition:
    """Where a difference is: sequence within its session, time of sending (ns), and the difference."""

    sequence: int
    sent: int
    off: FieldDifference


@dataclass(slots=True)
class FieldReport:
    """Where a field is off by more than it may be."""

    field: str
    first: DifferencePosition
    largest: DifferencePosition
    n: int = 1


@dataclass(slots=True)
class TopicReport:
    """One key, before against now.

    n_equal: to the byte.   n_within: not that, but nothing is off by more than its tolerance.   n_lacking: was there
    and is no more.   n_new: was not there.   n_beyond: recorded after the last journal of its service, so not
    replayed.   first: the first difference, in words; empty where there is none.
    """

    key: str
    n_equal: int = 0
    n_different: int = 0
    n_lacking: int = 0
    n_new: int = 0
    n_beyond: int = 0
    first: str = ""
    n_within: int = 0
    fields: dict[str, FieldReport] = field(default_factory=dict)

    @property
    def equal(self) -> bool:
        """Nothing differs by more than it may, and nothing lacks."""
        return not (self.n_different or self.n_lacking)

    def add(self, before: bytes, now: bytes, tolerances: Tolerances) -> None:
        """Counts a message that is there twice: its bytes before and now."""
        if before == now:
            self.n_equal += 1
            return
        envelope = envelope_of(now)
        beyond = [off for off in differences(self.key, before, now) if not is_tolerated(tolerances, self.key, off)]
        if not beyond:
            self.n_within += 1
            return
        self.n_different += 1
        self.first = self.first or f"#{envelope.sequence}: {beyond[0].field} {beyond[0].text}"
        for off in beyond:
            place = DifferencePosition(envelope.sequence, envelope.sent, off)
            report = self.fields.get(off.field)
            if report is None:
                self.fields[off.field] = FieldReport(off.field, place, place)
            else:
                report.n += 1
                report.largest = place if off.by > report.largest.off.by else report.largest


def tolerances_from(assignments: Iterable[str]) -> Tolerances:
    """From words like `pose.map_from_base=0.01`. Raises UserError on an unknown topic or field, or no number."""
    tolerances: dict[str, float] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        try:
            tolerances[name] = float(text)
        except ValueError:
            tolerances[name] = -1.0
        if not equals or not tolerances[name] >= 0:
            raise UserError(f"{assignment!r} is no tolerance", "write TOPIC.FIELD=VALUE, like pose.map_from_base=0.01")
        _check_name(name)
    return tolerances


def _check_name(name: str) -> None:
    key, *path = name.split(".")
    keys = [k for t in TOPICS for k in ([t.key] if t.by != "*" else [f"{t.key}/{s}" for s in SERVICES])]
    topic = topics.topic_of(key)
    if topic is None or key not in keys:
        raise UserError(f"{key} is not a topic", nearest(key, tuple(keys)))
    rows = {row.name: row for row in fields_of(topic.type)}
    if path and path[0] not in rows:
        raise UserError(f"{key} has no field {path[0]}", nearest(path[0], tuple(rows)))
    if len(path) > 2 or (len(path) == 2 and (rows[path[0]].kind is not Pose2 or path[1] not in POSE)):
        raise UserError(f"{'.'.join(path)} is no field of {key}", f"name {key}.{path[0]}")


def is_tolerated(tolerances: Tolerances, key: str, off: FieldDifference) -> bool:
    """Whether a field may be off by so much: the most exact name of it that has a tolerance counts; none is none."""
    names = f"{key}.{off.field}", f"{key}.{off.field.partition('.')[0]}", key
    return off.by <= next((tolerances[name] for name in names if name in tolerances), -1.0)


def differences(key: str, before: bytes, now: bytes) -> list[FieldDifference]:
    """The fields in which two messages of a key differ, in their order; the time of sending last."""
    topic = topics.topic_of(key)
    if topic is None:
        return [FieldDifference("bytes", inf, "differ")]
    try:
        was, sent = _decoded(topic, before)
        is_, sends = _decoded(topic, now)
    except CodecError as error:
        return [FieldDifference("bytes", inf, f"cannot be compared: one is not valid in this version: {error}")]
    differing = [
        off for row in fields_of(topic.type) for off in _off(row.name, getattr(was, row.name), getattr(is_, row.name))
    ]
    if sends.sent != sent.sent:
        differing.append(
            FieldDifference("sent", abs(sends.sent - sent.sent), f"is {sends.sent} ns, was {sent.sent} ns")
        )
    return differing or [FieldDifference("bytes", inf, "differ though every field is the same")]


def _decoded(topic: Topic[Message], payload: bytes) -> tuple[Message, Envelope]:
    return decode(topic.type, payload)


def _off(name: str, before: Any, now: Any) -> Iterator[FieldDifference]:
    """How two values of a field differ; nothing where they do not."""
    if isinstance(now, Pose2) and isinstance(before, Pose2):
        for part in POSE:
            a, b = getattr(before, part), getattr(now, part)
            if a != b:
                by = abs(wrapped(b - a)) if part == "yaw" else abs(b - a)
                yield FieldDifference(f"{name}.{part}", by, f"is {b!r}, was {a!r}")
    elif isinstance(now, np.ndarray):
        yield from _off_array(name, before, now)
    elif repr(before) != repr(now):  # NaN is NaN, 0.0 is not -0.0
        number = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in (before, now))
        by = abs(now - before) if number else inf
        yield FieldDifference(name, inf if isnan(by) else by, f"is {now!r}, was {before!r}")


def _off_array(name: str, before: Any, now: Any) -> Iterator[FieldDifference]:
    if before.shape != now.shape:
        yield FieldDifference(name, inf, f"has shape {now.shape}, had {before.shape}")
        return
    unlike = ~((before == now) | ((before != before) & (now != now)))
    places = np.argwhere(unlike)
    if not len(places):
        return
    first = tuple(int(i) for i in places[0])
    with np.errstate(invalid="ignore"):
        by = float(np.abs(now[unlike].astype(float) - before[unlike].astype(float)).max())
    text = f"{list(first)} is {now[first].item()!r}, was {before[first].item()!r} ({len(places)} of {now.size} differ)"
    yield FieldDifference(name, inf if isnan(by) else by, text)


def comparison_lines(reports: Iterable[TopicReport], epoch: int) -> list[str]:
    """Lines for each field that differs: how often, where first, where most. epoch: ns, zero of the printed times."""
    lines = []
    for topic in reports:
        for row in topic.fields.values():
            lines.append(f"{topic.key}.{row.field}: {row.n} off")
            lines.append(f"    first   {_place(row.first, epoch)}")
            if row.largest is not row.first:
                lines.append(f"    largest {_place(row.largest, epoch)}")
    return lines


def _place(place: DifferencePosition, epoch: int) -> str:
    by = "" if place.off.by == inf else f", off by {place.off.by:.6g}"
    return f"+{(place.sent - epoch) / 1e9:.3f} s #{place.sequence}: {place.off.text}{by}"
