# SPDX-License-Identifier: Apache-2.0
"""The table of a batch: one row a recording, as Parquet. `runs/TIME.parquet` of the output keeps each run's."""

import sys
from datetime import UTC, datetime
from io import BytesIO
from typing import Any

from zenav.batch.cluster_extra import require_extra
from zenav.batch.storage import Folder

Row = dict[str, Any]
"""recording (URL), state (`done`, `refused`, or how the process ended), error, tries, seconds, cpu_s, and figures."""

RUNS = "runs"
TABLE = "table.parquet"
FIRST_COLUMNS = ("recording", "state", "error", "tries", "cached", "key", "seconds", "cpu_s")


def write_table(out: Folder, rows: list[Row]) -> None:
    """Stores the rows as the newest table, and among the runs. Raises UserError where the store does not take it."""
    content = parquet(rows)
    name = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")  # noqa: TID251  # the name of a file
    out.write(f"{RUNS}/{name}.parquet", content)
    out.write(TABLE, content)


def last_table(out: Folder) -> list[Row]:
    """The rows of the newest run; none where there was none. A table that is damaged counts as none, with a note."""
    content = out.read(TABLE)
    if content is None:
        return []
    require_extra()
    from pyarrow import ArrowException

    try:
        return rows_of(content)
    except (ArrowException, OSError):  # OSError: of a damaged page
        sys.stderr.write(f"{out.url}/{TABLE} is damaged: nothing is compared with it\n")
        return []


def parquet(rows: list[Row]) -> bytes:
    """The rows as a Parquet file, by recording; a figure that a row lacks is null."""
    require_extra()
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = list(dict.fromkeys([*FIRST_COLUMNS, *(name for row in rows for name in row)]))
    ordered = sorted(rows, key=lambda row: str(row["recording"]))
    table = pa.table({name: [row.get(name) for row in ordered] for name in names})
    stream = BytesIO()
    pq.write_table(table, stream, compression="zstd")
    return stream.getvalue()


def rows_of(content: bytes) -> list[Row]:
    """The rows of a Parquet file that `parquet` wrote, without its nulls."""
    require_extra()
    import pyarrow.parquet as pq

    rows = pq.read_table(BytesIO(content)).to_pylist()
    return [{name: value for name, value in row.items() if value is not None} for row in rows]
