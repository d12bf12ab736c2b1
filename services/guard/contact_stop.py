# SPDX-License-Identifier: Apache-2.0
"""Bumpers, cliff sensors and the hardware e-stop: is the input recent, and does a command lead away from a contact?

The robot stands while a bumper is pressed. It backs off only by a command that leads away from every contact, at creep
speed. That is our own rule; ISO 13482 leaves it to the robot.
"""

from pydantic import Field

from shared.config import Section
from shared.contacts import leads_away
from shared.messages import Contacts, Velocity
from shared.robot import Robot
from shared.stamps import fresh


class ContactStopConfig(Section):
    """Bumpers, cliff sensors and the hardware e-stop."""

    age: float = Field(0.25, gt=0, le=2, description="s after its stamp at which a message of contacts is too old")


class ContactStop:
    """The newest message of `hardware/contacts`. Times are ns."""

    def __init__(self, config: ContactStopConfig, robot: Robot) -> None:
        self.config, self.robot = config, robot
        self.newest: Contacts | None = None
        self._valid_from = 0  # ns: its stamp, or its arrival where the stamp is ahead

    def set(self, contacts: Contacts, now: int) -> None:
        """Takes a message."""
        self.newest, self._valid_from = contacts, min(contacts.stamp, now)

    @property
    def stamp(self) -> int | None:
        """ns, of the newest message; None without one."""
        return self.newest.stamp if self.newest is not None else None

    def is_old(self, now: int) -> bool:
        """Whether contacts are expected, by the configuration or a former message, but missing or too old."""
        if self.newest is None:
            return self.robot.has_contacts
        return not fresh(self._valid_from, now, self.config.age)

    @property
    def is_estop_pressed(self) -> bool:
        """Whether the hardware e-stop was pressed in the newest message; a silent input does not release it."""
        return self.newest is not None and self.newest.estop

    @property
    def touches(self) -> bool:
        """Whether a bumper is pressed, or a cliff sensor sees no floor."""
        return self.newest is not None and bool(self.newest.bumpers or self.newest.cliffs)

    def holds(self, command: Velocity | None, cliffs: bool) -> bool:
        """Whether contacts hold the robot: a bumper, or a cliff sensor, unless the command leads away from all."""
        contacts = self.newest
        if contacts is None or not (contacts.cliffs if cliffs else contacts.bumpers):
            return False
        return command is None or not leads_away(self.robot, contacts, command.v, command.w)

    def detail(self) -> str:
        """The names of what is touched."""
        contacts = self.newest
        return ", ".join((*contacts.bumpers, *contacts.cliffs)) if contacts is not None else ""
