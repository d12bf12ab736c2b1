# SPDX-License-Identifier: Apache-2.0
"""The robot's certificate before a start that shows it, and the gateway that `zenav up --remote` starts."""

from services.gateway.link_device import gateway_endpoint
from services.gateway.service import GatewayConfig
from shared.config import RobotFile
from shared.runners.transport import StackAddress
from shared.secure_folder import SecureFolder, secure_folder

GATEWAY = "gateway"
BASE_PORT = 7448
"""plus the stack's number."""


def with_gateway(settings: list[str], where: StackAddress) -> list[str]:
    """The settings, with a device of the gateway before the user's own ones."""
    return [f"gateway.port.device=tls://0.0.0.0:{BASE_PORT + where.domain}", *settings]


def prepare_gateway(file: RobotFile) -> None:
    """Renews the robot's certificate where it ends soon. Raises UserError where there is none, or a wrong address."""
    config = file.section(GATEWAY, GatewayConfig)
    gateway_endpoint(config.port.device)
    _renew(secure_folder(config.folder).require())


def prepare_page(url: str) -> None:
    """Renews the robot's certificate where it ends soon, and the page shows it."""
    folder = secure_folder()
    if url.startswith("https://") and folder.exists:
        _renew(folder)


def _renew(folder: SecureFolder) -> None:
    from zenav.secure.members import renew_own  # it loads a library that no other start needs

    renew_own(folder)


def gateway_address(file: RobotFile) -> str:
    """What members give as --stack, with the listening address in the place of the host."""
    return gateway_endpoint(file.section(GATEWAY, GatewayConfig).port.device)
