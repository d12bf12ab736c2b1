# SPDX-License-Identifier: Apache-2.0
"""`zenav convert`: a file in another format, with a progress bar and a summary."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from zenav.console.progress import progress_bar

if TYPE_CHECKING:
    from zenav.convert.content import Choice


def convert_command(source: Path, out: Path, to: str, choice: "Choice", trajectory: str, force: bool) -> None:
    """A file in another format; says what went into it."""
    from zenav.convert.export import convert as run

    with progress_bar(source.name) as progress:
        counts, notes = run(source, out, to, choice, trajectory, force, progress)
    sys.stdout.write(f"{out}: {', '.join(f'{n} {name}' for name, n in counts.items() if n)}\n")
    for note in notes:
        sys.stderr.write(f"{note}\n")
