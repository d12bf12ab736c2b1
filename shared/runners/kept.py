# SPDX-License-Identifier: Apache-2.0
"""What a live service keeps of its latched topics: for late joiners, and on disk for who takes its place."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

from shared import topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.messages import Message
from shared.runners.host import Sent, merged
from shared.runners.memory import REMEMBERED, Memory
from shared.runners.transport import LatchedPublisher

log = logging.getLogger("zenav")


class Kept:
    """own: the keys that the service listens to itself, which alone go to disk, on a thread of `workers`."""

    def __init__(self, memory: Memory | None, own: list[str], workers: Executor) -> None:
        self.publishers: dict[str, LatchedPublisher] = {}
        self._memory, self._own, self._workers = memory, own, workers
        self._values: dict[str, Message] = {}
        self._unsaved: dict[str, Callable[[], bytes]] = {}

    def restored(self, now: int, wrong: Callable[[str, int], None]) -> Iterator[tuple[str, Message, Envelope]]:
        """What was published last before a restart. wrong: is told what is damaged, and `now` (ns)."""
        for key in self._own:
            payload = self._memory.read(key) if self._memory is not None else None
            if payload is None:
                continue
            try:
                message, envelope = decode(topics.BY_KEY[key].type, payload)
            except CodecError as error:
                wrong(f"{key}: what was kept from before the restart is damaged: {error}", now)
                continue
            if 0 <= now - envelope.sent <= REMEMBERED:
                log.info("taking up %s from before the restart", key)
                self._values[key] = message
                yield key, message, envelope

    def publish(self, sent: Sent) -> None:
        """Keeps what is being published on a latched topic."""
        before = self._values.get(sent.key)
        whole = self._values[sent.key] = merged(before, sent.message)
        value = partial(encode, whole, sent.envelope)
        self.publishers[sent.key].keep(value)
        self._unsaved[sent.key] = value
        if not hasattr(sent.message, "merged") and not _same(before, whole):
            self.save()  # what is small and new, as a pressed STOP, does not wait: the next event may be the last

    def save(self) -> None:
        """Writes what is new to disk, soon."""
        if self._memory is not None:
            for key in set(self._own) & set(self._unsaved):
                self._workers.submit(self._memory.write, key, self._unsaved.pop(key))


def _same(before: Message | None, message: Message) -> bool:
    """Whether two messages say the same, at whatever time."""
    nobody = Envelope("", "", 0, 0)
    return before is not None and encode(replace(before, stamp=message.stamp), nobody) == encode(message, nobody)
