# SPDX-License-Identifier: Apache-2.0
"""The row of one recording in the catalogue: what it says of its drive. docs/batch.md names the columns."""

from dataclasses import dataclass, field
from math import hypot
from pathlib import Path
from typing import Any

from shared import topics
from shared.codec import CodecError, decode
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import (
    BaseStatus,
    Contacts,
    GuardStatus,
    Localization,
    Message,
    NavStatus,
    Odometry,
    PoseEstimate,
    Truth,
)
from shared.recording import Entry, Recording
from shared.types import NS_PER_S
from zenav.batch.catalogue import TAG
from zenav.batch.storage import StoredLog, content_version, local_copy
from zenav.batch.table import Row
from zenav.metrics.nav_counts import NavCounts
from zenav.recording.opening import open_recording
from zenav.recording.selection import begin_of, end_of

READ = (
    topics.ODOM, topics.POSE, topics.NAV_STATUS, topics.GUARD, topics.BASE_STATUS, topics.TRUTH, topics.CONTACTS,
)  # fmt: skip


@dataclass(slots=True)
class RecordingFigures:
    """What one recording says of its drive; `add` its entries in their order."""

    driven: float = 0.0  # m, by odometry
    contact: bool = False
    lost: int = 0
    nav: NavCounts = field(default_factory=NavCounts)
    stops: set[str] = field(default_factory=set)
    faults: set[str] = field(default_factory=set)
    _at: Pose2 | None = None

    def add(self, entry: Entry) -> None:
        topic = topics.topic_of(entry.key)
        if topic not in READ:
            return
        try:
            self._add(decode(topic.type, entry.payload)[0])
        except CodecError:
            return

    def _add(self, message: Message) -> None:
        if isinstance(message, Odometry):
            pose = message.odom_from_base
            if self._at is not None:
                self.driven += hypot(pose.x - self._at.x, pose.y - self._at.y)
            self._at = pose
        elif isinstance(message, PoseEstimate):
            self.lost += message.state is Localization.LOST
        elif isinstance(message, NavStatus):
            self.nav.add(message)
        elif isinstance(message, GuardStatus) and message.reason:
            self.stops.add(message.reason)
        elif isinstance(message, BaseStatus) and message.fault:
            self.faults.add(message.fault)
        elif isinstance(message, Truth):
            self.contact |= message.n_contacts > 0
        elif isinstance(message, Contacts):
            self.contact |= bool(message.bumpers)


def recording_row(source: StoredLog) -> Row:
    """The row of a recording. Raises UserError where the store does not give it."""
    with local_copy(source.url) as path:
        return row_of_file(path, source)


def row_of_file(path: Path, source: StoredLog) -> Row:
    """The row of a recording by its file here. A file that is no recording, or a newer one, is `refused`."""
    row: Row = {"recording": source.url, "size": source.size, TAG: content_version(source)}
    try:
        figures = _figures(open_recording(path))
    except UserError as error:
        return {**row, "state": "refused", "error": error.what.replace(str(path), source.url)}
    return {**row, "state": "done", "error": "", **figures}


def _figures(recording: Recording) -> dict[str, Any]:
    figures = RecordingFigures()
    for entry in recording.entries(topic.key for topic in READ):
        figures.add(entry)
    keys = {source.recorded.key for source in recording.sources.values()}
    services = {key.rpartition("/")[2] for key in keys if topics.topic_of(key) in (topics.HEALTH, topics.JOURNAL)}
    begin, end = begin_of(recording), end_of(recording)
    return {
        "robot": recording.about.get("robot", ""),
        "host": recording.about.get("host", ""),
        "started": begin // 1000,
        "duration": (end - begin) / NS_PER_S,
        "driven": round(figures.driven, 3),
        "contact": figures.contact,
        "lost": figures.lost,
        "goals": figures.nav.n_reached,
        "failed": figures.nav.n_failed,
        "recoveries": figures.nav.n_recoveries,
        "stops": sorted(figures.stops),
        "faults": sorted(figures.faults),
        "services": sorted(services),
    }
