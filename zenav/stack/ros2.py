# SPDX-License-Identifier: Apache-2.0
"""The bridge to ROS 2 nodes: `zenav ros2` beside a running stack, and `zenav up --ros2`."""

from services.ros2.bridge_device import KIND, zenoh_endpoint
from services.ros2.config import Ros2Config
from services.ros2.router_tls import router_tls
from shared.config import RobotFile

ROS2 = "ros2"


def ros2_settings(router: str) -> list[str]:
    """The setting of a router, as tcp/HOST:7447 or tls/HOST:7447. Raises UserError where it is none."""
    device = f"{KIND}://{router}"
    zenoh_endpoint(device)
    return [f"ros2.port.device={device}"]


def check_router(file: RobotFile) -> None:
    """Raises UserError where the router's address, or a file for TLS to it, is wrong."""
    config = file.section(ROS2, Ros2Config)
    router_tls(zenoh_endpoint(config.port.device), config.tls)


def run_bridge(
    robot: str,
    stack: str,
    router: str,
    bridge: str,
    domain: int,
    distro: str,
    namespace: str,
    settings: list[str],
    log: str,
) -> None:
    """The bridge in this process, beside a running stack, until Ctrl-C. Does not return."""
    from zenav.stack.up import run_service

    own = [*ros2_settings(router), f"ros2.bridge={bridge}", f"ros2.domain={domain}", f"ros2.distro={distro}"]
    own.append(f"ros2.namespace={namespace!r}")
    run_service(ROS2, robot, stack, settings=[*own, *settings], clock="", memory="", log=log)
