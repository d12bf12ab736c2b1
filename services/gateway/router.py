# SPDX-License-Identifier: Apache-2.0
"""The gateway's process: one Zenoh session that lets members in. `python -m services.gateway.router`, JSON on stdin.

It writes Zenoh's log, and a line for each link over TLS that begins or ends (log_lines.py). It ends with its stdin.
"""

import json
import os
import sys
from pathlib import Path

import zenoh

from services.gateway.log_lines import LINK_MARK, LinkEvent
from shared.runners.transport import gateway_configuration, stack_address
from shared.secure_folder import SecureFolder


def main() -> None:
    """Routes until stdin ends."""
    order = json.loads(sys.stdin.readline())
    zenoh.init_log_from_env_or("error")
    folder = SecureFolder(Path(order["folder"]))
    try:
        session = zenoh.open(
            gateway_configuration(stack_address(order["stack"]), order["listen"], folder, order["robot"])
        )
    except zenoh.ZError as error:
        sys.stderr.write(f"cannot listen on {order['listen']}: {error}\n")
        os._exit(2)
    session.info.declare_link_events_listener(_write_link, history=True)
    sys.stdin.read()
    os._exit(0)  # Zenoh's threads are not daemons


def _write_link(event: zenoh.LinkEvent) -> None:
    link = event.link
    if not str(link.src).startswith("tls/"):
        return
    kind = LinkEvent.JOINED if event.kind == zenoh.SampleKind.PUT else LinkEvent.LEFT
    sys.stdout.write(f"{LINK_MARK} {kind} {link.auth_identifier or '-'} {link.dst}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
