# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet recordings` and `fetch`: the recordings on a robot, over its link to the site.

A fetch that was interrupted goes on where it ended. What is there already is compared by digests of 1 MiB each, so a
link carries 32 bytes for what it has carried before. Each part has its SHA-256 too. Of a recording that grows comes
what is there at the begin. A link that is slower than the recorder would never reach its end.
"""

import os
import sys
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

from shared import requests
from shared.config import UserError
from shared.file_modes import make_folder, opener
from shared.recording_requests import MAX_DIGEST_SPAN, MAX_RECORDING_PART, FetchRecording, ListRecordings, RecordingPart
from shared.runners.transport import stack_address
from zenav.client import Client
from zenav.console.progress import progress_bar
from zenav.console.table import show_table

ANSWER_S = 30.0  # the robot holds parts back, and a slow link takes its time
TRIES = 10  # of one part, while the link is lost
AGAIN_S = 3.0
MARK = ".part"
"""End of the name of a file that is not whole."""


def list_robot_recordings(name: str, stack: str) -> int:
    """Shows the recordings on a robot, the newest first."""
    with Client(name, stack_address(stack)) as client:
        files = _listed(client, name)
    rows = [
        (file, f"{size / 1e6:.1f}", f"{datetime.fromtimestamp(at / 1e9, UTC):%Y-%m-%d %H:%M}", "yes" if is_open else "")
        for file, size, at, is_open in files
    ]
    show_table(f"recordings on {name}", ("name", "MB", "changed, UTC", "is written"), rows)
    return 0


def _listed(client: Client, name: str) -> tuple[tuple[str, int, int, bool], ...]:
    reply = client.ask(requests.LIST_RECORDINGS, ListRecordings(client.now()), ANSWER_S)
    if not reply.accepted:
        raise UserError(f"{name}: {reply.reason}: {reply.detail}", "see the log of its uplink")
    return reply.files


def fetch_recording(name: str, file: str, folder: Path, stack: str) -> int:
    """Fetches a recording of a robot into a folder; goes on with one that was begun.

    One that is being written keeps MARK at the end of its name.
    """
    if "/" in file or file.startswith("."):
        raise UserError(f"{file!r} is no name of a recording", f"list them: zenav fleet recordings {name}")
    target = folder / file
    if target.exists():
        raise UserError(f"{target} is there already", "name another folder: --out DIR")
    partial = target.with_name(target.name + MARK)
    try:
        make_folder(folder)
        with Client(name, stack_address(stack)) as client, progress_bar(f"fetching {file}") as show:

            def ask(offset: int, length: int, digest: bool = False) -> RecordingPart:
                request = FetchRecording(client.now(), file, offset, length, digest)  # dated now: an old one is refused
                return client.ask(requests.FETCH_RECORDING, request, ANSWER_S)

            growing = {other: size for other, size, _, grows in _listed(client, name) if grows}
            try:
                n = fetch_into(
                    partial,
                    patient_ask(ask, name),
                    lambda done, size: show(min(done / max(size, 1), 1.0)),
                    growing.get(file),
                )
            except UserError:
                if not partial.stat().st_size:
                    partial.unlink()
                raise
        if file not in growing:
            partial.replace(target)
    except OSError as error:
        hint = "free the disk and fetch it again: it goes on there; or name another folder: --out DIR"
        raise UserError(f"{target} cannot be written: {error.strerror}", hint) from None
    if file in growing:
        sys.stdout.write(f"{partial}: {n} bytes, what was written when the fetch began; fetch it again for the rest\n")
    else:
        sys.stdout.write(f"{target}: {n} bytes\n")
    return 0


Ask = Callable[..., RecordingPart]
"""(offset, length, digest) to the reply."""


def fetch_into(partial: Path, ask: Ask, report: Callable[[int, int], None], end: int | None = None) -> int:
    """Makes a file whole, of which a part may be there. Returns its bytes. Raises UserError where parts do not fit.

    report: gets the bytes that are there, and those of the whole.  end: bytes that are enough; None is the whole file.
    """
    with open(partial, "a+b", opener=opener) as out:
        done = _verified(out.seek(0, os.SEEK_END), lambda at, n: _digest(partial, at, n), ask)
        out.truncate(done)
        while True:
            part = _checked(ask(done, MAX_RECORDING_PART))
            if sha256(part.data).digest() != part.sha256:
                raise UserError("a part of the recording was changed on its way", "fetch it again: it goes on there")
            out.seek(done)
            out.write(part.data)
            out.flush()
            done += len(part.data)
            size = part.size if end is None else end
            report(done, size)
            if done >= size or not part.data:
                os.fsync(out.fileno())
                return done


def _verified(have: int, digest: Callable[[int, int], bytes], ask: Ask) -> int:
    """How many of the bytes that are there are those of the robot's file."""
    done = 0
    while done < have:
        n = min(MAX_DIGEST_SPAN, have - done)
        part = _checked(ask(done, n, True))
        if part.size < done + n or part.sha256 != digest(done, n):
            return done
        done += n
    return done


def _digest(file: Path, offset: int, length: int) -> bytes:
    with file.open("rb") as stream:
        stream.seek(offset)
        return sha256(stream.read(length)).digest()


def _checked(part: RecordingPart) -> RecordingPart:
    if not part.accepted:
        raise UserError(f"the recording cannot be fetched: {part.reason} {part.detail}", "zenav fleet recordings NAME")
    return part


def patient_ask(ask: Ask, name: str, pause: float = AGAIN_S) -> Ask:
    """Asks again while the link is lost, TRIES times. pause: s between two tries. Raises UserError after the last."""

    def patient(offset: int, length: int, digest: bool = False) -> RecordingPart:
        for left in range(TRIES - 1, -1, -1):
            try:
                return ask(offset, length, digest)
            except UserError:
                if not left:
                    raise
                sys.stderr.write(f"{name} does not answer; again in {pause:g} s\n")
                threading.Event().wait(pause)
        raise AssertionError

    return patient
