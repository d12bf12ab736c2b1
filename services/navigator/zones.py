# SPDX-License-Identifier: Apache-2.0
"""Which zones hold: those of the robot's configuration, and those that a person set."""

from itertools import islice

from shared.messages import MOST_ZONES, Zone, Zones
from shared.requests import SetZones
from shared.zones import NamedZoneConfig


class ActiveZones:
    """The zones by name. What is set takes the place of what was set before, never of the configuration's others."""

    def __init__(self, configured: tuple[NamedZoneConfig, ...]) -> None:
        self._configured = {zone.name: zone.zone(zone.name) for zone in configured}
        self._zones = self._configured
        self.is_published = not self._configured  # nobody need be told that there are none

    @property
    def zones(self) -> tuple[Zone, ...]:
        return tuple(self._zones.values())

    def set(self, request: SetZones) -> bool:
        """These, and the configuration's that have other names; False where those are more than can hold."""
        zones = self._configured | {zone.name: zone for zone in request.zones}
        if len(zones) > MOST_ZONES:
            return False
        self._zones = zones
        return True

    def remember(self, before: Zones) -> tuple[str, ...]:
        """What held before a restart goes on to hold, unless something was set already.

        The names of those for which there is no room any more: the configuration has more zones now, and they go first.
        """
        if self._zones is not self._configured:
            return ()
        zones = self._configured | {zone.name: zone for zone in before.zones}
        self._zones = dict(islice(zones.items(), MOST_ZONES))
        self.is_published = False
        return tuple(name for name in zones if name not in self._zones)
