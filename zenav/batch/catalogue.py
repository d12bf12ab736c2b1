# SPDX-License-Identifier: Apache-2.0
"""The catalogue of a folder or bucket of recordings: one row a recording. docs/batch.md names the columns.

It is the folder `catalogue` of the place. Each upload adds a row as a small JSON file. Now and then these become a
Parquet file, and small Parquet files a larger one (a log-structured merge; our own, without levels). Files are named by
their content and never change. A file is removed only after its rows are in another one, by the process that wrote
that one. So any number of robots and readers may add and merge at once: at worst a row is there twice.
"""

import hashlib
import json
from collections.abc import Iterable
from io import BytesIO
from typing import TYPE_CHECKING, Any

from shared.config import UserError
from zenav.batch.cluster_extra import has_parquet
from zenav.batch.storage import Folder
from zenav.batch.table import Row

if TYPE_CHECKING:
    from pyarrow import Table

FOLDER = "catalogue"
TAG = "tag"
"""Column: the store's words for the content, by which a changed recording is noticed."""
REVISION = "revision"
"""Column: how often the recording was given a row; of two rows of a recording the higher one counts."""
COLUMNS: dict[str, str] = {
    "recording": "VARCHAR", "state": "VARCHAR", "error": "VARCHAR", "robot": "VARCHAR", "host": "VARCHAR",
    "started": "TIMESTAMP", "duration": "DOUBLE", "size": "BIGINT", "driven": "DOUBLE",
    "contact": "BOOLEAN", "lost": "BIGINT", "goals": "BIGINT", "failed": "BIGINT", "recoveries": "BIGINT",
    "stops": "VARCHAR[]", "faults": "VARCHAR[]", "services": "VARCHAR[]", "sha256": "VARCHAR",
}  # fmt: skip
"""Type by name: s, bytes, m; lost: poses; goals and failed: tasks; stops and faults: codes of reasons; sha256: of an
uploaded recording."""
MAX_ROW_FILES = 200  # JSON files that a reader takes before they become a Parquet file
MAX_TRIES = 5  # to read files that others merge meanwhile
GROWTH = 2  # a Parquet file joins a merge that is at least 1/GROWTH of its size


class Catalogue:
    """The catalogue of a place. Every method raises UserError where the store refuses."""

    def __init__(self, place: Folder) -> None:
        self._place = place

    def add(self, row: Row) -> None:
        """Adds the row of a recording; the same row again changes nothing."""
        content = json.dumps(row, sort_keys=True).encode()
        self._place.write(f"{FOLDER}/{_name(content)}.json", content)

    def read(self, damaged: list[str] | None = None) -> "tuple[Table | None, list[str]]":
        """The rows, one a recording, and the files that hold them; None where there is no catalogue.

        damaged: gets the files that are damaged; None: such a file is a UserError.
        """
        for _ in range(MAX_TRIES):
            names = [name for name in self._place.names(FOLDER) if name.endswith((".json", ".parquet"))]
            contents = self._place.read_all(names)
            if len(contents) == len(names):
                return (_one_a_recording(_table(contents, damaged)) if names else None), names
        raise UserError(f"{self._place.url}/{FOLDER} changes again and again", "try it later")

    def replace(self, table: "Table", names: Iterable[str]) -> None:
        """Writes rows in the place of files that were read. Rows that others added since then stay."""
        content = _parquet(table)
        new = f"{FOLDER}/{_name(content)}.parquet"
        self._place.write(new, content)
        self._place.remove([name for name in names if name != new])

    def merge(self) -> None:
        """Makes many small files few larger ones, where there are many; without Parquet here, another process does."""
        sizes = self._place.names(FOLDER)
        rows = [name for name in sizes if name.endswith(".json")]
        if len(rows) < MAX_ROW_FILES or not has_parquet():
            return
        names, total = list(rows), sum(sizes[name] for name in rows) // 8  # JSON is some 8 times as large
        for name in sorted((name for name in sizes if name.endswith(".parquet")), key=sizes.__getitem__):
            if sizes[name] > GROWTH * total:
                break
            names.append(name)
            total += sizes[name]
        contents = self._place.read_all(names)
        if len(contents) == len(names):  # else another process merges them
            self.replace(_one_a_recording(_table(contents)), names)


def table_of(rows: list[Row]) -> "Table":
    """An Arrow table of rows, with null for each column that a row lacks."""
    import pyarrow as pa

    return pa.table({name: pa.array([row.get(name) for row in rows], type_) for name, type_ in _arrow_types().items()})


def _arrow_types() -> dict[str, Any]:
    import pyarrow as pa

    types = {"VARCHAR": pa.string(), "DOUBLE": pa.float64(), "BIGINT": pa.int64(), "BOOLEAN": pa.bool_()}
    types |= {"TIMESTAMP": pa.timestamp("us"), "VARCHAR[]": pa.list_(pa.string())}
    return {name: types[type_] for name, type_ in (COLUMNS | {TAG: "VARCHAR", REVISION: "BIGINT"}).items()}


def _table(contents: dict[str, bytes], damaged: list[str] | None = None) -> "Table":
    """The rows of all files. Another version's columns are left out, and its missing ones null.

    damaged: as in `Catalogue.read`.
    """
    import pyarrow as pa

    rows: list[Row] = []
    tables = []
    for name in sorted(contents):
        try:
            if name.endswith(".json"):
                rows.append(_row(contents[name]))
            else:
                tables.append(_read_parquet(contents[name]))
        except (ValueError, pa.ArrowException, OSError) as error:
            if damaged is None:
                hint = "zenav recording find --refresh reads its recordings again"
                raise UserError(f"{name} is damaged: {error}", hint) from None
            damaged.append(name)
    return pa.concat_tables([table_of(rows), *tables])


def _row(content: bytes) -> Row:
    """Raises ValueError where it is none."""
    row = json.loads(content)
    if not isinstance(row, dict) or "recording" not in row:
        raise ValueError("it holds no row")
    return row


def _read_parquet(content: bytes) -> "Table":
    """Raises ArrowException or OSError where it is damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    types, table = _arrow_types(), pq.read_table(BytesIO(content))
    columns = [
        table[key].cast(type_) if key in table.column_names else pa.nulls(len(table), type_)
        for key, type_ in types.items()
    ]
    return pa.table(dict(zip(types, columns, strict=True)))


def _one_a_recording(table: "Table") -> "Table":
    """Of several rows of a recording the one of the highest revision."""
    import numpy as np
    import pyarrow.compute as pc

    if pc.count_distinct(table["recording"]).as_py() == len(table):
        return table
    urls = table["recording"].to_pylist()
    last: dict[str, int] = {}
    order = np.argsort(table[REVISION].fill_null(0).to_numpy(), kind="stable").tolist()
    for i in order:
        last[urls[i]] = i
    return table.take(sorted(last.values()))


def _parquet(table: "Table") -> bytes:
    import pyarrow.parquet as pq

    stream = BytesIO()
    pq.write_table(table, stream, compression="zstd")
    return stream.getvalue()


def _name(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]
