# SPDX-License-Identifier: Apache-2.0
"""`zenav fault`: something of the simulated hardware breaks, or is repaired."""

import sys

from services.sim.fault_requests import ALL_FAULTS
from shared import requests
from shared.config import UserError, load_robot, nearest
from shared.requests import Break
from shared.runners.transport import stack_address
from zenav.client import Client


def fault(robot: str, stack: str, name: str, seconds: float, repair: bool) -> int:
    """Injects or ends a fault; without either, lists the faults. Raises UserError where the simulator refuses."""
    if name and name not in tuple(ALL_FAULTS):
        raise UserError(f"no fault {name}", nearest(name, tuple(ALL_FAULTS)))
    if not name and not repair:
        sys.stdout.write("".join(f"{key:<16} {description}\n" for key, description in ALL_FAULTS.items()))
        return 0
    with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        reply = client.ask(requests.FAULT, Break(client.now(), name, seconds, repair))
    if not reply.accepted:
        raise UserError(f"the simulator breaks nothing: {reply.detail}", "zenav fault lists what can break")
    sys.stdout.write(f"{reply.detail}\n")
    return 0
