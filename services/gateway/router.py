# SPDX-License-Identifier: Apache-2.0
"""The gateway's process: one Zenoh session that lets members in. `python -m services.gateway.router`, JSON on stdin.

With `local` in the place of `stack` it is the router of a site, for robots and people.

It writes Zenoh's log, a line once it listens, and one for each link over TLS that begins or ends (log_lines.py). The
order's `mark` begins its own lines. It ends with its stdin.
"""

import json
import os
import select
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import zenoh

from services.gateway.log_lines import LinkEvent
from shared.runners.transport import asks_for_realtime, gateway_configuration, site_configuration, stack_address
from shared.secure_folder import SecureFolder

LOOK_S = 1.0  # between two looks at the threads
LINK_PRIORITY = 1  # SCHED_RR; below the velocity path's, above all services without it
ACCEPTOR = "acc-"  # begins the names of Zenoh's threads that do handshakes


def main() -> None:
    """Routes until stdin ends."""
    order = json.loads(sys.stdin.readline())
    zenoh.init_log_from_env_or("error")
    folder = SecureFolder(Path(order["folder"]))
    is_realtime = asks_for_realtime(LINK_PRIORITY)  # Zenoh's first threads inherit it
    try:
        session = zenoh.open(_configuration(order, folder))
    except zenoh.ZError as error:
        sys.stderr.write(f"cannot listen on {order['listen']}: {error}\n")
        os._exit(2)
    _write(order["mark"], LinkEvent.LISTENING, "-", order["listen"])
    session.info.declare_link_events_listener(partial(_write_link, order["mark"]), history=True)
    while not select.select([sys.stdin], [], [], LOOK_S)[0]:
        if is_realtime:
            _schedule_threads()
    os._exit(0)  # Zenoh's threads are not daemons


def _configuration(order: dict[str, str], folder: SecureFolder) -> zenoh.Config:
    if "local" in order:
        return site_configuration(order["local"], order["listen"], folder)
    return gateway_configuration(stack_address(order["stack"]), order["listen"], folder, order["robot"])


def _schedule_threads() -> None:
    """Gives Zenoh's threads real-time scheduling, but not those of handshakes: a flood of strangers shares their time.

    Zenoh begins its threads when it first needs them, also from an acceptor's.
    """
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # it has ended
            thread, is_acceptor = int(task.name), (task / "comm").read_text().startswith(ACCEPTOR)
            if is_acceptor:
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
            else:
                os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(LINK_PRIORITY))


def _write_link(mark: str, event: zenoh.LinkEvent) -> None:
    link = event.link
    if not str(link.src).startswith("tls/"):
        return
    kind = LinkEvent.JOINED if event.kind == zenoh.SampleKind.PUT else LinkEvent.LEFT
    _write(mark, kind, link.auth_identifier or "-", link.dst)


def _write(mark: str, event: LinkEvent, name: str, address: str) -> None:
    sys.stdout.write(f"{mark} {event} {name} {address}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
