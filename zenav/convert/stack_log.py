# SPDX-License-Identifier: Apache-2.0
"""A recording of the stack itself as a log: what it measured, where it thought to be, and where it was."""

from collections import Counter
from pathlib import Path

from shared import topics
from shared.codec import CodecError, decode
from shared.config import Mount, UserError, nearest
from shared.lasers import lasers_by_topic
from shared.messages import LaserScan, Message
from shared.recording import Recording
from shared.topics import topic_of
from zenav.convert.content import Choice, Content
from zenav.recording.opening import recorded_robot_file

PROFILE = 8 + 1 + 8 + 4  # bytes before the profile's name: magic, opcode and length of the header, length of the name
KEYS = frozenset(topic.key for topic in (topics.SCAN, topics.ODOM, topics.POSE, topics.MAP, topics.PLAN, topics.TRUTH))
"""What other people's tools have a type for."""


def is_recording(path: Path) -> bool:
    """Whether an MCAP file says that the stack wrote it."""
    with path.open("rb") as file:
        return file.read(PROFILE + 5)[PROFILE:] == b"zenav"


def read_recording(path: Path, choice: Choice) -> Content:
    """The messages under KEYS; a second laser (`scan/rear`) where it is chosen. Raises UserError."""
    recording = Recording(path)
    messages: list[tuple[str, Message]] = []
    bad: Counter[str] = Counter()
    seen: Counter[str] = Counter()
    for entry in recording.entries():
        topic = topic_of(entry.key)
        seen[entry.key] += 1
        wanted = entry.key in KEYS if not choice.scan or entry.key != "scan" else False
        if topic is None or not (wanted or entry.key == choice.scan):
            continue
        try:
            message, _ = decode(topic.type, entry.payload)
        except CodecError:
            bad[entry.key] += 1
            continue
        messages.append((topic.key, message))
    if choice.scan and not any(isinstance(message, LaserScan) for _, message in messages):
        raise UserError(f"{path}: no topic {choice.scan} with scans", nearest(choice.scan, tuple(sorted(seen))))
    messages.sort(key=lambda row: row[1].stamp)
    notes = list(recording.problems)
    notes += [f"{n} of {seen[key]} messages on {key} are not valid in this version" for key, n in bad.items()]
    mount = _mount(recording, choice.scan)
    if mount is None:
        notes.append("no configuration in it that can be read: the laser is taken to sit on the axis and look ahead")
    lacks = f"it was recorded without `scan`; its topics: {', '.join(sorted(seen)) or 'none'}"
    return Content(messages, mount or Mount(), sum(bad.values()), notes, lacks)


def _mount(recording: Recording, key: str) -> Mount | None:
    """The place of the laser with scans on this key, in the configuration that the recording was made with."""
    try:
        file = recorded_robot_file(recording)
        if file is None:
            return None
        lasers = {topic.key: laser for topic, laser in lasers_by_topic(file.robot).items()}
        return lasers.get(key, file.robot.laser).mount
    except UserError:  # it is damaged, and the messages need not be
        return None
