# SPDX-License-Identifier: Apache-2.0
"""Behind `zenav replay FILE --through NAMES --out OUT`: where do today's services leave what they once published?"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from shared import topics
from shared.codec import CodecError, envelope_of
from shared.config import UserError, nearest
from shared.recording import CONFIG, Recording, Writer
from shared.runners.host import Sent
from shared.runners.replay import Build, JobRun, Progress, Replayed, ReplayGap, replay
from zenav.recording.new_recording import new_recording
from zenav.recording.selection import check_not_written
from zenav.replay.comparison import Tolerances, TopicReport
from zenav.replay.player_clock import contents

MAX_GAPS = 20  # gaps with a line of their own


@dataclass(slots=True)
class ReplayReport:
    """What a replay showed. `equal`: nothing differs and nothing lacks. began, ended: of the recording, ns."""

    topics: list[TopicReport]
    notes: list[str] = field(default_factory=list)
    jobs: list[JobRun] = field(default_factory=list)
    began: int = 0
    ended: int = 0

    @property
    def equal(self) -> bool:
        return all(topic.equal for topic in self.topics)


def replay_file(
    path: Path,
    names: list[str],
    out: Path | None,
    build: Build,
    progress: Progress,
    tolerances: Tolerances = MappingProxyType({}),
    config: str = "",
) -> ReplayReport:
    """Replays services of a recording, writes their messages, and compares them with the recorded ones.

    out: the recording with the named services' messages in place of the recorded ones.   config: the configuration of
    the replay, where it differs from the recorded one.
    Raises UserError where the file or the names are wrong. Exceptions of a service pass.
    """
    for name in names:
        if name not in topics.SERVICES:
            raise UserError(f"{name} is not a service", nearest(name, topics.SERVICES))
    recording = Recording(path)
    if out is not None and out.exists() and out.samefile(path):
        raise UserError(f"{out} is the recording itself", "choose another name for --out")
    if out is not None:
        check_not_written(out)
    replayed = replay(recording, list(dict.fromkeys(names)), build, progress)
    if out is not None:
        write_replayed(out, recording, replayed, {CONFIG: config.encode()} if config else {})
    there = contents(recording)
    report = compare_replayed(replayed, tolerances, there.first)
    report.notes += recording.problems
    report.ended = there.last
    return report


def gap_notes(gaps: list[ReplayGap], began: int) -> list[str]:
    """What is missing, in words; the first of each service is where its equal bytes end. began: the recording, ns."""
    notes, names = [], set[str]()
    for gap in gaps[:MAX_GAPS]:
        where = "equal bytes are not promised from here on: " if gap.name not in names else ""
        names.add(gap.name)
        notes.append(f"{where}+{(gap.now - began) / 1e9:.3f} s {gap}")
    return [*notes, *([f"and {len(gaps) - MAX_GAPS} gaps more"] if len(gaps) > MAX_GAPS else [])]


def compare_replayed(replayed: Replayed, tolerances: Tolerances = MappingProxyType({}), began: int = 0) -> ReplayReport:
    """Compares recorded and replayed messages by topic, session and sequence. began: ns, the recording's start."""
    reports: dict[str, TopicReport] = {}
    pending = {source: dict(payloads) for source, payloads in replayed.recorded.items()}
    for sent in (sent for of_name in replayed.sent.values() for sent in of_name):
        topic = reports.setdefault(sent.key, TopicReport(sent.key))
        recorded = pending.get((sent.key, sent.envelope.session), {}).pop(sent.envelope.sequence, None)
        if recorded is None:
            topic.n_new += 1
        else:
            topic.add(recorded, sent.payload, tolerances)
    for (key, session), payloads in pending.items():
        topic = reports.setdefault(key, TopicReport(key))
        for sequence, payload in payloads.items():
            if envelope_of(payload).sent >= replayed.until[session]:
                topic.n_beyond += 1
            else:
                topic.n_lacking += 1
                topic.first = topic.first or f"#{sequence}: not published any more"
    notes = gap_notes(replayed.gaps, began)
    if not replayed.journalled:
        notes.append("there are no journals: fed in the order of the stamps, so nothing is promised or compared")
    return ReplayReport([reports[key] for key in sorted(reports)], notes, replayed.jobs, began)


