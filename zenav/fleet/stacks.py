# SPDX-License-Identifier: Apache-2.0
"""The stacks that a command looks at: those that its user named, or those that run here."""

import socket

from shared.config import UserError
from shared.runners.transport import MAX_DOMAIN, StackAddress, stack_address


def running_stacks() -> list[str]:
    """The numbers of this computer's stacks in which a guard or a navigator listens."""
    return [str(domain) for domain in range(MAX_DOMAIN + 1) if _listens(StackAddress(domain))]


def chosen_stacks(given: list[str]) -> list[str]:
    """The stacks that a user named, else those that run here. Raises UserError where there is none, or one is wrong."""
    stacks = list(dict.fromkeys(given)) or running_stacks()
    if not stacks:
        raise UserError("no stack runs on this computer", "name the robots' router: --stack tcp/HOST:7447")
    for stack in stacks:
        stack_address(stack)
    return stacks


def _listens(where: StackAddress) -> bool:
    for service in ("guard", "navigator"):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", where.port(service))) == 0:
                return True
    return False
