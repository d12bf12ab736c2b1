# SPDX-License-Identifier: Apache-2.0
"""`zenav recording find`: recordings of a folder or bucket by an expression, from its catalogue."""

import json
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from shared.config import UserError
from zenav.batch.catalogue import COLUMNS, FOLDER, Catalogue
from zenav.batch.cluster_extra import require_extra
from zenav.batch.query import condition
from zenav.batch.storage import Folder
from zenav.batch.table import Row
from zenav.console.table import show_table

if TYPE_CHECKING:
    from pyarrow import Table


def find_recordings(expression: str, place: str, jobs: int, refresh: bool | None, as_json: bool) -> int:
    """Shows the recordings that fulfil the expression, the newest last; 1 where there is none.

    refresh: whether the place is searched for recordings that the catalogue lacks; None: where recorders do not upload
    to it. Raises UserError where the expression or the place is wrong.
    """
    require_extra()
    where = condition(expression)
    found = query(_catalogue(place, jobs, refresh), where)
    for row in found if as_json else ():
        sys.stdout.write(json.dumps(row) + "\n")
    if not as_json:
        show_table("", ("recording", "robot", "started, UTC", "s", "m", "stops and faults"), [_cells(r) for r in found])
    if not found:
        sys.stderr.write("no recording is so\n")
    return 0 if found else 1


def query(table: "Table", where: tuple[str, list[Any]]) -> list[Row]:
    """The rows that fulfil a condition, by their start. Raises UserError where DuckDB refuses it."""
    import duckdb

    text, values = where
    columns = ", ".join(f"CAST({name} AS VARCHAR) AS {name}" if name == "started" else name for name in COLUMNS)
    with duckdb.connect() as database:
        database.register("catalogue", table)
        try:
            found = database.execute(f"SELECT {columns} FROM catalogue WHERE {text} ORDER BY catalogue.started", values)
        except duckdb.Error as error:
            raise UserError(str(error).splitlines()[0], "see the columns in docs/batch.md") from None
        return [dict(zip(COLUMNS, row, strict=True)) for row in found.fetchall()]


def _catalogue(place: str, jobs: int, refresh: bool | None) -> "Table":
    if refresh:
        return _updated(place, jobs)
    catalogue = Catalogue(Folder(place))
    table, _ = catalogue.read()
    if table is None and refresh is False:
        raise UserError(f"{place} has no {FOLDER}", "leave out --as-it-is: then it is made")
    if table is None or (refresh is None and table["sha256"].null_count == len(table)):
        return _updated(place, jobs)
    with suppress(UserError):  # a reader without the right to write finds too
        catalogue.merge()
    return table


def _updated(place: str, jobs: int) -> "Table":
    from zenav.batch.catalogue_update import update  # loads what reads recordings

    return update(place, jobs)


def _cells(row: Row) -> tuple[str, ...]:
    if row["state"] != "done":
        return row["recording"], "-", "-", "-", "-", f"{row['state']}: {row['error']}"
    events = [*(row["faults"] or ()), *(row["stops"] or ()), *(["contact"] if row["contact"] else [])]
    started, seconds, driven = row["started"], f"{row['duration']:.1f}", f"{row['driven']:.1f}"
    return row["recording"], row["robot"], str(started)[:19], seconds, driven, " ".join(events)
