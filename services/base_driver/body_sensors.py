# SPDX-License-Identifier: Apache-2.0
"""Gyro, bumpers, cliff sensors and e-stop input of a board on a port, as messages."""

from math import nan

from services.base_driver.boards.device import BoardContacts, BoardInput
from shared import topics
from shared.config import Robot
from shared.messages import Contacts, Imu
from shared.service import Out

CONTACTS_PERIOD_NS = 40_000_000  # ns between two messages of the same contacts: 20 a second at least


class BodySensors:
    """Publishes a turn rate with each report, contacts when they change and at their period.

    has_gyro: whether the board's turn rate is published; not beside another inertial sensor.
    latency: s from the measurement of a turn rate to its arrival, as of the wheels in the same report.
    """

    def __init__(self, robot: Robot, has_gyro: bool = True, latency: float = 0.0) -> None:
        self._has_gyro, self._latency_ns = has_gyro, round(latency * 1e9)
        self._sign = -1.0 if robot.imu is not None and robot.imu.upside_down else 1.0
        self._contacts: BoardContacts | None = None
        self._sent_at = 0  # ns

    def publications(self, received: BoardInput, stamp: int) -> Out:
        """The messages of what a board sent; stamp: ns, of its arrival."""
        if received.yaw_rate is not None and self._has_gyro:
            yield topics.IMU(Imu(max(stamp - self._latency_ns, 0), self._sign * received.yaw_rate, nan, nan, nan))
        contacts = received.contacts
        is_due = not 0 <= stamp - self._sent_at < CONTACTS_PERIOD_NS
        if contacts is not None and (is_due or contacts != self._contacts):
            self._contacts, self._sent_at = contacts, stamp
            yield topics.CONTACTS(Contacts(stamp, contacts.bumpers, contacts.cliffs, contacts.estop))
