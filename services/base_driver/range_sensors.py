# SPDX-License-Identifier: Apache-2.0
"""Do the ranges of a report fit `robot.ranges`, and does each sonar answer?"""

import numpy as np

from shared.config import Robot
from shared.messages import BoardReport, RangeReadings
from shared.types import Float32s

DEAD_SONAR_NS = 250_000_000
"""ns for which a broken sonar reads 0 m; a working one never does."""


class RangeSensorMonitor:
    """Checks reports of a board that sends messages. A kind of sensor without a row in robot.ranges is ignored."""

    def __init__(self, robot: Robot) -> None:
        self._sensors = robot.ranges
        self._columns = _sensor_columns(robot)
        kinds = [sensor.kind for sensor in robot.ranges]
        self._expected = {kind: kinds.count(kind) for kind in ("ultrasonic", "infrared")}
        self._zero_since: dict[int, int] = {}  # sonar -> ns, the first of its readings of 0
        self.mismatch = ""
        """Text of both numbers of ranges, in the report and in robot.ranges; empty if they are equal."""
        self.dead = ""
        """Text of the sonars that do not answer; empty if all do."""

    def update(self, report: BoardReport) -> None:
        """Checks a report."""
        sent = {"ultrasonic": len(report.ultrasonic), "infrared": len(report.infrared)}
        wrong = (kind for kind, n in self._expected.items() if n and n != sent[kind])
        self.mismatch = ", ".join(
            f"the board sends {sent[kind]} {kind} ranges, robot.ranges has {self._expected[kind]}" for kind in wrong
        )
        zeros = [i for i, metres in enumerate(report.ultrasonic[: self._expected["ultrasonic"]]) if metres == 0]
        before = {i: at for i, at in self._zero_since.items() if at <= report.stamp}  # else the clock was set back
        self._zero_since = {i: before.get(i, report.stamp) for i in zeros}
        dead = [str(i) for i, at in self._zero_since.items() if report.stamp - at >= DEAD_SONAR_NS]
        self.dead = f"ultrasonic {' and '.join(dead)} does not answer" if dead else ""

    def readings(self, report: BoardReport) -> RangeReadings:
        """The report's ranges in the order of `robot.ranges`: (n,) m, NaN outside the limits of a sensor."""
        unused = {"ultrasonic": list(report.ultrasonic), "infrared": list(report.infrared)}
        ranges = np.full(len(self._sensors), np.nan, np.float32)
        for i, sensor in enumerate(self._sensors):
            value = unused[sensor.kind].pop(0) if unused[sensor.kind] else np.nan
            if np.float32(sensor.range_min) <= value <= np.float32(sensor.range_max):
                ranges[i] = value
        x, y, yaw, field_of_view = self._columns
        return RangeReadings(stamp=report.stamp, x=x, y=y, yaw=yaw, field_of_view=field_of_view, ranges=ranges)


def _sensor_columns(robot: Robot) -> tuple[Float32s, Float32s, Float32s, Float32s]:
    """x, y (m), yaw and field of view (rad) of the range sensors in `base`: float32 arrays (n,)."""
    rows = [(s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view) for s in robot.ranges]
    x, y, yaw, field_of_view = np.array(rows, np.float32).reshape(-1, 4).T
    return x.copy(), y.copy(), yaw.copy(), field_of_view.copy()
