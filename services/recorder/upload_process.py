# SPDX-License-Identifier: Apache-2.0
"""The process that uploads finished parts, beside the recorder: it runs while there is something to upload.

It loads libraries of object stores, and reads whole files. So it is no work for the recorder, which only starts it and
reads its lines. It survives nothing: each start continues where the last one ended, by files beside the recordings.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from shared.config import UserError
from shared.service import Log

MODULE = "zenav.batch.uploader"
PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs"}
"""Package that writes to URLs of a kind, beside fsspec; for other kinds the process itself looks."""
MIN_WAIT_S, MAX_WAIT_S = 2.0, 300.0  # before a process that ended by itself is started again
END_LIMIT_S = 0.5  # for a killed process, which a disk or mount that hangs keeps
READ_BYTES = 1 << 16


def check_upload(url: str) -> None:
    """Raises UserError where nothing can be uploaded to the URL, or a package for it is missing. Imports nothing."""
    kind = url.partition("://")[0] if "://" in url else ""
    if kind in ("http", "https"):
        raise UserError(f"recorder.upload: {url} cannot be written to", "s3://BUCKET/FOLDER, or a folder")
    missing = [name for name in ("fsspec", PACKAGES.get(kind, "fsspec")) if find_spec(name) is None]
    if missing:
        hint = 'pip install "zenav[upload]"' + (f" {missing[-1]}" if missing[-1] not in ("fsspec", "s3fs") else "")
        raise UserError(f"recorder.upload needs a package that is not installed: {missing[-1]}", hint)


@dataclass(frozen=True, slots=True)
class UploadOrder:
    """What the process gets. rate: MB/s, 0 is unlimited.  patterns: names of this recorder's files in `folder`."""

    folder: str
    url: str
    rate: float
    patterns: tuple[str, ...]

    def command(self) -> list[str]:
        """The process's command line."""
        options = [str(os.getpid()), self.folder, self.url, str(self.rate), *self.patterns]
        return [sys.executable, "-P", "-m", MODULE, *options]


class UploadProcess:
    """Starts the process when there may be something to upload, and reads what it says."""

    def __init__(self) -> None:
        self.text = ""
        """State of the uploads, for health."""
        self._process: subprocess.Popen[bytes] | None = None
        self._order: UploadOrder | None = None
        self._is_due = False
        self._due_at, self._wait = 0.0, MIN_WAIT_S  # monotonic s
        self._rest = b""

    def wake(self, order: UploadOrder) -> None:
        """There may be a new part, or other settings. One that runs with the same order looks for parts itself."""
        if order != self._order:
            self.close()
        self._order, self._is_due = order, True

    def step(self) -> Iterator[Log]:
        """What the process said since the last call. Starts it where it is due. Waits for nothing."""
        if self._process is not None:
            yield from self._said(self._process)
            if (status := self._process.poll()) is not None:
                yield from self._said(self._process)
                self._close_pipes(self._process)
                self._process = None
                yield from self._ended(status)
        if self._process is None and self._is_due and time.monotonic() >= self._due_at:
            self._start()

    def close(self) -> None:
        """Ends the process. Whatever it was doing is continued by the next one."""
        process, self._process, self._order, self._is_due, self._rest = self._process, None, None, False, b""
        if process is not None:
            process.kill()
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_LIMIT_S)
            self._close_pipes(process)

    def _start(self) -> None:
        assert self._order is not None
        self._is_due = False
        try:
            process = subprocess.Popen(self._order.command(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
        except OSError as error:  # no memory, no process left
            self.text, self._is_due, self._due_at = f"no upload: {error.strerror}", True, time.monotonic() + self._wait
            return
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        self._process = process

    def _said(self, process: "subprocess.Popen[bytes]") -> Iterator[Log]:
        assert process.stdout is not None
        with suppress(BlockingIOError):
            while data := os.read(process.stdout.fileno(), READ_BYTES):
                self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            try:
                report: Any = json.loads(line)
            except ValueError:
                report = None
            if not isinstance(report, dict):  # of a library that writes to stdout
                continue
            self.text = report.get("state", self.text)
            if "log" in report:
                yield Log(report["log"], report["text"])

    def _ended(self, status: int) -> Iterator[Log]:
        self._rest = b""
        if status == 0:
            self._wait = MIN_WAIT_S
            return
        self._is_due, self._due_at = True, time.monotonic() + self._wait
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        yield Log("WARNING", f"the uploader {how}; it is started again in {self._wait:g} s")
        self._wait = min(2 * self._wait, MAX_WAIT_S)

    @staticmethod
    def _close_pipes(process: "subprocess.Popen[bytes]") -> None:
        if process.stdout is not None:
            process.stdout.close()
