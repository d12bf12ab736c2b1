# SPDX-License-Identifier: Apache-2.0
"""The Zenoh router of a stack whose services are containers: `python -m zenav.stack.router tcp/127.0.0.1:7447`.

It lets everybody in that reaches its address. So another address than this computer's own needs `--trusted-network`, as
the containers' network is one. Other computers come in by the gateway (`zenav secure`).

It holds nothing: when it ends, all traffic stops and guard and base driver hold zero; services come back by themselves.
"""

import os
import signal
import sys
from ipaddress import ip_address

import zenoh

from shared.runners.transport import router_configuration

LISTEN = "tcp/127.0.0.1:7447"
TRUSTED = "--trusted-network"


def main() -> None:
    """Routes until SIGTERM or SIGINT."""
    ends = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # before Zenoh's threads start: they inherit it
    trusted = TRUSTED in sys.argv
    endpoint = next((argument for argument in sys.argv[1:] if argument != TRUSTED), LISTEN)
    if not trusted and not is_loopback(endpoint):
        sys.stderr.write(f"router: {endpoint} is open to the network, and to everybody on it\n")
        sys.stderr.write(f"hint: let members in by zenav up --remote; in a network of its own: {TRUSTED}\n")
        os._exit(2)
    zenoh.init_log_from_env_or("error")
    try:
        with zenoh.open(router_configuration(endpoint)):
            sys.stderr.write(f"router: listening on {endpoint}\n")
            signal.sigwait(ends)
    except zenoh.ZError as error:
        sys.stderr.write(f"router: cannot listen on {endpoint}: {error}\nhint: is the port taken? see: ss -tlnp\n")
        os._exit(2)
    os._exit(0)  # Zenoh's threads are not daemons


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint like tcp/127.0.0.1:7447 is this computer's own."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


if __name__ == "__main__":
    main()
