# SPDX-License-Identifier: Apache-2.0
"""A network namespace as another computer, behind a pair of virtual devices. It needs root and `ip`."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

NETWORK = "198.18.77"  # RFC 2544: addresses of benchmarks
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class MemberNamespace:
    """Where members are. robot: the address by which they reach this computer.  name: empty without a namespace."""

    robot: str
    name: str = ""

    def inside(self, *command: str) -> list[str]:
        """The command, run where members are."""
        return ["ip", "netns", "exec", self.name, *command] if self.name else list(command)


@contextmanager
def member_namespace() -> Iterator[MemberNamespace]:
    """A network namespace; loopback where this user cannot make one."""
    name = f"zenav-{os.getpid()}"
    outer, inner = f"zb{os.getpid() % 10**6}a", f"zb{os.getpid() % 10**6}b"
    try:
        if os.geteuid() or shutil.which("ip") is None or not run_ip("netns", "add", name):
            yield MemberNamespace(LOOPBACK)
            return
        made = all(
            run_ip(*words)
            for words in (
                ("link", "add", outer, "type", "veth", "peer", "name", inner, "netns", name),
                ("addr", "add", f"{NETWORK}.1/30", "dev", outer),
                ("link", "set", outer, "up"),
                ("-n", name, "addr", "add", f"{NETWORK}.2/30", "dev", inner),
                ("-n", name, "link", "set", inner, "up"),
            )
        )
        yield MemberNamespace(f"{NETWORK}.1", name) if made else MemberNamespace(LOOPBACK)
    finally:
        run_ip("link", "del", outer)
        run_ip("netns", "del", name)


def run_ip(*words: str) -> bool:
    """Runs `ip` with these words. Returns whether it could."""
    with suppress(OSError):
        return subprocess.run(("ip", *words), capture_output=True).returncode == 0
    return False
