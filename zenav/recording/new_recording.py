# SPDX-License-Identifier: Apache-2.0
"""Writing a new recording out of old ones. Bytes of messages are never changed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from shared.config import UserError
from shared.file_modes import make_folder
from shared.recording import Recording, Writer
from zenav.recording.selection import OUT_HINT


@contextmanager
def new_recording(
    out: Path, source: Recording, about: dict[str, str], attachments: dict[str, bytes]
) -> Iterator[Writer]:
    """A copy of another recording that takes its name when it is whole. Raises UserError where the disk refuses."""
    part = out.with_name(f"{out.name}.writing")
    try:
        make_folder(out.parent)
        with Writer(part, about, attachments, profile=source.profile) as writer:
            for name, fields in source.metadata:
                writer.note(name, fields)
            yield writer
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(out)
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", OUT_HINT) from None
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
