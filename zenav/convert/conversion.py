# SPDX-License-Identifier: Apache-2.0
"""One conversion, as a writer of any format sees it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from shared.messages import Message
from zenav.convert.content import Content


@dataclass(frozen=True, slots=True)
class Conversion:
    """One conversion of a log.

    source: the file that was read.   content: its messages.   out: the path to write, which does not exist yet.
    trajectory: the source of the poses in a file of poses: pose, odom or truth.   progress: called with the share
    done, 0..1.
    """

    source: Path
    content: Content
    out: Path
    trajectory: str
    progress: Callable[[float], None]

    def messages(self) -> Iterator[tuple[str, Message]]:
        """The content's messages, with calls of `progress`."""
        rows = self.content.messages
        for i, row in enumerate(rows):
            if i % 200 == 0:
                self.progress(i / len(rows))
            yield row