def compare_files(
    before: Recording, now: Recording, names: list[str] | None = None, tolerances: Tolerances = MappingProxyType({})
) -> ReplayReport:
    """Two recordings message by message: by session and sequence, or in their order where they share no session.

    names: of the services whose messages count; None is all. Health and journals do not count.
    """
    was, is_ = _by_key(before, names), _by_key(now, names)
    reports, notes = [], []
    for key in sorted({*was, *is_}):
        report = TopicReport(key)
        old, new = was.get(key, {}), is_.get(key, {})
        if old and new and not {session for session, _ in old} & {session for session, _ in new}:
            notes.append(f"{key}: other sessions, so compared in the order of sending")
            old, new = ({("", i): payload for i, payload in enumerate(of.values())} for of in (old, new))
        for at, payload in old.items():
            if at in new:
                report.add(payload, new[at], tolerances)
            else:
                report.n_lacking += 1
                report.first = report.first or f"#{at[1]}: not there any more"
        report.n_new = len(new.keys() - old.keys())
        reports.append(report)
    began = next((entry.log_time for entry in now.entries()), 0)
    return ReplayReport(reports, [*notes, *before.problems, *now.problems], began=began)


def _by_key(recording: Recording, names: list[str] | None) -> dict[str, dict[tuple[str, int], bytes]]:
    payloads: dict[str, dict[tuple[str, int], bytes]] = {}
    for entry in recording.entries():
        if topics.topic_of(entry.key) in (topics.HEALTH, topics.JOURNAL):
            continue
        try:
            envelope = envelope_of(entry.payload)
        except CodecError:
            continue
        if names is None or envelope.publisher in names:
            payloads.setdefault(entry.key, {})[(envelope.session, envelope.sequence)] = entry.payload
    return payloads


def write_replayed(out: Path, recording: Recording, replayed: Replayed, attachments: Mapping[str, bytes]) -> None:
    """Writes the recording with the replayed sessions' messages in place of their recorded ones. Raises UserError.

    A message that was not recorded is placed by its send time. attachments: they replace the recording's of that name.
    """
    reprocessed = {
        (sent.key, sent.envelope.session, sent.envelope.sequence): sent
        for of_name in replayed.sent.values()
        for sent in of_name
    }
    recorded = {(*source, sequence) for source, payloads in replayed.recorded.items() for sequence in payloads}
    extra = sorted(
        (sent for at, sent in reprocessed.items() if at not in recorded), key=lambda sent: -sent.envelope.sent
    )
    about = {**recording.about, "replayed": ",".join(replayed.sent)}
    with new_recording(out, recording, about, {**recording.attachments, **attachments}) as writer:
        for entry in recording.entries():
            while extra and extra[-1].envelope.sent <= entry.log_time:
                _write_sent(writer, extra.pop())
            try:
                envelope = None if entry.latched else envelope_of(entry.payload)
            except CodecError:
                envelope = None
            if envelope is None:
                writer.copy(entry)
                continue
            at = (entry.key, envelope.session, envelope.sequence)
            if at in recorded and at in reprocessed:
                _write_sent(writer, reprocessed[at], entry.log_time)
            elif at in recorded:
                if envelope.sent >= replayed.until[envelope.session]:
                    writer.copy(entry)
            elif replayed.journalled or envelope.publisher not in replayed.sent:
                writer.copy(entry)
        while extra:
            _write_sent(writer, extra.pop())


def _write_sent(writer: Writer, sent: Sent, log_time: int | None = None) -> None:
    at = sent.envelope.sent if log_time is None else log_time
    writer.write(sent.key, sent.topic.type, sent.payload, at, sent.envelope.sent, sent.envelope.sequence)
