# SPDX-License-Identifier: Apache-2.0
"""`zenav recording latency`: how old messages were when they were recorded, and how long a scan takes to cmd/vel."""

import json
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from shared.config import UserError
from zenav.console.table import show_table
from zenav.metrics.latency import latency_chain, latency_figures
from zenav.recording.opening import open_recording
from zenav.recording.selection import keys_in

PERCENTILES = (50, 95, 99, 100)


def latency(path: Path, patterns: list[str], as_json: bool) -> int:
    """Writes percentiles, ms: from a message's stamp, and from its sending, to its recording; from scan to cmd/vel."""
    recording = open_recording(path)
    ages: dict[str, tuple[list[int], list[int]]] = {}
    for entry in recording.entries(keys_in(recording, patterns)):
        stamp = stamp_of(entry.payload)
        if stamp is not None and not entry.latched:
            since_stamp, since_sent = ages.setdefault(entry.key, ([], []))
            since_stamp.append(entry.log_time - stamp)
            since_sent.append(entry.log_time - entry.sent)
    if not ages:
        raise UserError(f"{path} holds no message with a stamp", "name a recording of this stack")
    rows = {
        key: {"n": len(since_stamp), "stamp": _percentiles(since_stamp), "sent": _percentiles(since_sent)}
        for key, (since_stamp, since_sent) in sorted(ages.items())
    }
    parts = _chain(path)
    if as_json:
        sys.stdout.write(json.dumps({"topics": rows, "chain": parts}) + "\n")
        return 0
    columns = (
        "topic",
        "messages",
        *(f"stamp {_name(p)}" for p in PERCENTILES),
        *(f"sent {_name(p)}" for p in PERCENTILES),
    )
    show_table("ms from stamp, and from sending, to recording", columns, [_row(key, row) for key, row in rows.items()])
    if parts:
        shown = [(name, *(f"{row[f'p{p}']:.1f}" for p in PERCENTILES)) for name, row in parts.items()]
        show_table("ms from scan to cmd/vel, by the journals", ("", *map(_name, PERCENTILES)), shown)
    else:
        sys.stdout.write("scan to cmd/vel: the journals of local_ctrl, guard and base_driver do not contain it\n")
    return 0


def stamp_of(payload: bytes) -> int | None:
    """A message's stamp, ns; None where it has none."""
    try:
        tree = msgpack.unpackb(payload)
    except Exception:  # msgpack raises a dozen kinds on foreign bytes
        return None
    stamp = tree.get("stamp") if isinstance(tree, dict) else None
    return stamp if isinstance(stamp, int) else None


def _percentiles(ages: list[int]) -> dict[str, float]:
    values = np.percentile(np.array(ages, float) / 1e6, PERCENTILES)
    return {f"p{p}": round(float(value), 3) for p, value in zip(PERCENTILES, values)}


def _chain(path: Path) -> dict[str, Any]:
    chain = latency_chain(path)
    parts: dict[str, Any] = latency_figures(chain)["parts"] if len(chain.latency) else {}
    return parts


def _row(key: str, row: dict[str, Any]) -> tuple[str, ...]:
    return key, str(row["n"]), *(f"{row[kind][f'p{p}']:.2f}" for kind in ("stamp", "sent") for p in PERCENTILES)


def _name(percentile: int) -> str:
    return "max" if percentile == 100 else f"p{percentile}"
