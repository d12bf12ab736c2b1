# SPDX-License-Identifier: Apache-2.0
"""The robot's link to a site, which `zenav up --site` starts."""

from services.uplink.config import UplinkConfig
from services.uplink.site_device import robot_credentials, site_endpoint
from shared.config import RobotFile

UPLINK = "uplink"


def uplink_settings(site: str) -> list[str]:
    """The setting of a site's router, as tls/HOST:PORT. Raises UserError where it is none."""
    kind, _, address = site.partition("/")
    device = f"{kind}://{address}"
    site_endpoint(device)
    return [f"uplink.port.device={device}"]


def check_uplink(file: RobotFile) -> None:
    """Raises UserError where the address or the credentials for it are wrong."""
    config = file.section(UPLINK, UplinkConfig)
    robot_credentials(site_endpoint(config.port.device), config.credentials, file.robot.name)
