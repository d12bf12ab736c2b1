# SPDX-License-Identifier: Apache-2.0
"""What a service process starts from: its command line, its section of the robot's file, and the robot."""

import argparse
from dataclasses import dataclass
from typing import NamedTuple

from shared.config import Robot, RobotFile, configured, robot_source
from shared.section import Section
from shared.service import Service

PRELOADED: dict[str, "ServiceStart"] = {}
"""By service: what the process that forked this one has read. Kernels of these services are loaded."""

LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")


@dataclass(frozen=True, slots=True)
class ServiceStart:
    """Inputs of one service process, read and checked.

    source: path and text of the robot's file on the disk.  robot_file: the same with what was overridden.
    """

    arguments: tuple[str, ...]
    options: argparse.Namespace
    file: RobotFile
    config: Section
    robot: Robot
    source: str
    robot_file: str

    def is_of(self, arguments: tuple[str, ...]) -> bool:
        """Whether reading them again for these arguments gives the same, and no warning."""
        if self.arguments != arguments or self.file.has_former_names:
            return False
        return self.source != "" and robot_source(self.options.robot) == self.source


def parser_of(name: str) -> argparse.ArgumentParser:
    """The options of every service's process."""
    parser = argparse.ArgumentParser(prog=f"zenav run {name}", description=f"Runs {name} alone, in the foreground.")
    parser.add_argument("--robot", default="x80sv", help="name of a robot, or a YAML file")
    parser.add_argument("--stack", default="0", help="number of the stack on this host, or a router: tcp/router:7447")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting")
    parser.add_argument("--clock", default="", metavar="EPOCH:SPEED", help="simulated time: ns, times as fast as real")
    parser.add_argument("--memory", default="", metavar="FOLDER", help="keep what a restart must not lose, as the map")
    parser.add_argument("--crashes", default="recordings", metavar="FOLDER", help="where crash-NAME-STAMP.mcap goes")
    parser.add_argument("--log", type=str.upper, default="INFO", choices=LEVELS, help="log level")
    return parser


class RobotSource(NamedTuple):
    """A robot's file as a service starts from it: see `ServiceStart`."""

    source: str
    file: RobotFile
    text: str


def read_robot(options: argparse.Namespace) -> RobotSource:
    """Reads the robot's file that a service's options name. Raises UserError."""
    source = robot_source(options.robot)  # first: where the file changes meanwhile, it is read again
    file = configured(options.robot, options.set)
    return RobotSource(source, file, file.text)


def service_start(
    name: str,
    service_class: type[Service],
    arguments: list[str],
    options: argparse.Namespace,
    robot: RobotSource | None = None,
) -> ServiceStart:
    """The inputs of a service. options: the arguments, parsed.  robot: as read for the same options before.

    Raises UserError.
    """
    source, file, text = robot or read_robot(options)
    return ServiceStart(
        arguments=tuple(arguments),
        options=options,
        file=file,
        config=file.section(name, service_class.config_type),
        robot=file.robot,
        source=source,
        robot_file=text,
    )
