# SPDX-License-Identifier: Apache-2.0
"""Are the ranges in a board's report those of robot.ranges, and does each sonar answer?"""

from shared.config import Robot
from shared.messages import BoardReport

DEAD_AFTER = 250_000_000
"""ns of stamps over which a sonar reads 0 m, which no working one does."""


class RangeSensors:
    """Watches a board that speaks in messages. A kind of sensor that robot.ranges does not have is ignored."""

    def __init__(self, robot: Robot) -> None:
        kinds = [sensor.kind for sensor in robot.ranges]
        self._expected = {kind: kinds.count(kind) for kind in ("ultrasonic", "infrared")}
        self._zero_since: dict[int, int] = {}  # sonar -> ns, the first of its readings of 0
        self.mismatch = ""
        """How many ranges the board sends where robot.ranges has others, in words; empty where they agree."""
        self.dead = ""
        """Which sonars do not answer, in words; empty where all do."""

    def take(self, report: BoardReport) -> None:
        """Looks at a report."""
        sent = {"ultrasonic": len(report.ultrasonic), "infrared": len(report.infrared)}
        wrong = (kind for kind, n in self._expected.items() if n and n != sent[kind])
        self.mismatch = ", ".join(
            f"the board sends {sent[kind]} {kind} ranges, robot.ranges has {self._expected[kind]}" for kind in wrong
        )
        zeros = [i for i, metres in enumerate(report.ultrasonic[: self._expected["ultrasonic"]]) if metres == 0]
        before = {i: at for i, at in self._zero_since.items() if at <= report.stamp}  # else the clock was set back
        self._zero_since = {i: before.get(i, report.stamp) for i in zeros}
        dead = [str(i) for i, at in self._zero_since.items() if report.stamp - at >= DEAD_AFTER]
        self.dead = f"ultrasonic {' and '.join(dead)} does not answer" if dead else ""
