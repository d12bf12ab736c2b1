# SPDX-License-Identifier: Apache-2.0
"""A network of one's own to a namespace, whose delay and loss can be set. It needs root, `ip` and /dev/net/tun.

Kernels without sch_netem have this too: packets pass a process (lossy_relay.py) between two TUN devices.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from shared.config import UserError
from zenav.bench.member_namespace import run_ip

NETWORK = "198.19"  # RFC 2544: addresses of benchmarks
LOST = 1.0
"""loss of a link that is cut."""


@dataclass(frozen=True, slots=True)
class LossyLink:
    """site: address by which this computer reaches the namespace `name`.  interface, robot: its own end."""

    name: str
    interface: str
    relay: "subprocess.Popen[str]"
    robot: str
    site: str

    def set(self, delay: float, loss: float) -> None:
        """From now on packets take `delay` s each way, and a share `loss` of each way is dropped."""
        assert self.relay.stdin is not None
        self.relay.stdin.write(json.dumps({"delay": delay, "loss": loss}) + "\n")
        self.relay.stdin.flush()
        assert self.relay.stdout is not None
        self.relay.stdout.readline()

    def inside(self, *command: str) -> list[str]:
        """The command, run at the site."""
        return ["ip", "netns", "exec", self.name, *command]

    @property
    def n_bytes(self) -> tuple[int, int]:
        """Bytes of IP packets to the site and from it, so far: counters of the interface, as in /proc/net/dev."""
        folder = Path("/sys/class/net") / self.interface / "statistics"
        sent, received = (int((folder / name).read_text()) for name in ("tx_bytes", "rx_bytes"))
        return sent, received


@contextmanager
def lossy_link(seed: int = 0) -> Iterator[LossyLink]:
    """A clear link. Raises UserError where this user cannot make one."""
    number = os.getpid() % 10**6
    robot, site = (f"{NETWORK}.{number % 256}.{i}" for i in (1, 2))  # of this process alone
    name, outer, inner = f"zenav-site-{number}", f"zl{number}a", f"zl{number}b"
    command = [sys.executable, "-m", "zenav.bench.lossy_relay", outer, inner, str(seed)]
    try:
        if os.geteuid() or not run_ip("netns", "add", name):
            raise UserError("a network namespace needs root and `ip`", "run it as root")
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as relay:
            try:
                assert relay.stdout is not None
                is_ready = relay.stdout.readline() == "ready\n" and all(
                    run_ip(*words)
                    for words in (
                        ("addr", "add", f"{robot}/30", "dev", outer),
                        ("link", "set", outer, "up"),
                        ("link", "set", inner, "netns", name),
                        ("-n", name, "addr", "add", f"{site}/30", "dev", inner),
                        ("-n", name, "link", "set", inner, "up"),
                        ("-n", name, "link", "set", "lo", "up"),
                    )
                )
                if not is_ready:
                    raise UserError("no TUN device can be made", "is there /dev/net/tun, and may root use it?")
                yield LossyLink(name, outer, relay, robot, site)
            finally:
                relay.kill()
    finally:
        run_ip("netns", "del", name)
