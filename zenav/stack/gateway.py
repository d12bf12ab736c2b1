# SPDX-License-Identifier: Apache-2.0
"""The gateway of a stack that `zenav up --remote` starts: its address, and the check of its certificates before."""

from services.gateway.link_device import gateway_endpoint
from services.gateway.service import GatewayConfig
from shared.config import RobotFile
from shared.runners.transport import StackAddress
from shared.secure_folder import secure_folder

GATEWAY = "gateway"
BASE_PORT = 7448
"""plus the stack's number."""


def with_gateway(settings: list[str], where: StackAddress) -> list[str]:
    """The settings, with a device of the gateway before the user's own ones."""
    return [f"gateway.port.device=tls://0.0.0.0:{BASE_PORT + where.domain}", *settings]


def prepare_gateway(file: RobotFile) -> None:
    """Renews the robot's certificate where it ends soon. Raises UserError where there is none, or a wrong address."""
    from zenav.secure.members import renew_own

    config = file.section(GATEWAY, GatewayConfig)
    gateway_endpoint(config.port.device)
    renew_own(secure_folder(config.folder).require())


def gateway_address(file: RobotFile) -> str:
    """What members give as --stack, with the listening address in the place of the host."""
    return gateway_endpoint(file.section(GATEWAY, GatewayConfig).port.device)
