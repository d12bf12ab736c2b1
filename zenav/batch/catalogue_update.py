# SPDX-License-Identifier: Apache-2.0
"""Brings the catalogue of a place up to date where recordings came otherwise than by an upload: reads what is new."""

import sys
from typing import TYPE_CHECKING

from zenav.batch.catalogue import REVISION, TAG, Catalogue, table_of
from zenav.batch.child_process import Outcome, TryLimits
from zenav.batch.engine import results
from zenav.batch.recording_row import recording_row
from zenav.batch.storage import Folder, StoredLog, content_version, sources
from zenav.batch.table import Row

if TYPE_CHECKING:
    from pyarrow import Table


def update(place: str, jobs: int) -> "Table":
    """The catalogue of a place, brought up to date: new and changed recordings are read, rows of removed ones dropped.

    A recording whose reading failed is read again: a network or a full memory may have been the reason.
    A damaged file of the catalogue is dropped, and its recordings are read again.
    Raises UserError where the place has no recording, or its store refuses.
    """
    import pyarrow as pa

    catalogue = Catalogue(Folder(place))
    damaged: list[str] = []
    before, files = catalogue.read(damaged)
    columns = [] if before is None else [before[name].to_pylist() for name in ("recording", TAG, REVISION, "state")]
    revisions = {
        url: ("" if state == "failed" else tag, revision) for url, tag, revision, state in zip(*columns, strict=True)
    }
    found = {source.url: source for source in sources([place]) if source.url.endswith(".mcap")}
    new = [found[url] for url in sorted(found) if revisions.get(url, ("", 0))[0] != content_version(found[url])]
    if before is not None and not damaged and not new and len(found) == len(revisions):
        return before
    rows = []
    for i, (source, outcome) in enumerate(results(recording_row, new, jobs, limits=TryLimits())):
        rows.append({**_row_of(source, outcome), REVISION: revisions.get(source.url, ("", 0))[1] + 1})
        sys.stderr.write(f"{i + 1} of {len(new)}: {source.url}\n")
    tables = [table_of(rows)]
    if before is not None:
        read = {source.url for source in new}
        tables.append(before.filter(pa.array([url in found and url not in read for url in columns[0]], pa.bool_())))
    table = pa.concat_tables(tables)
    catalogue.replace(table, files)
    return table


def _row_of(source: StoredLog, outcome: Outcome) -> Row:
    if outcome.ending == "done":
        row: Row = outcome.value
        return row
    return {"recording": source.url, "state": "failed", "error": outcome.detail, TAG: content_version(source)}
