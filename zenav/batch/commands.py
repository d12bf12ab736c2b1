# SPDX-License-Identifier: Apache-2.0
"""`zenav batch slam` and `replay`: one work over many recordings; a table, and what changed since the last run."""

import sys
from collections import Counter
from functools import partial
from typing import Any

from shared.config import UserError
from zenav.batch import comparison
from zenav.batch.child_process import Outcome, TryLimits
from zenav.batch.cluster_extra import require_extra
from zenav.batch.code_hash import code_hash
from zenav.batch.engine import results
from zenav.batch.revision import commit_of, run_revision
from zenav.batch.storage import Folder, StoredLog, sources
from zenav.batch.table import Row, last_table, write_table
from zenav.batch.work import Work, check_work, process
from zenav.console.table import show_table

SHOWN = 20  # changes on the terminal; the page has all
DONE = "done"


def batch(
    work: Work, inputs: list[str], out: str, jobs: int, cluster: str, limits: TryLimits, against: str, fails_worse: bool
) -> int:
    """Runs the work; 0 when every recording came through, and with `fails_worse` none became worse.

    inputs: paths, URLs and globs.  out: folder or URL.  cluster: address of a Dask scheduler, empty: `jobs` processes
    here.  against: the output of an earlier run, or a revision of the checkout, which then runs first; empty: this
    one's last run. Raises UserError.
    """
    require_extra()
    check_work(work)
    found, folder = sources(inputs), Folder(out)
    if commit := commit_of(against):
        if cluster:
            raise UserError("a revision runs on this computer", "name the --out of a run, or leave out --cluster")
        against = run_revision(commit, work, inputs, folder.url, jobs, limits)
    former = Folder(against) if against else folder
    before = last_table(former)
    if against and not before:
        hint = "name the --out of an earlier run, or a tag or commit of this checkout"
        raise UserError(f"{against} holds no table of a batch and is no revision", hint)
    rows: list[Row] = []
    for source, outcome in results(partial(process, work, folder.url, code_hash()), found, jobs, cluster, limits):
        rows.append(row_of(source, outcome))
        _say(rows[-1], len(rows), len(found))
    write_table(folder, rows)
    changed = comparison.changes(before, rows)
    if before:
        _copy_pictures(changed, former, folder)
        known = {row["recording"] for row in before}
        folder.write("changes.html", comparison.page(changed, sum(row["recording"] in known for row in rows)))
    _show(rows, changed, folder.url)
    is_worse = any(change.worse > 0 for change in changed)
    return 0 if all(row["state"] == DONE for row in rows) and not (fails_worse and is_worse) else 1


def _copy_pictures(changed: list[comparison.Change], former: Folder, folder: Folder) -> None:
    """The page needs the maps of the other output beside its own. They are no result there: it has no `row.json`."""
    if former.url == folder.url:
        return
    for key in sorted({change.keys[0] for change in changed if change.keys[0]}):
        if (picture := former.read(f"results/{key}/map.png")) is not None:
            folder.write(f"results/{key}/map.png", picture)


def row_of(source: StoredLog, outcome: Outcome) -> Row:
    """The row of a recording, also of one whose process did not come to an end."""
    if outcome.ending == "done":
        row: dict[str, Any] = outcome.value
        return {**row, "tries": outcome.n_tries}
    state = "failed" if outcome.ending == "raised" else outcome.ending
    return {"recording": source.url, "state": state, "error": outcome.detail, "tries": outcome.n_tries}


def _say(row: Row, n: int, of: int) -> None:
    words = f": {row['error']}" if row.get("error") else ""
    cached = " (by an earlier run)" if row.get("cached") else ""
    sys.stderr.write(f"{n} of {of}: {row['recording']}: {row['state']}{cached}{words}\n")


def _show(rows: list[Row], changed: list[comparison.Change], url: str) -> None:
    counts = Counter(str(row["state"]) for row in rows)
    n_cached = sum(bool(row.get("cached")) for row in rows)
    cells = [(state, str(n)) for state, n in sorted(counts.items())]
    sys.stdout.write(f"{len(rows)} recordings, {n_cached} of them computed by an earlier run\n")
    show_table("", ("state", "recordings"), cells)
    for line in comparison.lines(changed[:SHOWN]):
        sys.stdout.write(f"{line}\n")
    if len(changed) > SHOWN:
        sys.stdout.write(f"and {len(changed) - SHOWN} more: {url}/changes.html\n")
    sys.stdout.write(f"{url}/table.parquet\n")
