# SPDX-License-Identifier: Apache-2.0
"""Interface of the emulated motion boards, and the base of those whose counters rise when the robot drives forward."""

from math import pi
from typing import ClassVar, NamedTuple, Protocol

from shared.config import Drive, Robot
from shared.messages import BoardReport


class BodyTruth(NamedTuple):
    """What a board can measure beside its wheels. yaw_rate: rad/s by a gyro, None without one.

    bumpers, cliffs: names of the pressed bumpers, and of the cliff sensors without floor. A board ignores other names
    than its own.
    """

    yaw_rate: float | None = None
    bumpers: tuple[str, ...] = ()
    cliffs: tuple[str, ...] = ()
    estop: bool = False


class BoardElectronics(Protocol):
    """A board's end of its line, without faults. HAS_GYRO, HAS_CONTACTS: whether its bytes carry them."""

    HAS_GYRO: ClassVar[bool]
    HAS_CONTACTS: ClassVar[bool]

    def receive(self, data: bytes, now: int) -> bytes:
        """Handles the driver's bytes at `now` (ns). Returns what is answered at once."""

    def speeds(self, now: int) -> tuple[float, float, int | None]:
        """Counts/s of the left and right motor, with the signs of BoardReport, and the ns that they last; None: on."""

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        """What the board sends when it has measured `truth` and `body`."""


class WheelElectronics:
    """Holds the speeds of both wheels. LIFE_NS: ns after which a command ends; None: it stands until the next.

    WRAP: counts at which the counters return to 0.
    """

    HAS_GYRO: ClassVar[bool] = False
    HAS_CONTACTS: ClassVar[bool] = False
    LIFE_NS: int | None = None
    WRAP = 1 << 31

    def __init__(self, robot: Robot) -> None:
        self.drive: Drive = robot.drive
        self.life_ns = self.LIFE_NS
        self._zero: tuple[int, int] | None = (0, 0)  # counts at which the counters were 0; None: they are 0 now
        self.is_awake, self.last_counts = False, (0, 0)  # of a board that is asked; the counts of the last period
        self._left = self._right = 0.0  # counts/s, positive forward
        self._until: int | None = None

    def drive_wheels(self, left: float, right: float, now: int) -> None:
        """Takes a command: m/s of both rims, positive forward."""
        drive = self.drive
        per_m = drive.motor_direction * drive.counts_per_turn / (2 * pi)
        self.turn_wheels(left / drive.left_radius * per_m, right / drive.right_radius * per_m, now)

    def turn_wheels(self, left: float, right: float, now: int) -> None:
        """Takes a command: counts/s of both wheels, as the board counts."""
        self._left, self._right = left, right
        self._until = None if self.life_ns is None else now + self.life_ns

    def speeds(self, now: int) -> tuple[float, float, int | None]:
        if self._until is not None and now >= self._until:
            self._left, self._right, self._until = 0.0, 0.0, None
        return -self._left, self._right, None if self._until is None else self._until - now

    def counters(self, truth: BoardReport) -> tuple[int, int]:
        """The board's own counters of the left and the right wheel."""
        turned = -truth.left_counts, truth.right_counts
        self._zero = turned if self._zero is None else self._zero
        return (turned[0] - self._zero[0]) % self.WRAP, (turned[1] - self._zero[1]) % self.WRAP

    def read_counters(self, truth: BoardReport) -> None:
        """Keeps the counters for the requests until the next period; the first time the board wakes up."""
        self.is_awake, self.last_counts = True, self.counters(truth)

    def restart(self) -> None:
        """The board loses its power for a moment: the wheels stand, its counters begin at 0."""
        self._zero = None
        self._left = self._right = 0.0
        self._until, self.life_ns, self.is_awake = None, self.LIFE_NS, False
