# SPDX-License-Identifier: Apache-2.0
"""What a stamp says: how old a thing is, and which of two things came first, also after a clock was set back."""

FUTURE = 100_000_000
"""ns that a stamp may lie ahead of our clock: the skew of two machines' clocks."""


def fresh(stamp: int, now: int, age: float) -> bool:
    """Whether what was true at `stamp` is at most `age` s old, and not from the future."""
    return -FUTURE <= now - stamp <= round(age * 1e9)


def precedes(stamp: int, other: int, now: int) -> bool:
    """Whether it is from before the other; nothing is where the other is from the future: the clock was set back."""
    return stamp < other <= now + FUTURE


def supersedes(stamp: int, last: int | None, now: int) -> bool:
    """Whether a message is newer than the last one; after the clock was set back any message is."""
    return last is None or stamp > last or last > now + FUTURE
