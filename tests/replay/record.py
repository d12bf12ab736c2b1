# SPDX-License-Identifier: Apache-2.0
"""Makes tests/replay/data/room.mcap anew: `make recording`, after a change that is meant to change what they say.

The whole stack, as processes over Zenoh, drives around the table of a room; kept is what the services of CHAIN take
and publish, with their journals, so that the file stays small.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import sys
import tempfile
from pathlib import Path

from shared.geometry import Pose2
from shared.recording import Recording, Writer
from shared.service import handlers
from shared.topics import TOPICS
from tests.stack.processes import ALL, running
from zenav.classes import service_class

CHAIN = ("odometry", "mapper", "planner", "local_ctrl")
FILE = Path(__file__).parent / "data" / "room.mcap"
WAY = Pose2(3.2, 0.6, 0.0), Pose2(0.5, 1.0, 0.0)
"""Around the table, then back on its other side."""


def keys() -> set[str]:
    """The keys that CHAIN takes or publishes."""
    taken = {key for name in CHAIN for key in handlers(service_class(name)).topics}
    published = {topic.key for topic in TOPICS if topic.by != "*" and set(CHAIN) & set(topic.publishers)}
    return taken | published | {f"journal/{name}" for name in CHAIN}


def record(path: Path, folder: Path) -> None:
    """A drive of the live stack, into `path`; logs go into `folder`. Fails where a goal is not reached."""
    with running(folder, ("recorder", *ALL), settings=(f"recorder.file={path}",)) as stack:
        for pose in WAY:
            stack.until(stack.reached(stack.go(pose)))


def trimmed(path: Path, out: Path) -> None:
    """The part of a recording that CHAIN needs, into `out`."""
    recording = Recording(path)
    out.parent.mkdir(exist_ok=True)
    with Writer(out, recording.about, recording.attachments) as writer:
        for entry in recording.entries(sorted(keys())):
            writer.copy(entry)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "whole.mcap"
        record(path, Path(folder) / "logs")
        trimmed(path, FILE)
    sys.stdout.write(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
