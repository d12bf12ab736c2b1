# SPDX-License-Identifier: Apache-2.0
"""The Zenoh router of a stack whose services are containers: `python -m zenav.stack.router tcp/0.0.0.0:7447`.

It holds nothing: when it ends, all traffic stops and guard and base driver hold zero; services come back by themselves.
"""

import os
import signal
import sys

import zenoh

from shared.runners.transport import router_configuration

LISTEN = "tcp/127.0.0.1:7447"


def main() -> None:
    """Routes until SIGTERM or SIGINT."""
    ends = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # before Zenoh's threads start: they inherit it
    endpoint = sys.argv[1] if len(sys.argv) > 1 else LISTEN
    zenoh.init_log_from_env_or("error")
    try:
        with zenoh.open(router_configuration(endpoint)):
            sys.stderr.write(f"router: listening on {endpoint}\n")
            signal.sigwait(ends)
    except zenoh.ZError as error:
        sys.stderr.write(f"router: cannot listen on {endpoint}: {error}\nhint: is the port taken? see: ss -tlnp\n")
        os._exit(2)
    os._exit(0)  # Zenoh's threads are not daemons


if __name__ == "__main__":
    main()
