# SPDX-License-Identifier: Apache-2.0
"""Behind `zenav replay FILE --through NAMES --out OUT`: where do today's services leave what they once published?"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from shared import topics
from shared.codec import CodecError, decode, envelope_of, fields_of
from shared.config import RobotFile, UserError, nearest
from shared.recording import CONFIG, Recording, Writer
from shared.runners.host import Sent
from shared.runners.replay import Build, Progress, Replayed, replay


@dataclass(slots=True)
class TopicReport:
    """One key, recorded against published anew.

    n_lacking: recorded but not published anew.   n_new: published anew but not recorded.   n_beyond: recorded after the
    last journal of its service, so not replayed.   first: the first difference, in words; empty where there is none.
    """

    key: str
    n_equal: int = 0
    n_different: int = 0
    n_lacking: int = 0
    n_new: int = 0
    n_beyond: int = 0
    first: str = ""


@dataclass(slots=True)
class Report:
    """What a replay showed. `equal`: nothing differs and nothing lacks."""

    topics: list[TopicReport]
    notes: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        return not any(topic.n_different or topic.n_lacking for topic in self.topics)


def robot_file(recording: Recording) -> RobotFile | None:
    """The configuration that a recording was made with, or None where it holds none. Raises UserError."""
    text = recording.attachments.get(CONFIG)
    if text is None:
        return None
    try:
        tree = YAML(typ="rt").load(text.decode())
    except (YAMLError, UnicodeDecodeError):
        tree = None
    if not isinstance(tree, CommentedMap):
        raise UserError(f"{recording.path}: its configuration is damaged", "name a robot: --robot x80sv")
    return RobotFile(recording.path / CONFIG, tree)


def replay_file(path: Path, names: list[str], out: Path | None, build: Build, progress: Progress) -> Report:
    """Replays services of a recording, writes what comes out of it, and compares.

    `out` is the recording with the named services' messages in place of the recorded ones, all else as it was. Raises
    UserError where the file or the names are wrong.
    """
    for name in names:
        if name not in topics.SERVICES:
            raise UserError(f"{name} is not a service", nearest(name, topics.SERVICES))
    recording = Recording(path)
    if out is not None and out.exists() and out.samefile(path):
        raise UserError(f"{out} is the recording itself", "choose another name for --out")
    replayed = replay(recording, list(dict.fromkeys(names)), build, progress)
    if out is not None:
        try:
            write(out, recording, replayed)
        except OSError as error:
            raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None
    report = compare(replayed)
    report.notes += recording.problems
    return report


def compare(replayed: Replayed) -> Report:
    """Recorded against published anew, topic by topic, and by sequence within each session."""
    found: dict[str, TopicReport] = {}
    pending = {source: dict(payloads) for source, payloads in replayed.recorded.items()}
    for sent in (sent for of_name in replayed.sent.values() for sent in of_name):
        topic = found.setdefault(sent.key, TopicReport(sent.key))
        recorded = pending.get((sent.key, sent.envelope.session), {}).pop(sent.envelope.sequence, None)
        if recorded is None:
            topic.n_new += 1
        elif recorded == sent.payload:
            topic.n_equal += 1
        else:
            topic.n_different += 1
            topic.first = topic.first or f"#{sent.envelope.sequence}: {difference(sent, recorded)}"
    for (key, session), payloads in pending.items():
        topic = found.setdefault(key, TopicReport(key))
        for sequence, payload in payloads.items():
            if envelope_of(payload).sent >= replayed.until[session]:
                topic.n_beyond += 1
            else:
                topic.n_lacking += 1
                topic.first = topic.first or f"#{sequence}: not published any more"
    notes = [str(gap) for gap in replayed.gaps]
    if not replayed.journalled:
        notes.append("there are no journals: fed in the order of the stamps, so nothing is promised or compared")
    return Report([found[key] for key in sorted(found)], notes)


def difference(sent: Sent, recorded: bytes) -> str:
    """The first field in which a message differs from its recorded bytes."""
    try:
        before, envelope = decode(sent.topic.type, recorded)
        now, _ = decode(sent.topic.type, sent.payload)
    except CodecError as error:
        return f"what was recorded is not valid in this version: {error}"
    for name in (row.name for row in fields_of(sent.topic.type)):
        words = _words(getattr(before, name), getattr(now, name))
        if words:
            return f"{name} {words}"
    return f"sent at {sent.envelope.sent} ns, recorded {envelope.sent} ns"


def _words(before: Any, now: Any) -> str:
    """How two values of a field differ; empty where they do not."""
    if not isinstance(now, np.ndarray):
        return "" if repr(before) == repr(now) else f"is {now!r}, was {before!r}"
    if before.shape != now.shape:
        return f"has shape {now.shape}, had {before.shape}"
    places = np.argwhere(~((before == now) | ((before != before) & (now != now))))
    if not len(places):
        return ""
    first = tuple(int(i) for i in places[0])
    return f"{list(first)} is {now[first]!r}, was {before[first]!r} ({len(places)} of {now.size} differ)"


def write(out: Path, recording: Recording, replayed: Replayed) -> None:
    """The recording, with what the replayed sessions published anew where their own messages lay. Raises OSError.

    What was not recorded comes in where it was sent.
    """
    anew = {
        (sent.key, sent.envelope.session, sent.envelope.sequence): sent
        for of_name in replayed.sent.values()
        for sent in of_name
    }
    known = {(*source, sequence) for source, payloads in replayed.recorded.items() for sequence in payloads}
    extra = sorted((sent for at, sent in anew.items() if at not in known), key=lambda sent: -sent.envelope.sent)
    about = {**recording.about, "replayed": ",".join(replayed.sent)}
    with Writer(out, about, recording.attachments) as writer:
        for entry in recording.entries():
            while extra and extra[-1].envelope.sent <= entry.log_time:
                _add(writer, extra.pop())
            try:
                envelope = None if entry.latched else envelope_of(entry.payload)
            except CodecError:
                envelope = None
            if envelope is None:
                writer.copy(entry)
                continue
            at = (entry.key, envelope.session, envelope.sequence)
            if at in known and at in anew:
                _add(writer, anew[at], entry.log_time)
            elif at in known:
                if envelope.sent >= replayed.until[envelope.session]:
                    writer.copy(entry)
            elif replayed.journalled or envelope.publisher not in replayed.sent:
                writer.copy(entry)
        while extra:
            _add(writer, extra.pop())


def _add(writer: Writer, sent: Sent, log_time: int | None = None) -> None:
    at = sent.envelope.sent if log_time is None else log_time
    writer.write(sent.key, sent.topic.type, sent.payload, at, sent.envelope.sent, sent.envelope.sequence)
