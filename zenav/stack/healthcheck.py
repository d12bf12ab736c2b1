# SPDX-License-Identifier: Apache-2.0
"""Whether a container's service works: `python -m zenav.stack.healthcheck mapper` exits with 0 or 1 and says why.

A service sends its health from its work loop: one that hangs falls silent, though its process and its sockets live.
"""

import os
import sys
import threading
import time

import zenoh

from shared.codec import CodecError, decode
from shared.config import UserError
from shared.messages import Health
from shared.runners.transport import opened, stack_address

PATIENCE = 3.0  # s, three of a service's health messages
OLDEST = 3_000_000_000  # ns


def health_problem(name: str, stack: str) -> str:
    """Why `name` is not healthy; empty where it is. The name `router` asks for no more than that one answers."""
    heard = threading.Event()
    problem = [f"no health message of {name} within {PATIENCE:g} s"]

    def hear(sample: zenoh.Sample) -> None:
        try:
            health, envelope = decode(Health, sample.payload.to_bytes())
        except CodecError as error:
            problem[0] = f"health/{name}: {error}"
            return
        if envelope.publisher != name:
            problem[0] = f"health/{name} comes from {envelope.publisher}"
        elif abs(time.time_ns() - health.stamp) < OLDEST:
            problem[0] = ""
            heard.set()
        else:
            problem[0] = f"the last health message of {name} is old"

    with opened(stack_address(stack)) as session:
        if name == "router":
            return ""
        session.declare_subscriber(f"*/health/{name}", hear)
        heard.wait(PATIENCE)
    return problem[0]


def main() -> None:
    """The stack comes from the environment (ZENAV_STACK), the service is the argument."""
    if len(sys.argv) != 2:
        sys.stderr.write("usage: python -m zenav.stack.healthcheck SERVICE\n")
        sys.exit(2)
    try:
        problem = health_problem(sys.argv[1], os.environ.get("ZENAV_STACK", "0"))  # noqa: TID251 (a container's one setting)
    except UserError as error:
        problem = error.what
    sys.stdout.write(f"{problem or 'healthy'}\n")
    sys.stdout.flush()
    os._exit(1 if problem else 0)  # Zenoh's threads are not daemons


if __name__ == "__main__":
    main()
