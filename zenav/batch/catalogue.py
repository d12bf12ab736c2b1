# SPDX-License-Identifier: Apache-2.0
"""The catalogue of a folder or bucket of recordings: one row a recording, as Parquet; docs/batch.md names the columns.

A recording that is in it with the same size and change is not read again.
"""

import sys
from dataclasses import dataclass, field
from io import BytesIO
from math import hypot
from typing import TYPE_CHECKING, Any

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
    NavState,
    NavStatus,
    Odometry,
    PoseEstimate,
    Truth,
)
from shared.recording import Entry, Recording
from shared.types import NS_PER_S
from zenav.batch.child_process import Outcome, TryLimits
from zenav.batch.engine import results
from zenav.batch.storage import Folder, StoredLog, local_copy, sources
from zenav.batch.table import Row
from zenav.recording.opening import open_recording
from zenav.recording.selection import begin_of, end_of

if TYPE_CHECKING:
    from pyarrow import Table

FILE, TAG = "catalogue.parquet", "tag"
READ = (
    topics.ODOM, topics.POSE, topics.NAV_STATUS, topics.GUARD, topics.BASE_STATUS, topics.TRUTH, topics.CONTACTS,
)  # fmt: skip
COLUMNS: dict[str, str] = {
    "recording": "VARCHAR", "state": "VARCHAR", "error": "VARCHAR", "robot": "VARCHAR", "host": "VARCHAR",
    "started": "TIMESTAMP", "duration": "DOUBLE", "size": "BIGINT", "driven": "DOUBLE",
    "contact": "BOOLEAN", "lost": "BIGINT", "goals": "BIGINT", "failed": "BIGINT", "recoveries": "BIGINT",
    "stops": "VARCHAR[]", "faults": "VARCHAR[]", "services": "VARCHAR[]",
}  # fmt: skip
"""Type by name: s, bytes, m; lost: poses; goals and failed: tasks; stops and faults: codes of reasons."""


@dataclass(slots=True)
class RecordingFigures:
    """What one recording says of its drive; `add` its entries in their order."""

    driven: float = 0.0  # m, by odometry
    contact: bool = False
    lost: int = 0
    goals: int = 0
    failed: int = 0
    recoveries: int = 0
    stops: set[str] = field(default_factory=set)
    faults: set[str] = field(default_factory=set)
    _at: Pose2 | None = None
    _nav: NavStatus | None = None

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
            self._add_status(message)
        elif isinstance(message, GuardStatus) and message.reason:
            self.stops.add(message.reason)
        elif isinstance(message, BaseStatus) and message.fault:
            self.faults.add(message.fault)
        elif isinstance(message, Truth):
            self.contact |= message.n_contacts > 0
        elif isinstance(message, Contacts):
            self.contact |= bool(message.bumpers)

    def _add_status(self, status: NavStatus) -> None:
        before = self._nav
        is_new = before is None or (before.task_id, before.state) != (status.task_id, status.state)
        self.goals += is_new and status.state is NavState.REACHED
        self.failed += is_new and status.state is NavState.FAILED
        if before is None or before.task_id != status.task_id:
            self.recoveries += status.n_recoveries
        else:
            self.recoveries += max(status.n_recoveries - before.n_recoveries, 0)
        self._nav = status


def recording_row(source: StoredLog) -> Row:
    """The row of a recording. A file that is none is `refused`. Raises UserError where the store does not give it."""
    with local_copy(source.url) as path:
        try:
            recording = open_recording(path)
        except UserError as error:
            return {"recording": source.url, "state": "refused", "error": error.what.replace(str(path), source.url)}
        return {"recording": source.url, "state": "done", "error": "", **_figures(recording), "size": source.size}


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
        "goals": figures.goals,
        "failed": figures.failed,
        "recoveries": figures.recoveries,
        "stops": sorted(figures.stops),
        "faults": sorted(figures.faults),
        "services": sorted(services),
    }


def update(place: str, jobs: int) -> "Table":
    """The catalogue of a place, brought up to date: new and changed recordings are read, rows of others stay.

    Raises UserError where the place has no recording, or its store refuses.
    """
    import pyarrow as pa

    folder = Folder(place)
    before = stored(folder)
    columns = [] if before is None else [before[name].to_pylist() for name in ("recording", TAG)]
    known = list(zip(*columns, strict=True))
    found = {(source.url, _tag(source)): source for source in sources([place]) if source.url.endswith(".mcap")}
    new = [found[key] for key in sorted(found.keys() - set(known))]
    if before is not None and not new and len(found) == len(known):
        return before
    rows = []
    for i, (source, outcome) in enumerate(results(recording_row, new, jobs, limits=TryLimits())):
        rows.append(_row_of(source, outcome))
        sys.stderr.write(f"{i + 1} of {len(new)}: {source.url}\n")
    tables = [table_of(rows)]
    if before is not None:
        tables.append(before.filter(pa.array([key in found for key in known], pa.bool_())))
    table = pa.concat_tables(tables)
    folder.write(FILE, _parquet(table))
    return table


def stored(folder: Folder) -> "Table | None":
    """The catalogue of a folder as it is; None where it has none, or one with other columns. Raises UserError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    content = folder.read(FILE)
    if content is None:
        return None
    try:
        table = pq.read_table(BytesIO(content))
    except pa.ArrowInvalid:
        return None
    return table if table.schema.equals(table_of([]).schema) else None


def table_of(rows: list[Row]) -> "Table":
    """An Arrow table of rows, with null for each column that a row lacks."""
    import pyarrow as pa

    types = {"VARCHAR": pa.string(), "DOUBLE": pa.float64(), "BIGINT": pa.int64(), "BOOLEAN": pa.bool_()}
    types |= {"TIMESTAMP": pa.timestamp("us"), "VARCHAR[]": pa.list_(pa.string())}
    columns = COLUMNS | {TAG: "VARCHAR"}
    return pa.table({name: pa.array([row.get(name) for row in rows], types[type_]) for name, type_ in columns.items()})


def _parquet(table: "Table") -> bytes:
    import pyarrow.parquet as pq

    stream = BytesIO()
    pq.write_table(table, stream, compression="zstd")
    return stream.getvalue()


def _row_of(source: StoredLog, outcome: Outcome) -> Row:
    row: Row = {"recording": source.url, "state": "failed", "error": outcome.detail}
    return {**(outcome.value if outcome.ending == "done" else row), TAG: _tag(source)}


def _tag(source: StoredLog) -> str:
    return f"{source.size} {source.tag} {source.changed}"
