# SPDX-License-Identifier: Apache-2.0
"""One conversion, as a writer of any format sees it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from shared.messages import Message
from zenav.convert.content import Content


@dataclass(frozen=True, slots=True)
class Conversion:
    """source: the file that was read, whose messages content holds.   out: where to write, nothing is there yet.

    trajectory: whose poses a file of poses gets: pose, odom or truth.   progress: is told the share done, 0..1.
    """

    source: Path
    content: Content
    out: Path
    trajectory: str
    progress: Callable[[float], None]

    def messages(self) -> Iterator[tuple[str, Message]]:
        """The content's messages, as the progress is told."""
        rows = self.content.messages
        for i, row in enumerate(rows):
            if i % 200 == 0:
                self.progress(i / len(rows))
            yield row
