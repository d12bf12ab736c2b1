# SPDX-License-Identifier: Apache-2.0
"""Interface of all inertial sensors: bytes to readings, in the sensor's own axes."""

from dataclasses import dataclass
from math import hypot
from typing import Protocol

GRAVITY = 9.80665  # m/s^2
MIN_FORCE, MAX_FORCE = 2.0, 60.0  # m/s^2; at rest it is gravity: outside, a reading is damaged


@dataclass(frozen=True, slots=True)
class Reading:
    """stamp: ns, of the measurement.  yaw_rate: rad/s about z.  x, y, z: m/s^2, specific force."""

    stamp: int
    yaw_rate: float
    x: float
    y: float
    z: float

    @property
    def is_plausible(self) -> bool:
        """Whether it can be measured on a robot: its force is about gravity."""
        return MIN_FORCE <= hypot(self.x, self.y, self.z) <= MAX_FORCE


@dataclass(slots=True)
class ReadingCounts:
    """Counters of a decoder since its construction."""

    n_good: int = 0
    n_bad: int = 0  # packets with a wrong checksum or length, refused commands, and readings that cannot be


class ImuDevice(Protocol):
    """A sensor's protocol as a state machine. fault: that the sensor reports, for people; empty without one."""

    counts: ReadingCounts
    fault: str

    def start(self, now: int) -> bytes:
        """Begins the start sequence again at `now` (ns). Returns the first bytes to send."""

    def receive(self, data: bytes, now: int) -> list[Reading]:
        """Decodes bytes that the port read at `now` (ns)."""

    def next_command(self, now: int) -> bytes:
        """The bytes to send at `now` (ns), or none; called after each reading and each tick."""
