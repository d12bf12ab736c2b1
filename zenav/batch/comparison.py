# SPDX-License-Identifier: Apache-2.0
"""What became better and worse between two runs of a batch, worst first: as lines, and as a page with pictures."""

from dataclasses import dataclass
from html import escape

from zenav.batch.table import Row

BETTER_HIGHER = ("placed", "good", "quality", "equal")
BETTER_LOWER = ("different", "lacking", "new", "slam_cpu_s")
MIN_CHANGE = {"slam_cpu_s": 0.1, "quality": 0.005, "placed": 0.001, "good": 0.005}
"""Share of the former value under which a figure counts as the same. CPU time varies from run to run."""
DONE = "done"


@dataclass(frozen=True, slots=True)
class Change:
    """One figure of one recording. worse: share of the former value by which it became worse; negative: better.

    A recording that does not come through any more is infinitely worse. The figure `input` says that the recording
    itself changed.
    """

    recording: str
    figure: str
    before: str
    after: str
    worse: float
    keys: tuple[str, str] = ("", "")


def changes(before: list[Row], after: list[Row]) -> list[Change]:
    """The figures that differ, of recordings in both runs, worst first."""
    former = {row["recording"]: row for row in before}
    found = [
        change for row in after if row["recording"] in former for change in _changes_of(former[row["recording"]], row)
    ]
    return sorted(found, key=lambda change: (-change.worse, change.recording, change.figure))


def _changes_of(before: Row, after: Row) -> list[Change]:
    recording, keys = str(after["recording"]), (str(before.get("key", "")), str(after.get("key", "")))
    inputs = before.get("input"), after.get("input")  # none where the process did not come to an end
    if None not in inputs and inputs[0] != inputs[1]:  # another content: figures are not comparable
        texts = {"before": str(inputs[0]), "after": str(inputs[1])}
        return [Change(recording, "input", **texts, worse=0.0, keys=keys)]
    states = str(before["state"]), str(after["state"])
    if states[0] != states[1]:
        worse = float("inf") if states[0] == DONE else float("-inf") if states[1] == DONE else 0.0
        return [Change(recording, "state", before=states[0], after=states[1], worse=worse, keys=keys)]
    found = []
    for names, sign in ((BETTER_HIGHER, -1.0), (BETTER_LOWER, 1.0)):
        for name in names:
            if name not in before or name not in after:
                continue
            old, new = float(before[name]), float(after[name])
            share = (new - old) / abs(old) if old else (0.0 if new == old else float("inf"))
            if abs(share) > MIN_CHANGE.get(name, 0.0):
                texts = {"before": f"{old:.6g}", "after": f"{new:.6g}"}
                found.append(Change(recording, name, **texts, worse=sign * share, keys=keys))
    if not found and before.get("digest") != after.get("digest"):
        digests = {"before": str(before.get("digest")), "after": str(after.get("digest"))}
        found.append(Change(recording, "digest", **digests, worse=0.0, keys=keys))
    return found


def lines(found: list[Change]) -> list[str]:
    """One line a change."""
    return [f"{_word(one)}: {one.recording}: {one.figure} {one.before} -> {one.after}" for one in found]


def page(found: list[Change], n_compared: int) -> bytes:
    """An HTML page with the maps of both runs beside each other. Pictures are those of `results/KEY/map.png`."""
    cells = [
        (
            one,
            [
                escape(one.recording),
                escape(one.figure),
                escape(one.before),
                escape(one.after),
                *map(_picture, one.keys),
            ],
        )
        for one in found
    ]
    rows = "\n".join(f"<tr class={_word(one)}><td>{'<td>'.join(row)}" for one, row in cells)
    return (
        '<!doctype html><meta charset="utf-8"><title>zenav batch</title><style>'
        "body{font:14px sans-serif}td{padding:4px 12px;vertical-align:top}img{max-width:320px}"
        ".worse{background:#fbe9e7}.better{background:#e8f5e9}</style>"
        f"<p>{len(found)} changes in {n_compared} recordings, worst first<table>"
        "<tr><th>recording<th>figure<th>before<th>now<th>map before<th>map now\n"
        f"{rows}\n</table>\n"
    ).encode()


def _word(change: Change) -> str:
    return "worse" if change.worse > 0 else "better" if change.worse < 0 else "different"


def _picture(key: str) -> str:
    return f'<img src="results/{escape(key)}/map.png" alt="">' if key else ""
