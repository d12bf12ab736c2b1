# SPDX-License-Identifier: Apache-2.0
"""The process of a router (router.py) as its parent sees it: started with an order, its lines as events, its end."""

import json
import os
import secrets
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import IO

from services.gateway.log_lines import LOG_FILTER, LineReader, LinkEvent, LinkLine

END_LIMIT_S = 2.0
MAX_RECORD = 2**16  # bytes; what is longer has a long key, whose end is left out
N_ERRORS = 20  # lines of its stderr, of which the last are kept
COMMAND = (sys.executable, "-P", "-m", "services.gateway.router")


class RouterProcess:
    """Runs from its making on. order: JSON that router.py reads.  take: gets each event, on a thread of its own.

    inside: words before its command, as of a network namespace.  listening: set once it takes connections.
    """

    def __init__(self, order: Mapping[str, str], take: Callable[[LinkLine], None], inside: Sequence[str] = ()) -> None:
        self._take, mark = take, secrets.token_hex(16)
        self.listening = threading.Event()
        environment = {**os.environ, "RUST_LOG": LOG_FILTER}  # noqa: TID251  # Zenoh reads its settings from there
        environment.pop("ZENOH_RUNTIME", None)  # handshakes need threads of their own
        pipe = subprocess.PIPE
        command = [*inside, *COMMAND]
        self._records, records = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with records:
            self._process = subprocess.Popen(
                command, stdin=pipe, stdout=records.fileno(), stderr=pipe, text=True, errors="replace", env=environment
            )
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps({**order, "mark": mark}) + "\n")
            self._process.stdin.flush()
        self._errors: deque[str] = deque(maxlen=N_ERRORS)
        self._readers = (
            threading.Thread(target=self._read, args=(mark,), daemon=True),
            threading.Thread(target=self._read_errors, args=(self._process.stderr,), daemon=True),
        )
        for reader in self._readers:
            reader.start()

    def failure(self) -> str:
        """Why it has ended; empty while it runs."""
        if self._process.poll() is None:
            return ""
        self._readers[1].join(END_LIMIT_S)
        why = "".join(self._errors).strip()
        return why or f"the router's process ended with {self._process.returncode}"

    def end(self) -> None:
        """Ends it, and takes its last lines."""
        with suppress(OSError, ValueError, subprocess.TimeoutExpired):
            if self._process.stdin is not None:
                self._process.stdin.close()  # it ends with its stdin
            self._process.wait(END_LIMIT_S)
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join(END_LIMIT_S)
        self._records.close()
        if self._process.stderr is not None:
            self._process.stderr.close()

    def _read(self, mark: str) -> None:
        """Takes the records: each write of the process is one, whatever line breaks it holds."""
        lines = LineReader(mark)
        with suppress(OSError):  # it was closed
            while record := self._records.recv(MAX_RECORD):
                event = lines.read(record.decode(errors="replace"))
                if event is not None and event.event == LinkEvent.LISTENING:
                    self.listening.set()
                elif event is not None:
                    self._take(event)

    def _read_errors(self, stream: IO[str] | None) -> None:
        """Keeps the last lines. A pipe that is not read would hold the process up."""
        with suppress(ValueError):  # it was closed
            self._errors.extend(stream or ())
