# SPDX-License-Identifier: Apache-2.0
"""A service's checkpoint on disk, for its next process: see `Service.checkpoint`."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path

import msgpack

from shared.codec import CodecError, Envelope, decode, encode
from shared.messages import Message
from shared.requests import REQUESTS, Request
from shared.service import Checkpoint, Service
from shared.types import NS_PER_S

MIN_INTERVAL_NS = 5 * NS_PER_S  # between two checkpoints
MAX_BYTES_PER_S = 500_000  # of writing: a large checkpoint is written less often, and an SD card lasts longer
NO_ENVELOPE = Envelope("", "", 0, 0)

log = logging.getLogger("zenav")


class CheckpointDisk:
    """Writes a service's checkpoints into one file of `folder`, each as a whole. workers: executor that writes."""

    def __init__(self, folder: Path, name: str, workers: Executor) -> None:
        self._path, self._workers = folder / f"{name}-checkpoint.msgpack", workers
        self._version: object = None  # of the last checkpoint
        self._written_at = self._n_bytes = 0  # ns; of the last one
        self._writing: Future[int] | None = None

    def step(self, service: Service, now: int) -> None:
        """Orders the writing of a checkpoint where one is due. now: ns."""
        if self._writing is not None:
            if not self._writing.done():
                return
            self._n_bytes, self._writing = self._writing.result(), None
        pause = max(MIN_INTERVAL_NS, self._n_bytes * NS_PER_S // MAX_BYTES_PER_S)
        if 0 <= now - self._written_at < pause:
            return
        checkpoint = service.checkpoint()
        if checkpoint is None or checkpoint.version == self._version:
            return
        self._version, self._written_at = checkpoint.version, now
        self._writing = self._workers.submit(self._write, checkpoint)

    def restored(self, wrong: Callable[[str], None]) -> Iterator[tuple[Request[Message, Message], Message, bytes]]:
        """The requests of the last checkpoint, with their bytes. wrong: called where the file is damaged."""
        rows = {row.key: row for row in REQUESTS}
        try:
            content = self._path.read_bytes()
        except OSError:
            return
        try:
            for key, payload in msgpack.unpackb(content):
                yield rows[key], decode(rows[key].request, payload)[0], payload
        except (CodecError, KeyError, TypeError, ValueError, msgpack.UnpackException) as error:
            wrong(f"the checkpoint from before the restart is damaged: {error}")

    def _write(self, checkpoint: Checkpoint) -> int:
        requests = checkpoint.function(*checkpoint.arguments)
        content = bytes(msgpack.packb([(row.key, encode(message, NO_ENVELOPE)) for row, message in requests]))
        part = self._path.with_suffix(".part")
        try:
            part.write_bytes(content)
            part.replace(self._path)
        except OSError as error:
            log.warning("no checkpoint for a restart: %s", error)
        return len(content)
