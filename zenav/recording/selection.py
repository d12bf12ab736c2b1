# SPDX-License-Identifier: Apache-2.0
"""What all commands on recordings share: the keys that a person names, times since the start, names of new files."""

from collections.abc import Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from math import inf
from pathlib import Path

from shared.config import UserError, nearest
from shared.recording import Recording, is_locked
from shared.topics import KEYS
from shared.types import NS_PER_S

OUT_HINT = "choose another --out"


def keys_in(recording: Recording, patterns: Sequence[str]) -> frozenset[str] | None:
    """The recording's keys that patterns like health/* name; None, all, without a pattern. Raises UserError."""
    if not patterns:
        return None
    if not recording.indexed:
        for _ in recording.entries(as_recorded=True):
            pass  # without an index, a channel is known when it was read
    there = {source.recorded.key for source in recording.sources.values()}
    keys: set[str] = set()
    for pattern in patterns:
        named = {key for key in there if fnmatchcase(key, pattern)}
        if not named:
            is_topic = any(fnmatchcase(key, pattern) for key in KEYS)
            what = "holds nothing on" if is_topic else "has no topic"
            raise UserError(f"{recording.path} {what} {pattern}", nearest(pattern, tuple(sorted(there))))
        keys |= named
    return frozenset(keys)


def begin_of(recording: Recording) -> int:
    """ns: its first log_time, 0 where it holds nothing."""
    return min((block.begin for block in recording.blocks), default=0)


def end_of(recording: Recording) -> int:
    """ns: its last log_time."""
    return max((block.end for block in recording.blocks), default=0)


def time_range(recording: Recording, begin: float | None, end: float | None) -> tuple[int | None, int | None]:
    """ns from seconds since the start. Raises UserError where they leave nothing."""
    if begin is not None and end is not None and end <= begin:
        raise UserError(f"nothing lies between {begin:g} and {end:g} s", "--begin comes before --end")
    zero = begin_of(recording)
    length = (end_of(recording) - zero) / NS_PER_S
    if begin is not None and begin > length:
        raise UserError(f"{recording.path} is {length:.1f} s long", f"--begin lies before that, not at {begin:g}")

    def at(seconds: float | None) -> int | None:
        return None if seconds is None or seconds == inf else zero + round(seconds * NS_PER_S)

    return at(begin), at(end)


def check_new_recording(out: Path, *sources: Path) -> Path:
    """A name for a new recording. Raises UserError where it is read from, still written, or no MCAP's."""
    if out.suffix != ".mcap":
        raise UserError(f"{out} is no name for a recording", f"end it in .mcap: --out {out}.mcap")
    for source in sources:
        if out.exists() and source.exists() and out.samefile(source):
            raise UserError(f"{out} is read from", OUT_HINT)
    check_not_written(out)
    return out


def check_not_written(path: Path) -> None:
    """Raises UserError where a recorder still writes the file: what replaced it would lose all that follows."""
    with suppress(OSError), path.open("rb") as file:  # OSError: there is no file, or its file system has no locks
        if is_locked(file):
            raise UserError(f"{path} is still being written", "end its recorder first, or choose another file")
