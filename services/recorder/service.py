# SPDX-License-Identifier: Apache-2.0
"""Records every message of the registry as it went on the wire. See shared/recording.py for the file."""

import errno

from services.recorder.store import RecorderConfig, RecordingStore
from shared import topics
from shared.codec import Envelope
from shared.config import Robot
from shared.recording import CONFIG
from shared.service import Log, Out, Service, every


class RecorderService(Service):
    """The live runner hands it every payload on every key of the robot (`raw`), and the robot's file (`robot_file`).

    Where the disk refuses, recording ends: what was flushed stays, the rest is counted, and `state` says why.
    """

    config_type = RecorderConfig
    robot_file = ""

    def __init__(self, config: RecorderConfig, robot: Robot, store: RecordingStore) -> None:
        super().__init__(config, robot)
        self._store = store
        self._begun = False
        self._trouble = ""
        self._untold: list[Log] = []
        self._n_recorded = self._n_lost = self._n_unknown = 0

    def raw(self, key: str, payload: bytes, envelope: Envelope, now: int) -> None:
        """A payload on a key (without the robot's name)."""
        topic = topics.topic_of(key)
        if topic is None:
            self._n_unknown += 1
        elif self._trouble:
            self._n_lost += 1
        else:
            try:
                self._begin(now)
                self._store.write(key, topic.type, payload, now, envelope.sent, envelope.sequence)
                self._n_recorded += 1
            except OSError as error:
                self._n_lost += 1
                self._end(error)

    @every(hz=1)
    def flush(self) -> Out:
        """What was recorded outlives a crash from here on."""
        if self._begun and not self._trouble:
            try:
                self._store.flush()
            except OSError as error:
                self._end(error)
        untold, self._untold = self._untold, []
        yield from untold

    def state(self) -> str:
        unknown = f", {self._n_unknown} of unknown topics left out" if self._n_unknown else ""
        if self._trouble:
            return f"{self._trouble}: recording ended, {self._n_lost} messages not recorded{unknown}"
        return f"recording, {self._n_recorded} messages{unknown}" if self._begun else "waiting for a message"

    def _begin(self, now: int) -> None:
        if not self._begun:
            self._store.begin(now, self.robot.name, {CONFIG: self.robot_file.encode()} if self.robot_file else {})
            self._begun = True
            self._untold.append(Log("INFO", f"recording to {self.config.file or self.config.folder}"))

    def _end(self, error: OSError) -> None:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        self._trouble = "disk full" if full else (error.strerror or str(error))
        self._untold.append(Log("ERROR", f"recording ended: {self._trouble}"))
