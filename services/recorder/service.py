# SPDX-License-Identifier: Apache-2.0
"""Records every message of the registry, or a choice, as it went on the wire. shared/recording.py tells of the file."""

import errno

from services.recorder.losses import Losses, Source
from services.recorder.store import RecorderConfig, RecordingStore
from shared import topics
from shared.codec import Envelope
from shared.config import Robot
from shared.messages import Message
from shared.reasons import DISK_FULL, NOT_RECORDED, Reason
from shared.recordings.held import Held
from shared.service import Log, Out, Service, every
from shared.topics import Topic

SECOND = 1_000_000_000
LONGEST_WAIT = 32 * SECOND  # between two tries of a disk that refuses
STEADY = 10 * SECOND  # that a part must have grown for, until the next refusal is a new one


class RecorderService(Service):
    """The live runner hands it every payload on every key of the robot (`raw`), and the robot's file (`robot_file`).

    Where the disk refuses, what was flushed stays, `state` says why, the rest is counted; and it is tried again, each
    time in a new part. What did not come or could not be written stands in the next part that can be.
    """

    config_type = RecorderConfig
    robot_file = ""

    def __init__(self, config: RecorderConfig, robot: Robot, store: RecordingStore) -> None:
        super().__init__(config, robot)
        self._store = store
        self._wanted = config.wanted()
        self._held, self._losses = Held(), Losses()
        self._begun: int | None = None  # ns, the open part
        self._trouble: Reason | None = None
        self._again, self._wait = 0, SECOND  # ns: when the disk is tried again, and how long after the next refusal
        self._unflushed: list[tuple[Source, int]] = []
        self._untold: list[Log] = []
        self._n_recorded = self._n_unknown = 0

    def raw(self, key: str, payload: bytes, envelope: Envelope, now: int, latched: bool = False) -> None:
        """A payload on a key (without the robot's name). latched: kept for late joiners, from before the recorder."""
        topic = topics.topic_of(key)
        if topic is None:
            self._n_unknown += 1
            return
        if key not in self._wanted:
            return
        source = key, envelope.session
        if latched:
            if self._held.take_whole(key, payload) and self._trouble is None:
                self._write_kept(topic, payload, envelope, now)
            return
        self._losses.came(source, envelope.sequence)
        waits = self._again - LONGEST_WAIT <= now < self._again  # else the clock has jumped
        if self._trouble is not None and waits:
            self._losses.unwritten(self._trouble.code, source, envelope.sequence)
        else:
            self._write(topic.type, source, payload, envelope, now)
        self._held.take(key, payload)

    @every(hz=2)
    def flush(self) -> Out:
        """What was recorded outlives a crash from here on; a part that is full gives way to the next."""
        if self._begun is not None:
            try:
                self._write_losses(self.now)
                self._store.flush()
                self._unflushed.clear()
                if self.now - self._begun >= STEADY:
                    self._wait = SECOND
                if self._store.full(self.now):
                    self._store.end()
                    self._begin(self.now)
            except OSError as error:
                self._refused(error, self.now)
        untold, self._untold = self._untold, []
        yield from untold

    def state(self) -> str:
        words = f"recording, {self._n_recorded} messages" if self._begun is not None else "waiting for a message"
        if self._trouble is not None:
            words = self._trouble.text
        counts = {
            "not recorded": self._losses.n_unwritten,
            "missed": self._losses.n_missed,
            "of unknown topics left out": self._n_unknown,
        }
        return ", ".join([words, *(f"{n} {what}" for what, n in counts.items() if n)])

    def _write(self, type_: type[Message], source: Source, payload: bytes, envelope: Envelope, now: int) -> None:
        try:
            if self._begun is None:
                self._begin(now)
            self._store.write(source[0], type_, payload, now, envelope)
        except OSError as error:
            self._losses.unwritten(self._refused(error, now), source, envelope.sequence)
        else:
            self._n_recorded += 1
            self._unflushed.append((source, envelope.sequence))

    def _write_kept(self, topic: Topic[Message], payload: bytes, envelope: Envelope, now: int) -> None:
        try:
            if self._begun is None:
                self._begin(now)  # with all that is held
            else:
                self._store.write(topic.key, topic.type, payload, now, envelope, latched=True)
        except OSError as error:
            self._refused(error, now)

    def _begin(self, now: int) -> None:
        """The next part. Raises OSError."""
        self._begun = None
        self._store.begin(now, self.robot.name, self.robot_file, self._held.values())
        self._begun = now
        self._trouble = None
        self._write_losses(now)
        self._untold.append(Log("INFO", f"recording to {self._store.path}"))

    def _write_losses(self, now: int) -> None:
        drops = self._losses.taken(now)
        try:
            self._store.note_drops(drops)
        except OSError:
            self._losses.give_back(drops)
            raise

    def _refused(self, error: OSError, now: int) -> str:
        """The disk took back what was not flushed; it is tried again after a while. Returns the reason's code."""
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        reason = DISK_FULL if full else NOT_RECORDED
        if self._trouble is None:
            words = reason.text if full else f"{reason.text}: {error.strerror or error}"
            self._untold.append(Log("ERROR", f"{words}. {reason.mend}"))
        self._trouble, self._begun = reason, None
        for source, sequence in self._unflushed:
            self._losses.unwritten(reason.code, source, sequence)
        self._n_recorded -= len(self._unflushed)
        self._unflushed.clear()
        self._again, self._wait = now + self._wait, min(2 * self._wait, LONGEST_WAIT)
        return reason.code
