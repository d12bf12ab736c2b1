# SPDX-License-Identifier: Apache-2.0
"""`zenav topic list`: the registry as text. It imports no more than that, so that the command answers at once."""

import json
import sys

from shared.topics import TOPICS


def list_topics(as_json: bool) -> None:
    """Writes the registry."""
    rows = [
        {
            "key": f"{topic.key}/SERVICE" if topic.by == "*" else topic.key,
            "type": topic.type.__name__,
            "hz": topic.hz,
            "by": "every service" if topic.by == "*" else topic.by,
            "doc": (topic.type.__doc__ or "").strip().splitlines()[0],
        }
        for topic in TOPICS
    ]
    if as_json:
        for row in rows:
            sys.stdout.write(json.dumps(row) + "\n")
        return
    for row in rows:
        rate = f"{row['hz']:g}" if row["hz"] else "event"
        sys.stdout.write(f"{row['key']:<16} {row['type']:<14} {rate:>5}  {row['by']:<22} {row['doc']}\n")
