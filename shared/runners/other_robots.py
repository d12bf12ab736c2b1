# SPDX-License-Identifier: Apache-2.0
"""Messages of other robots on a key of theirs (`Topic.from_robots`): which of them count."""

from shared import topics
from shared.codec import CodecError, decode
from shared.messages import Message
from shared.runners.admission import Admission, Verdict
from shared.topics import Topic
from shared.types import NS_PER_S

MAX_ROBOTS = 256  # whose messages are kept apart; those of further ones are dropped
GONE_NS = 2 * NS_PER_S
"""ns without a message after which another process of a robot counts, also where its clock was set back."""


def key_of_others(topic: Topic[Message]) -> str:
    """The key expression of every robot's messages, this one's included."""
    return f"*/{topic.from_robots}"


class OtherRobotsAdmission:
    """Admits the messages of each robot in their order, one publishing process a robot."""

    def __init__(self, topic: Topic[Message], own_name: str) -> None:
        """topic: with `from_robots`.  own_name: of this robot, whose messages do not count."""
        self._source, self._own_name = topics.BY_KEY[topic.from_robots], own_name
        self._admissions: dict[str, Admission] = {}

    def admitted(self, full_key: str, payload: bytes, now: int) -> Message | None:
        """The message, or None for one that does not count. full_key: with the robot's name.  now: ns.

        Raises CodecError for a bad message.
        """
        robot = full_key.partition("/")[0]
        if robot == self._own_name:
            return None
        message, envelope = decode(self._source.type, payload)
        if getattr(message, "robot", robot) != robot:
            raise CodecError(f"it names another robot than its key {full_key}")
        admission = self._admissions.get(robot)
        if admission is None and len(self._admissions) >= MAX_ROBOTS:
            raise CodecError(f"the messages of over {MAX_ROBOTS} robots")
        if admission is None or (envelope.session != admission.session and not 0 <= now - admission.heard < GONE_NS):
            admission = Admission(self._source)
        if admission.judge(envelope, now) not in (Verdict.TAKE, Verdict.GAP):
            return None
        self._admissions[robot] = admission
        return message
