# SPDX-License-Identifier: Apache-2.0
"""Records the payloads of all topics, or of selected ones, unchanged. shared/recording.py describes the file."""

import errno

from services.recorder.message_losses import MessageLosses, MessageSource
from services.recorder.recording_files import listed_recordings, read_part
from services.recorder.recording_store import RecorderConfig, RecordingStore
from shared import requests, topics
from shared.codec import Envelope
from shared.config import Robot
from shared.messages import Message
from shared.reasons import DISK_FULL, NO_SUCH_FILE, NOT_RECORDED, Reason
from shared.recording import Drop
from shared.recording_requests import MAX_RECORDING_PART, FetchRecording, ListRecordings, RecordingList, RecordingPart
from shared.recordings.latched_state import LatchedState
from shared.service import Answer, Log, Out, Service, answer, every
from shared.settings import Configuration
from shared.topics import Topic
from shared.types import NS_PER_S

MAX_RETRY_WAIT_NS = 32 * NS_PER_S  # maximum time between two tries after a disk error
MIN_STABLE_NS = 10 * NS_PER_S  # a part that grew for so long resets the wait between tries


class RecorderService(Service):
    """The live runner passes every payload on every key of the robot to `raw`, and the robot's file as `robot_file`.

    After a disk error the flushed data stays, and `state` gives the reason. The service counts the unwritten messages
    and tries again, each time in a new part. The next part lists all messages that are missing.
    """

    config_type = RecorderConfig
    config: RecorderConfig
    robot_file = ""

    def __init__(self, config: RecorderConfig, robot: Robot, store: RecordingStore) -> None:
        super().__init__(config, robot)
        self._store = store
        self._wanted = config.wanted()
        self._latched, self._losses = LatchedState(), MessageLosses()
        self._part_start: int | None = None  # ns, start of the open part
        self._open_name = ""  # of the part that is written
        self._failure: Reason | None = None
        self._retry_at, self._retry_wait = 0, NS_PER_S  # ns: time of the next try, wait after the next disk error
        self._unflushed: list[tuple[MessageSource, int]] = []
        self._unflushed_drops: list[Drop] = []
        self._pending_logs: list[Log] = []
        self._n_recorded = self._n_unknown = 0

    def raw(self, key: str, payload: bytes, envelope: Envelope, now: int, latched: bool = False) -> None:
        """Records a payload on a key (without the robot's name); now: ns.

        latched: the payload was published before the recorder started, and kept for late subscribers.
        """
        topic = topics.topic_of(key)
        if topic is None:
            self._n_unknown += 1
            return
        if key not in self._wanted:
            return
        source = key, envelope.session
        if latched:
            if self._latched.take_whole(key, payload) and self._failure is None:
                self._write_latched(topic, payload, envelope, now)
            return
        self._losses.record_received(source, envelope.sequence)
        is_waiting = self._retry_at - MAX_RETRY_WAIT_NS <= now < self._retry_at  # False also after a jump of the clock
        if self._failure is not None and is_waiting:
            self._losses.record_unwritten(self._failure.code, source, envelope.sequence)
        else:
            self._write(topic.type, source, payload, envelope, now)
        self._latched.take(key, payload)

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        """Sets the limits of parts, budget and uploads."""
        self._store.configure(new.config)
        return ()

    @answer(requests.LIST_RECORDINGS)
    def list_recordings(self, request: ListRecordings) -> Answer[RecordingList]:
        """Lists the recordings of the folder for a site."""
        yield from ()
        files = listed_recordings(self.config.recordings_folder)
        rows = tuple((file.name, file.size, file.modified, file.name == self._open_name) for file in files)
        return RecordingList(self.now, True, "", "", rows)

    @answer(requests.FETCH_RECORDING)
    def fetch_recording(self, request: FetchRecording) -> Answer[RecordingPart]:
        """Reads a part of a recording for a site."""
        yield from ()
        length = request.length if request.digest else min(request.length, MAX_RECORDING_PART)
        try:
            part = read_part(self.config.recordings_folder, request.name, request.offset, length)
        except OSError as error:
            return RecordingPart(self.now, False, NO_SUCH_FILE.code, error.strerror or str(error))
        if part is None:
            return RecordingPart(self.now, False, NO_SUCH_FILE.code, request.name)
        data, digest, size = part
        data = b"" if request.digest else data
        return RecordingPart(self.now, accepted=True, reason="", detail="", size=size, data=data, sha256=digest)

    @every(hz=2)
    def flush(self) -> Out:
        """Flushes the file, so that it survives a crash, and begins the next part when this one is full."""
        if self._part_start is not None:
            try:
                self._write_losses(self.now)
                self._store.flush()
                self._unflushed.clear()
                self._unflushed_drops.clear()
                if self.now - self._part_start >= MIN_STABLE_NS:
                    self._retry_wait = NS_PER_S
                if self._store.is_full(self.now):
                    self._store.end()
                    self._begin_part(self.now)
            except OSError as error:
                self._on_disk_error(error, self.now)
        logs, self._pending_logs = self._pending_logs, []
        yield from logs
        yield from self._store.step_upload()

    def on_shutdown(self) -> Out:
        """Leaves to the store what is missing since the last flush."""
        if self._part_start is not None:
            self._store.last_drops = self._losses.take_drops(self.now)
        return ()

    def state(self) -> str:
        text = f"recording, {self._n_recorded} messages" if self._part_start is not None else "waiting for a message"
        if self._failure is not None:
            text = self._failure.text
        counts = {
            "not recorded": self._losses.n_unwritten,
            "missed": self._losses.n_missed,
            "of unknown topics left out": self._n_unknown,
            "parts removed before their upload": self._store.n_removed_before_upload,
        }
        uploads = [self._store.upload_text] if self._store.upload_text else []
        return ", ".join([text, *(f"{n} {what}" for what, n in counts.items() if n), *uploads])

    def _write(self, type_: type[Message], source: MessageSource, payload: bytes, envelope: Envelope, now: int) -> None:
        try:
            if self._part_start is None:
                self._begin_part(now)
            self._store.write(source[0], type_, payload, now, envelope)
        except OSError as error:
            self._losses.record_unwritten(self._on_disk_error(error, now), source, envelope.sequence)
        else:
            self._n_recorded += 1
            self._unflushed.append((source, envelope.sequence))

    def _write_latched(self, topic: Topic[Message], payload: bytes, envelope: Envelope, now: int) -> None:
        try:
            if self._part_start is None:
                self._begin_part(now)  # writes all latched values
            else:
                self._store.write(topic.key, topic.type, payload, now, envelope, latched=True)
        except OSError as error:
            self._on_disk_error(error, now)

    def _begin_part(self, now: int) -> None:
        """Begins the next part. Raises OSError."""
        self._part_start = None
        self._store.begin(now, self.robot.name, self.robot_file, self._latched.values())
        self._part_start = now
        self._open_name = self._store.path.name if self._store.path is not None else ""
        self._failure = None
        self._write_losses(now)
        self._pending_logs.append(Log("INFO", f"recording to {self._store.path}"))

    def _write_losses(self, now: int) -> None:
        """Writes what is missing. Raises OSError."""
        drops = self._losses.take_drops(now)
        self._unflushed_drops += drops
        self._store.note_drops(drops)

    def _on_disk_error(self, error: OSError, now: int) -> str:
        """Counts the unflushed messages as unwritten and schedules the next try. Returns the reason's code.

        Drops that were not flushed go into the next part.
        """
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        reason = DISK_FULL if full else NOT_RECORDED
        if self._failure is None:
            text = reason.text if full else f"{reason.text}: {error.strerror or error}"
            self._pending_logs.append(Log("ERROR", f"{text}. {reason.hint}"))
        self._failure, self._part_start = reason, None
        for source, sequence in self._unflushed:
            self._losses.record_unwritten(reason.code, source, sequence)
        self._n_recorded -= len(self._unflushed)
        self._unflushed.clear()
        self._losses.restore_drops(self._unflushed_drops)
        self._unflushed_drops.clear()
        self._retry_at, self._retry_wait = now + self._retry_wait, min(2 * self._retry_wait, MAX_RETRY_WAIT_NS)
        return reason.code
