# SPDX-License-Identifier: Apache-2.0
"""The table of hardware faults, and the active ones."""

from enum import StrEnum


class Fault(StrEnum):
    """What breaks. Those of a line take effect on its bytes, the others on what board and laser measure or do."""

    GARBAGE = "garbage"  # the board's bytes arrive as noise, as at a wrong baud rate
    HALF_PACKETS = "half_packets"  # the second half of every packet of the board is lost
    BAD_CRC = "bad_crc"  # a bit flips in every packet of the board
    STALLED = "stalled"  # the board's line carries nothing, either way
    UNPLUGGED = "unplugged"  # the board's adapter is pulled out
    STUCK_ENCODER = "stuck_encoder"  # the left encoder's counter stands
    DEAD_SONAR = "dead_sonar"  # ultrasonic 1, the one ahead, reads 0
    SWAPPED_MOTOR = "swapped_motor"  # the left motor turns the other way
    LOW_BATTERY = "low_battery"  # the battery collapses
    LASER_STOPPED = "laser_stopped"  # the laser stops turning
    LASER_GARBAGE = "laser_garbage"  # the laser's bytes arrive as noise
    LASER_STALLED = "laser_stalled"  # the laser's line carries nothing, either way
    LASER_UNPLUGGED = "laser_unplugged"  # the laser's adapter is pulled out
    LASER_2_STOPPED = "laser_2_stopped"  # the second laser stops turning
    LASER_2_GARBAGE = "laser_2_garbage"  # the second laser's bytes arrive as noise
    LASER_2_STALLED = "laser_2_stalled"  # the second laser's line carries nothing, either way
    LASER_2_UNPLUGGED = "laser_2_unplugged"  # the second laser's adapter is pulled out
    IMU_GARBAGE = "imu_garbage"  # the inertial sensor's bytes arrive as noise
    IMU_STALLED = "imu_stalled"  # the inertial sensor's line carries nothing, either way
    IMU_UNPLUGGED = "imu_unplugged"  # the inertial sensor's adapter is pulled out


FAULT_DESCRIPTIONS: dict[Fault, str] = {
    Fault.GARBAGE: "the board's bytes arrive as noise",
    Fault.HALF_PACKETS: "half of every packet of the board is lost",
    Fault.BAD_CRC: "every packet of the board has a flipped bit",
    Fault.STALLED: "the board's line carries nothing",
    Fault.UNPLUGGED: "the board's adapter is pulled out",
    Fault.STUCK_ENCODER: "the left encoder's counter stands still",
    Fault.DEAD_SONAR: "the sonar that looks ahead reads nothing",
    Fault.SWAPPED_MOTOR: "the left motor turns the other way",
    Fault.LOW_BATTERY: "the battery's voltage collapses",
    Fault.LASER_STOPPED: "the laser stops turning",
    Fault.LASER_GARBAGE: "the laser's bytes arrive as noise",
    Fault.LASER_STALLED: "the laser's line carries nothing",
    Fault.LASER_UNPLUGGED: "the laser's adapter is pulled out",
    Fault.LASER_2_STOPPED: "the second laser stops turning",
    Fault.LASER_2_GARBAGE: "the second laser's bytes arrive as noise",
    Fault.LASER_2_STALLED: "the second laser's line carries nothing",
    Fault.LASER_2_UNPLUGGED: "the second laser's adapter is pulled out",
    Fault.IMU_GARBAGE: "the inertial sensor's bytes arrive as noise",
    Fault.IMU_STALLED: "the inertial sensor's line carries nothing",
    Fault.IMU_UNPLUGGED: "the inertial sensor's adapter is pulled out",
}
"""Fault -> description."""

UNPLUGGED_PORTS = {
    Fault.UNPLUGGED: "board",
    Fault.LASER_UNPLUGGED: "laser",
    Fault.LASER_2_UNPLUGGED: "laser_2",
    Fault.IMU_UNPLUGGED: "imu",
}
"""The port that a fault takes away."""


class ActiveFaults:
    """The active faults, each until its time is over or it is cleared."""

    def __init__(self) -> None:
        self._until: dict[StrEnum, int | None] = {}

    def begin(self, fault: StrEnum, until: int | None) -> None:
        """It holds until this time, ns; None: until cleared. A second one of its kind replaces the first."""
        self._until[fault] = until

    def clear(self, fault: StrEnum | None) -> None:
        """Ends it, or all."""
        for ended in [fault] if fault is not None else list(self._until):
            self._until.pop(ended, None)

    def expire(self, now: int) -> None:
        """Ends the faults that are over at `now` (ns)."""
        self._until = {fault: until for fault, until in self._until.items() if until is None or now < until}

    def __contains__(self, fault: str) -> bool:
        return fault in self._until

    def __bool__(self) -> bool:
        return bool(self._until)

    def __str__(self) -> str:
        return ", ".join(self._until)
