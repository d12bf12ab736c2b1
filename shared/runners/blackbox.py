# SPDX-License-Identifier: Apache-2.0
"""A live service's black box: what it took in this life, so that its death by an exception can be replayed.

The service's loop only appends to a list. A thread writes, once a second, into `life-NAME-PID.part`; an end in order
removes the file, an exception makes it `crash-NAME-STAMP.mcap`: every message that the journals name, the journals with
the requests, the configuration, and, as latched, the values that the service was given whole. Where a life
outgrows SEGMENT bytes, the file begins anew and the one before stays beside it (`-before`): then the beginning is
missing, and whether the replay comes to the same exception depends on how much of it the service still needs.
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
from shared.messages import LogLine, Message
from shared.recording import CONFIG, Recording, Writer, about
from shared.runners.clock import SECOND
from shared.topics import key_of

SEGMENT = 100_000_000  # bytes: an hour of the mapper's life
RESERVE = 500_000_000  # bytes that stay free on the disk
CRASHES = 5  # recordings that are kept of one service: it may die again and again
LATEST = 30  # lists that wait for a slow disk; what comes after is thrown away, and said to be missing
PATIENCE = 3.0  # s that a dying process waits for its disk
SHORT = 0.3  # s that one waits that ends in order

_EVENT = re.compile(r"event \d+ at (\d+) ns")

log = logging.getLogger("zenav")


class Taken(NamedTuple):
    """One message as it came, and when (ns). latched: the whole value that is kept for late joiners."""

    key: str
    type: type[Message]
    payload: bytes
    envelope: Envelope
    now: int
    latched: bool


class BlackBox:
    """Never raises, and never waits for the disk until the end. folder: where the files go."""

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
        """Keeps a message that the service is about to take, or its journal."""
        self._now.append(taken)

    def hand_over(self) -> None:
        """Gives what was taken to the thread."""
        if self._waiting.qsize() < LATEST:
            self._waiting.put(self._now)
        self._now = []

    def close(self, crashed: int | None) -> Path | None:
        """Ends the life; `crashed`: when (ns), if by an exception. Returns the crash's recording, if there is one."""
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
        with suppress(OSError, AttributeError):  # its place in the velocity path is not for writing files
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
            self.folder.mkdir(parents=True, exist_ok=True)
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
        stamp = f"{datetime.fromtimestamp(crashed / SECOND, UTC):%Y%m%d-%H%M%S}"
        path = self.folder / f"crash-{self.name}-{stamp}.mcap"
        self._part.replace(path)
        if self._before.exists():
            self._before.replace(path.with_stem(f"{path.stem}-before"))
        kept = sorted(self.folder.glob(f"crash-{self.name}-*.mcap"), key=lambda p: p.name)
        for old in kept[:-CRASHES]:
            old.unlink(missing_ok=True)
        return path

    def _give_up(self, error: Exception) -> None:
        """The service goes on without; what was written makes room."""
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
    """Removes what killed processes of this service left behind."""
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
    return pid != os.getpid()  # a number that is used again is not the one that wrote it


def crash_line(error: BaseException, now: int) -> str:
    """What a service's log says of the exception that ended it, in the event that it took at `now` (ns)."""
    return f"crashed at {now} ns: {type(error).__name__}: {' '.join(str(error).split())}"


def crash_of(error: BaseException) -> str:
    """The same of an exception that a replay raised, whose note names the event."""
    found = [_EVENT.search(note) for note in getattr(error, "__notes__", ())]
    return next((crash_line(error, int(match[1])) for match in found if match), "")


def crash_in(recording: Recording, name: str) -> str:
    """How a service's last session in a recording ended, by its log; empty where it did not by an exception."""
    last = ""
    for entry in recording.entries([key_of(topics.LOG, name)]):
        with suppress(CodecError):
            text = decode(LogLine, entry.payload)[0].text
            last = text if text.startswith("crashed at ") else last
    return last
