# SPDX-License-Identifier: Apache-2.0
"""A live service's black box: a recording of its inputs, so that a crash by an exception can be replayed.

The service's loop only appends to a list. A thread writes the list once a second into `life-NAME-PID.part`. A normal
end removes the file. An exception renames it to `crash-NAME-STAMP.mcap`.

The file has every message that the journals name, the journals with the requests, the configuration, and the latched
values that the service received. After SEGMENT bytes a new file begins, and the one before stays beside it (`-before`).
Then the beginning is missing. The replay gives the same exception if the service does not need the missing part.
"""

import logging
import os
import re
import shutil
import threading
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from shared import topics
from shared.codec import CodecError, Envelope, decode
from shared.file_modes import make_folder
from shared.messages import LogLine, Message
from shared.recording import CONFIG, Recording, Writer, about
from shared.topics import key_of
from shared.types import NS_PER_S

SEGMENT = 100_000_000  # bytes: an hour of the mapper's life
RESERVE = 500_000_000  # bytes that stay free on the disk
CRASHES = 5  # recordings that are kept of one service, which may crash repeatedly
LATEST = 30  # lists that wait for a slow disk; later ones are dropped, and reported as missing
PATIENCE = 3.0  # s that a crashed process waits for its disk
SHORT = 0.3  # s that a process waits at a normal end

_EVENT = re.compile(r"event \d+ at (\d+) ns")

log = logging.getLogger("zenav")


class Taken(NamedTuple):
    """A received message and its arrival (ns). latched: a whole value for late subscribers."""

    key: str
    type: type[Message]
    payload: bytes
    envelope: Envelope
    now: int
    latched: bool


class BlackBox:
    """Recorder of one service's inputs into `folder`. It never raises, and waits for the disk only in `close`."""

    def __init__(self, folder: Path, name: str, robot: str, config: str) -> None:
        self.folder, self.name = folder, name
        self._robot, self._config = robot, config
        self._now: list[Taken] = []
        self._waiting: SimpleQueue[list[Taken] | None] = SimpleQueue()
        self._part = folder / f"life-{name}-{os.getpid()}.part"
        self._before = self._part.with_suffix(".before")
        self._writer: Writer | None = None
        self._broken = self._unwanted = False
        self._thread = threading.Thread(target=self._write_all, name="blackbox", daemon=True)
        self._thread.start()

    def take(self, taken: Taken) -> None:
        """Adds an input of the service, before the service handles it, or its journal."""
        self._now.append(taken)

    def hand_over(self) -> None:
        """Passes the new inputs to the thread."""
        if self._waiting.qsize() < LATEST:
            self._waiting.put(self._now)
        self._now = []

    def close(self, crashed: int | None) -> Path | None:
        """Ends the recording. crashed: time (ns) of an exception, else None. Returns the path of the crash file."""
        self.hand_over()
        self._unwanted = crashed is None
        self._waiting.put(None)
        self._thread.join(PATIENCE if crashed is not None else SHORT)
        if self._thread.is_alive():
            log.warning("the disk hangs: nothing is left of this life")
            return None
        try:
            return self._ended(crashed)
        except OSError as error:
            self._give_up(error)
            return None

    def _write_all(self) -> None:
        with suppress(OSError, AttributeError):  # real-time priority is not for writing files
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        while (taken := self._waiting.get()) is not None:
            if self._broken or self._unwanted or not taken:
                continue
            try:
                self._write(taken)
            except Exception as error:  # whatever it is, the service goes on
                self._give_up(error)

    def _write(self, taken: list[Taken]) -> None:
        if self._writer is None:
            make_folder(self.folder)
            _remove_orphans(self.folder, self.name)
            self._writer = self._begun()
        elif self._writer.size > SEGMENT:
            self._writer.close()
            self._part.replace(self._before)
            self._writer = self._begun()
        if shutil.disk_usage(self.folder).free < RESERVE:
            raise OSError(f"less than {RESERVE / 1e6:g} MB are free")
        for key, type_, payload, envelope, now, latched in taken:
            self._writer.write(key, type_, payload, now, envelope.sent, envelope.sequence, latched)

    def _begun(self) -> Writer:
        config = {CONFIG: self._config.encode()} if self._config else {}
        return Writer(self._part, {**about(self._robot), "life": self.name}, config)

    def _ended(self, crashed: int | None) -> Path | None:
        if self._writer is None:
            return None
        if crashed is None:
            self._remove()
            return None
        self._writer.close()
        stamp = f"{datetime.fromtimestamp(crashed / NS_PER_S, UTC):%Y%m%d-%H%M%S}"
        path = self.folder / f"crash-{self.name}-{stamp}.mcap"
        self._part.replace(path)
        if self._before.exists():
            self._before.replace(path.with_stem(f"{path.stem}-before"))
        kept = sorted(self.folder.glob(f"crash-{self.name}-*.mcap"), key=lambda p: p.name)
        for old in kept[:-CRASHES]:
            old.unlink(missing_ok=True)
        return path

    def _give_up(self, error: Exception) -> None:
        """Stops recording and removes the files. The service goes on."""
        self._broken = True
        log.warning("a crash of %s could not be recorded: %s", self.name, error)
        self._remove()

    def _remove(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            with suppress(OSError):
                writer.close()
        for path in (self._part, self._before):
            with suppress(OSError):
                path.unlink(missing_ok=True)


def _remove_orphans(folder: Path, name: str) -> None:
    """Removes files of killed processes of this service."""
    for path in [*folder.glob(f"life-{name}-*.part"), *folder.glob(f"life-{name}-*.before")]:
        number = path.stem.rpartition("-")[2]
        if number.isdigit() and not _lives(int(number)):
            with suppress(OSError):
                path.unlink()


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return pid != os.getpid()  # our own pid may have been that of the dead process


def crash_line(error: BaseException, now: int) -> str:
    """The log line for an exception in the event at `now` (ns)."""
    return f"crashed at {now} ns: {type(error).__name__}: {' '.join(str(error).split())}"


def crash_of(error: BaseException) -> str:
    """The log line for an exception of a replay, whose note names the event; empty without such a note."""
    found = [_EVENT.search(note) for note in getattr(error, "__notes__", ())]
    return next((crash_line(error, int(match[1])) for match in found if match), "")


def crash_in(recording: Recording, name: str) -> str:
    """The line of the last crash in a service's log of a recording; empty without a crash."""
    last = ""
    for entry in recording.entries([key_of(topics.LOG, name)]):
        with suppress(CodecError):
            text = decode(LogLine, entry.payload)[0].text
            last = text if text.startswith("crashed at ") else last
    return last
