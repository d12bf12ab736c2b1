# SPDX-License-Identifier: Apache-2.0
"""What stands behind a live service's port: a serial device (port.py), or a device that the service brings.

A service brings it where its process starts: `live.main(DashboardService, devices={"web": web_device})`. The kind is
the part before :// in the port's `device`.
"""

from argparse import Namespace
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from shared.config import Section
from shared.ports import PortConfig
from shared.runners.clock import StackClock
from shared.runners.port import Port
from shared.runners.transport import StackAddress
from shared.topics import Publication

Publish = Callable[[Publication], object]
"""Takes messages of topics.RX and topics.PORT, from any thread."""


class Device(Protocol):
    """The device of one port. `start` returns at once; nothing blocks the service."""

    def start(self) -> None: ...

    def write(self, data: bytes) -> None:
        """Takes data of topics.TX."""

    def plug(self, plugged: bool) -> None:
        """Removes or restores an emulated device."""

    def close(self) -> None:
        """Ends it within a second."""


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """What a device needs to know of its service.

    section: the service's whole configuration.  robot: first part of every key.  arguments: options of a command line
    that reach the same robot, stack and settings.
    """

    port: str
    config: PortConfig
    section: Section
    robot: str
    where: StackAddress
    arguments: tuple[str, ...]
    clock: StackClock
    publish: Publish


DeviceFactory = Callable[[DeviceContext], Device]
"""Makes a device, not yet open. Raises UserError where its configuration is wrong."""
Devices = Mapping[str, DeviceFactory]
"""What a service brings, by kind."""
NO_DEVICES: Devices = {}
DeviceOpener = Callable[[str, PortConfig, StackClock, Publish], Device]
"""Makes the device of a port by the port's name and configuration."""


def device_opener(
    devices: Devices, section: Section, robot: str, where: StackAddress, options: Namespace
) -> DeviceOpener:
    """The opener of a service that brings devices, by kind; of other kinds there are those of port.py.

    options: of the process (service_start.py).
    """
    settings = (argument for setting in options.set for argument in ("--set", setting))
    arguments = ("--robot", options.robot, "--stack", options.stack, *settings)

    def open_device(port: str, config: PortConfig, clock: StackClock, publish: Publish) -> Device:
        make = devices.get(config.kind)
        if make is None:
            return Port(port, config, clock, publish)
        return make(
            DeviceContext(
                port=port,
                config=config,
                section=section,
                robot=robot,
                where=where,
                arguments=arguments,
                clock=clock,
                publish=publish,
            )
        )

    return open_device
