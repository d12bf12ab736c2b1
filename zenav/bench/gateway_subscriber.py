# SPDX-License-Identifier: Apache-2.0
"""A subscriber of benchmarks, a process: `python -m zenav.bench.gateway_subscriber STACK AS KEY [realtime]`.

AS: the name of a service; with a router as STACK, the file of a member's credentials. It writes `ready`. For each line
on stdin it writes a report of the time since the last one. The report has times (ms), when it took each `cmd/vel` (ns),
and its CPU (s). It ends with its stdin.
"""

import json
import os
import struct
import sys
import threading
import time
from pathlib import Path

import zenoh

from shared.codec import envelope_of
from shared.config import UserError
from shared.credentials import parsed_credentials
from shared.runners import transport
from shared.runners.transport import StackAddress

STAMP = struct.Struct("<8sQ")  # MARK, and ns of CLOCK_MONOTONIC at which the message was sent
MARK = b"bench-ns"
OPEN_LIMIT_S = 20.0
REALTIME = "realtime"


def main(stack: str, as_: str, key: str, scheduling: str = "") -> None:
    """Measures until stdin ends. scheduling: "realtime" for SCHED_RR, as services have it."""
    times: list[float] = []
    commands: list[tuple[str, int, int]] = []  # session, sequence, ns of the clock of the day

    def take(sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        now = time.monotonic_ns()
        if payload.startswith(MARK):
            times.append((now - STAMP.unpack_from(payload)[1]) / 1e6)
        elif str(sample.key_expr).endswith("/cmd/vel"):
            envelope = envelope_of(payload)
            commands.append((envelope.session, envelope.sequence, time.time_ns()))

    if scheduling == REALTIME:
        transport.asks_for_realtime()
    session = _opened(stack, as_)
    subscriber = session.declare_subscriber(key, take)
    used = time.process_time()
    _say("ready")
    for _ in sys.stdin:
        before, used = used, time.process_time()
        n, n_commands = len(times), len(commands)
        _say(json.dumps({"times": times[:n], "commands": commands[:n_commands], "cpu_s": used - before}))
        del times[:n], commands[:n_commands]
    subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own
    os._exit(0)  # Zenoh's threads are not daemons


def _opened(stack: str, as_: str) -> zenoh.Session:
    if stack.isdigit():
        return transport.opened(StackAddress(int(stack)), as_)
    credentials = parsed_credentials(Path(as_).read_text(), as_)
    limit = time.monotonic() + OPEN_LIMIT_S
    while True:
        try:
            return transport.opened(StackAddress(router=stack, credentials=credentials))
        except UserError:
            if time.monotonic() > limit:
                raise
            threading.Event().wait(0.2)  # the gateway is starting


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
