# SPDX-License-Identifier: Apache-2.0
"""Age and order of stamps and messages, also after a clock was set back."""

from shared.codec import Envelope

FUTURE = 100_000_000
"""ns that a stamp may lie ahead of our clock: the offset of two machines' clocks."""


def fresh(stamp: int, now: int, age: float) -> bool:
    """Whether `stamp` (ns) is at most `age` s old at `now` (ns), and at most FUTURE ahead."""
    return -FUTURE <= now - stamp <= round(age * 1e9)


def precedes(stamp: int, other: int, now: int) -> bool:
    """Whether `stamp` is before `other` (ns). False where `other` is ahead of `now` (ns): the clock was set back."""
    return stamp < other <= now + FUTURE


def supersedes(stamp: int, last: int | None, now: int) -> bool:
    """Whether a message is newer than the last one; after the clock was set back any message is. Stamps and now: ns."""
    return last is None or stamp > last or last > now + FUTURE


def is_older(envelope: Envelope, last: Envelope, now: int) -> bool:
    """Whether a message on a key was sent before the last one. now: ns, the stack's clock.

    Within a session the sequence decides. It goes on where the clock is set back.
    """
    if envelope.session == last.session:
        return envelope.sequence < last.sequence
    return precedes(envelope.sent, last.sent, now)


def is_known(envelope: Envelope, last: Envelope, now: int) -> bool:
    """Whether a kept value is the last message on its key, or an older one. now: ns, the stack's clock."""
    is_last = (envelope.session, envelope.sequence) == (last.session, last.sequence)
    return is_last or is_older(envelope, last, now)
