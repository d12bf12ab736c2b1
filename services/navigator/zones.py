# SPDX-License-Identifier: Apache-2.0
"""The active zones: those of the robot's configuration, and those that clients set."""

from itertools import islice

from shared.messages import MAX_ZONES, Zone, Zones
from shared.requests import SetZones
from shared.zones import NamedZoneConfig


class ActiveZones:
    """The zones by name. A new set replaces the last set, and of the configuration only zones with the same name."""

    def __init__(self, configured: tuple[NamedZoneConfig, ...]) -> None:
        self._configured = {zone.name: zone.zone(zone.name) for zone in configured}
        self._zones = self._configured
        self.is_published = not self._configured  # without zones nothing needs to be published

    @property
    def zones(self) -> tuple[Zone, ...]:
        return tuple(self._zones.values())

    def set(self, request: SetZones) -> bool:
        """Sets these zones with the configuration's of other names. Returns False where there are too many."""
        zones = self._configured | {zone.name: zone for zone in request.zones}
        if len(zones) > MAX_ZONES:
            return False
        self._zones = zones
        return True

    def remember(self, before: Zones) -> tuple[str, ...]:
        """Restores the zones from before a restart, unless a client has set some already.

        Returns the names without room: the configuration's zones, which may be more now, come first.
        """
        if self._zones is not self._configured:
            return ()
        zones = self._configured | {zone.name: zone for zone in before.zones}
        self._zones = dict(islice(zones.items(), MAX_ZONES))
        self.is_published = False
        return tuple(name for name in zones if name not in self._zones)
