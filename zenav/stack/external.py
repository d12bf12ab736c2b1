# SPDX-License-Identifier: Apache-2.0
"""Programs beside the stack that take the place of services: which messages must they send, and do these pass?"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from services.base_driver.config import BaseDriverConfig
from shared import topics
from shared.config import Robot, RobotFile
from shared.lasers import SCAN_TOPICS, lasers_by_topic
from shared.messages import Message
from shared.service import handlers
from shared.topics import TOPICS, Topic
from zenav.client import Client
from zenav.client.topic_check import KeyCheck
from zenav.stack.service_loader import service_class

PERIOD_S = 2.0  # between two looks at the messages of each topic
SOURCES = (topics.BOARD, topics.BASE_MOTION, *SCAN_TOPICS)
OF_DRIVE: dict[str, tuple[Topic[Any], ...]] = {
    "differential": (topics.BOARD, topics.MOTORS, topics.WHEELS),
    "velocity": (topics.BASE_MOTION, topics.VELOCITY, topics.BASE_ODOMETRY),
}
"""Topics that only robots with this robot.drive.kind have."""
ALL_RUN = "every service runs"
HINT = (
    "connect the robot's devices (base_driver.port, lidar_driver.port), simulate with --world office, "
    "take a ROS 2 robot's with --ros2 and --set ros2.drives=true, or start a program of your own with --external sim"
)


def expected_topics(names: Sequence[str], external: Sequence[str], file: RobotFile) -> list[Topic[Message]]:
    """The topics with a rate that started services read, and that external programs must publish.

    names: the services that are started. Without any source of the board's reports or of scans these are expected, too.
    """
    read = {key for name in names for key in handlers(service_class(name)).topics}
    if file.section("base_driver", BaseDriverConfig).port.given:
        read -= {topics.BOARD.key, topics.BASE_MOTION.key}
    read -= {topic.key for kind, used in OF_DRIVE.items() if kind != file.robot.drive.kind for topic in used}
    read -= {topic.key for topic in SCAN_TOPICS} - {topic.key for topic in lasers_by_topic(file.robot)}
    sources = set(names) - {"ros2"}  # which passes on what a robot sends, if any does
    return [
        topic
        for topic in TOPICS
        if topic.key in read
        and topic.hz
        and topic.by != "*"
        and not set(topic.publishers) & sources
        and (set(topic.publishers) & set(external) or topic in SOURCES)
    ]


class ExternalWatch:
    """Reports when the messages of external programs pass, what is wrong with them, and when they end.

    show: writes a line for the user.  clock: s, monotonic.
    """

    def __init__(
        self,
        client: Client,
        expected: Sequence[Topic[Message]],
        robot: Robot,
        show: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot, self._show, self._clock = robot, show, clock
        self._client = client
        self._topics = {topic.key: topic for topic in expected}
        self._checks = {key: KeyCheck(key, topic, robot) for key, topic in self._topics.items()}
        self._shown = dict.fromkeys(self._topics, "")  # by key: the kind of the last line
        self._due = clock() + PERIOD_S
        self._passed: set[str] = set()
        self._is_reported = False  # that messages are missing
        for key in self._topics:
            client.listen_raw(key, partial(self._take, key))

    def missing(self) -> list[str]:
        """Keys of which no message has passed so far."""
        return [key for key, check in self._checks.items() if key not in self._passed and not check.n_passed]

    def ready_text(self) -> str:
        """Words for the user when all services have started."""
        missing = self.missing()
        self._is_reported = bool(missing)
        if missing:
            return f"the services run, but nothing usable comes on {', '.join(missing)}; hint: {HINT}"
        return ALL_RUN

    def step(self) -> None:
        """Reports what changed, every 2 s. Call it a few times a second."""
        if self._clock() < self._due:
            return
        self._due = self._clock() + PERIOD_S
        for key, check in self._checks.items():
            kind, line = self._line(check)
            if kind not in (self._shown[key], ""):
                self._shown[key] = kind
                self._show(line)
            if check.n_passed:
                self._passed.add(key)
        if self._is_reported and not self.missing():
            self._is_reported = False
            self._show(ALL_RUN)
        self._checks = {key: KeyCheck(key, topic, self._robot) for key, topic in self._topics.items()}

    def _line(self, check: KeyCheck) -> tuple[str, str]:
        """The kind of a period's messages, and its words. The kind is empty before the first message."""
        problem = check.newest()
        if problem is not None:
            return problem.kind, f"{problem.what}; hint: {problem.hint}"
        if check.n_passed:
            return "pass", f"{check.key} passes: {check.rate():.1f} Hz of {check.publisher}"
        return ("silent", f"{check.key}: no messages any more") if self._shown[check.key] else ("", "")

    def _take(self, key: str, _: str, payload: bytes) -> None:
        self._checks[key].take(payload, self._client.now())
