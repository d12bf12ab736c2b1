# SPDX-License-Identifier: Apache-2.0
"""What stands behind the drivers: the real devices, the simulator's messages, or its emulated ports."""

import json
from enum import StrEnum
from pathlib import Path

from services.base_driver.config import BaseDriverConfig
from services.imu_driver.service import ImuDriverConfig
from services.lidar_driver.service import LidarDriverConfig
from services.sim.config import SimConfig
from services.sim.world import World
from services.sim.world_loader import GENERATED, WAREHOUSE, load_world, world_path
from shared.config import RobotFile
from shared.geometry import Pose2
from shared.runners.lockstep import Port
from shared.topics import SERVICES
from zenav.stack.service_loader import existing_services

DRIVERS = {"board": "base_driver", "laser": "lidar_driver", "laser_2": "lidar_driver", "imu": "imu_driver"}
"""By port: the driver that opens it."""
PORT_SETTINGS = {port: f"{driver}.port" for port, driver in DRIVERS.items()} | {"laser_2": "lidar_driver.laser_2.port"}
"""By port: its section in a robot's file."""
CHOSEN = frozenset(
    {"sim", "lidar_driver", "imu_driver", "dashboard", "gateway", "ros2", "traffic", "uplink"}
)  # services that not every stack has
WIRED = "wired"
"""The device of a port whose other end is in the same process."""


class Hardware(StrEnum):
    """What a stack runs on."""

    REAL = "real"  # the robot's devices
    MESSAGES = "messages"  # a simulator that takes and gives messages
    EMULATED = "emulated"  # a simulator behind ports that speak the devices' bytes


def emulated_ports(file: RobotFile) -> tuple[str, ...]:
    """The ports of the robot's emulated hardware. What is not emulated comes as messages.

    So does a base that controls its own speed, unless its board is one that sends poses.
    """
    emulation = file.section("sim", SimConfig).emulation
    has_imu = bool(emulation.imu_model) and file.robot.imu is not None
    has_board = file.robot.drive.kind == "differential" or _board_model(file) == "velocity"
    has_laser_2 = bool(emulation.laser_2_model) and len(file.robot.all_lasers) > 1
    has = {"board": has_board, "laser": bool(emulation.laser_model), "laser_2": has_laser_2, "imu": has_imu}
    return tuple(port for port in DRIVERS if has[port])


def _board_model(file: RobotFile) -> str:
    return file.section("base_driver", BaseDriverConfig).board.model


def services_for(hardware: Hardware, file: RobotFile, meets_robots: bool = False) -> list[str]:
    """The services of a whole stack, in the registry's order; `up` adds those of its user's choice, as the page.

    meets_robots: whether the stack can hear other robots, so that it needs `traffic`.
    """
    wanted = set(existing_services()) - CHOSEN
    if meets_robots:
        wanted.add("traffic")
    if hardware is not Hardware.REAL:
        wanted.add("sim")
    if hardware is Hardware.EMULATED:
        wanted |= {DRIVERS[port] for port in emulated_ports(file)}
    elif hardware is Hardware.REAL:
        lasers = file.section("lidar_driver", LidarDriverConfig)
        if lasers.port.given or (lasers.laser_2 is not None and lasers.laser_2.port.given):
            wanted.add("lidar_driver")
        if file.section("imu_driver", ImuDriverConfig).port.given:
            wanted.add("imu_driver")
    return [name for name in SERVICES if name in wanted]


def settings_for(hardware: Hardware, file: RobotFile, links: Path | None) -> list[str]:
    """What `--set` makes of the robot's file. links: the folder of the pseudo-terminals; None: all in one process."""
    if hardware is Hardware.REAL:
        return []
    if hardware is Hardware.MESSAGES:
        settings = ["sim.hardware=messages"]
        for port, section in PORT_SETTINGS.items():
            if port != "laser_2" or len(file.robot.all_lasers) > 1:
                settings += [f"{section}.device=''", f"{section}.serial_number=''"]
        return settings
    ports = emulated_ports(file)
    settings = [
        "sim.hardware=emulated",
        f"sim.emulation.board_model={_board_model(file) if 'board' in ports else repr('')}",
    ]
    if "board" not in ports:
        settings += ["base_driver.port.device=''", "base_driver.port.serial_number=''"]
    for port in ports:
        far, near = (f"pty:{links.resolve()}/{port}", f"{links.resolve()}/{port}") if links else (WIRED, WIRED)
        settings.append(f"sim.emulation.{port}.device={json.dumps(far)}")
        settings.append(f"{PORT_SETTINGS[port]}.device={json.dumps(near)}")
        settings.append(f"{PORT_SETTINGS[port]}.serial_number=''")
    return settings


def wires(hardware: Hardware, file: RobotFile) -> tuple[tuple[Port, Port], ...]:
    """Which ports are joined when all runs in one process."""
    if hardware is not Hardware.EMULATED:
        return ()
    return tuple(((DRIVERS[port], port), ("sim", port)) for port in emulated_ports(file))


def require_world(file: RobotFile) -> None:
    """Raises UserError where there is no file of the world that a robot's file names. The file is not read."""
    world = file.section("sim", SimConfig).world
    if world != WAREHOUSE and not world.startswith(GENERATED):
        world_path(world)


def simulated_world(file: RobotFile) -> World:
    """The world that a robot's file names. Raises UserError where there is none, or it is wrong."""
    config = file.section("sim", SimConfig)
    start = Pose2(config.start.x, config.start.y, config.start.yaw) if config.start else None
    return load_world(config.world, config.seed, config.clutter_jitter, config.barn_file, start)
