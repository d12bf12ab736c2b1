# SPDX-License-Identifier: Apache-2.0
"""Messages of the requests for the recorder's files."""

from dataclasses import dataclass
from typing import Annotated

from shared.messages import Count, Flag, Message, Text, Unit, Within

MAX_RECORDING_PART = 64 * 1024  # bytes of a recording in a reply: a slow link carries them within seconds
MAX_DIGEST_SPAN = 2**20  # bytes of which a reply gives the digest


@dataclass(frozen=True, slots=True)
class ListRecordings(Message):
    """The recorder's files, the newest first."""


@dataclass(frozen=True, slots=True)
class RecordingList(Message):
    """The files; one that is being written still grows."""

    accepted: Flag
    reason: Text
    detail: Text
    files: Annotated[
        tuple[tuple[str, int, int, bool], ...], Unit("name, bytes, ns of the change, whether it grows")
    ] = ()


@dataclass(frozen=True, slots=True)
class FetchRecording(Message):
    """Bytes of a recording from `offset` on, 64 KiB at most. digest: only their SHA-256, of 1 MiB at most."""

    name: Text
    offset: Count
    length: Annotated[int, Unit("bytes"), Within(1, MAX_DIGEST_SPAN)]
    digest: Flag = False


@dataclass(frozen=True, slots=True)
class RecordingPart(Message):
    """The bytes, fewer at the end of the file, with their SHA-256; `size` is the whole file's now."""

    accepted: Flag
    reason: Text
    detail: Text
    size: Annotated[Count, Unit("bytes")] = 0
    data: Annotated[bytes, Unit("bytes")] = b""
    sha256: Annotated[bytes, Unit("bytes")] = b""
