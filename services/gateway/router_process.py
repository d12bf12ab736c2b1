# SPDX-License-Identifier: Apache-2.0
"""The process of a router (router.py) as its parent sees it: started with an order, its lines as events, its end."""

import json
import os
import secrets
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import IO

from services.gateway.log_lines import LOG_FILTER, LineReader, LinkLine

END_LIMIT_S = 2.0
COMMAND = (sys.executable, "-P", "-m", "services.gateway.router")


class RouterProcess:
    """Runs from its making on. order: JSON that router.py reads.  take: gets each event, on a thread of its own.

    inside: words before its command, as of a network namespace.
    """

    def __init__(self, order: Mapping[str, str], take: Callable[[LinkLine], None], inside: Sequence[str] = ()) -> None:
        self._take, mark = take, secrets.token_hex(16)
        environment = {**os.environ, "RUST_LOG": LOG_FILTER}  # noqa: TID251  # Zenoh reads its log's level from there
        pipe = subprocess.PIPE
        command = [*inside, *COMMAND]
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment)
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps({**order, "mark": mark}) + "\n")
            self._process.stdin.flush()
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout, mark), daemon=True)
        self._reader.start()

    def failure(self) -> str:
        """Why it has ended; empty while it runs."""
        if self._process.poll() is None:
            return ""
        why = self._process.stderr.read().strip() if self._process.stderr is not None else ""
        return why or f"the router's process ended with {self._process.returncode}"

    def end(self) -> None:
        """Ends it, and takes its last lines."""
        with suppress(OSError, ValueError, subprocess.TimeoutExpired):
            if self._process.stdin is not None:
                self._process.stdin.close()  # it ends with its stdin
            self._process.wait(END_LIMIT_S)
        self._process.kill()
        self._process.wait()
        self._reader.join(END_LIMIT_S)
        for stream in (self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()

    def _read(self, stream: IO[str], mark: str) -> None:
        lines = LineReader(mark)
        with suppress(ValueError):  # it was closed
            for line in stream:
                if (event := lines.read(line)) is not None:
                    self._take(event)
