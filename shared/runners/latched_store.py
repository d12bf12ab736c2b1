# SPDX-License-Identifier: Apache-2.0
"""The latched values of a live service: for late subscribers, and on disk for its next process."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial

from shared import topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.messages import Message
from shared.runners.host import Sent, merged
from shared.runners.latched_disk import MAX_RESTART_AGE_NS, LatchedDisk
from shared.runners.transport import LatchedPublisher

PATIENCE_S = 0.2  # s that the end of a process waits for its disk

log = logging.getLogger("zenav")


class LatchedStore:
    """Latched values of one service. own: the keys that it subscribes to itself: only these are on disk.

    A thread of its own writes the files: a value would else wait for a slow job, and be lost with a crash meanwhile.
    """

    def __init__(self, disk: LatchedDisk | None, own: list[str]) -> None:
        self.publishers: dict[str, LatchedPublisher] = {}
        self._disk, self._own = disk, own
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="latched")
        self._values: dict[str, Message] = {}
        self._unsaved: dict[str, Callable[[], bytes]] = {}

    def restore(self, now: int, wrong: Callable[[str, int], None]) -> Iterator[tuple[str, Message, Envelope]]:
        """The last messages before a restart, if the newest is at most MAX_RESTART_AGE_NS old; else they are removed.

        One that rarely changes, as a map's edits, may be older: the newest shows when the process ended. Where that is
        ahead of `now`, the clock was set back. Settings are taken at any age. wrong: called with damage and `now`.
        """
        disk, restored = self._disk, []
        for key in self._own if disk is not None else ():
            payload, topic = disk.read(key) if disk is not None else None, topics.topic_of(key)
            if payload is None or topic is None:
                continue
            try:
                restored.append((key, *decode(topic.type, payload)))
            except CodecError as error:
                wrong(f"{key}: what was kept from before the restart is damaged: {error}", now)
        newest = max((envelope.sent for _, _, envelope in restored), default=0)
        for key, message, envelope in restored:
            if topics.topic_of(key) is topics.SETTINGS or abs(now - newest) <= MAX_RESTART_AGE_NS:
                log.info("taking up %s from before the restart", key)
                self._values[key] = message
                yield key, message, envelope
            elif disk is not None:
                disk.remove(key)

    def publish(self, sent: Sent) -> None:
        """Stores a publication of a latched topic."""
        before = self._values.get(sent.key)
        whole = self._values[sent.key] = merged(before, sent.message)
        value = partial(encode, whole, sent.envelope)
        self.publishers[sent.key].keep(value)
        self._unsaved[sent.key] = value
        if not hasattr(sent.message, "merged") and not _same(before, whole):
            self.save()  # a small new value, as a pressed STOP, is saved at once: the next event may crash

    def save(self) -> None:
        """Orders the writing of new values to disk."""
        if self._disk is not None:
            for key in set(self._own) & set(self._unsaved):
                self._writer.submit(self._disk.write, key, self._unsaved.pop(key))

    def close(self) -> None:
        """Returns when every ordered value is on the disk, or after PATIENCE_S."""
        wait([self._writer.submit(lambda: None)], PATIENCE_S)
        self._writer.shutdown(wait=False, cancel_futures=True)


def _same(before: Message | None, message: Message) -> bool:
    """Whether two messages are equal apart from their stamps."""
    envelope = Envelope("", "", 0, 0)
    return before is not None and encode(replace(before, stamp=message.stamp), envelope) == encode(message, envelope)
