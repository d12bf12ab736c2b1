# SPDX-License-Identifier: Apache-2.0
"""The installed service under a real systemd: it starts, comes back after a kill and a hang, stops, and is removed.

systemd is process 1 of namespaces of its own (man 7 namespaces), with this machine's files; it writes into memory.
It needs root.
"""

import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

SYSTEMD = Path("/usr/lib/systemd/systemd")
ZENAV = Path(sys.executable).parent / "zenav"
UNIT = "zenav-x80sv"
GROUPS = Path("/sys/fs/cgroup/systemd")
BOOT = """
set -e
mount --make-rprivate /
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
cd "$1/root"
mount -t proc proc proc; mount -t sysfs sysfs sys; mount --rbind /dev dev
mount -t tmpfs tmpfs run; mount -t tmpfs tmpfs tmp; mount -t tmpfs tmpfs sys/fs/cgroup
mkdir sys/fs/cgroup/systemd
mount -t cgroup -o none,name=systemd cgroup sys/fs/cgroup/systemd
ip link set lo up
rm -rf etc/fstab etc/systemd/system/*.wants
for unit in systemd-sysctl systemd-modules-load systemd-udevd systemd-udev-trigger; do
  ln -sf /dev/null "etc/systemd/system/$unit.service"
done
mkdir -p srv/robot
exec env -i container=other PATH=/usr/sbin:/usr/bin:/sbin:/bin chroot . {systemd} --system --unit=multi-user.target
"""

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or not SYSTEMD.exists() or shutil.which("nsenter") is None, reason="needs root and systemd"
)


class Machine:
    """A booted systemd. pid: of its process 1, as this machine numbers it."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        whole = ["nsenter", "-t", str(self.pid), "-a", "-r", "-w", *command]
        return subprocess.run(whole, capture_output=True, text=True, cwd="/")

    def property(self, name: str) -> str:
        return self.run("systemctl", "show", UNIT, "-p", name, "--value").stdout.strip()

    def until(self, *states: tuple[str, str], seconds: float = 600.0) -> None:
        """Waits until each property has its value."""
        limit = time.monotonic() + seconds
        while (now := [(name, self.property(name)) for name, _ in states]) != list(states):
            assert time.monotonic() < limit, f"{now}: {self.run('journalctl', '-u', UNIT, '-n', '30').stdout}"
            time.sleep(0.5)  # noqa: TID251  # systemd is not asked more often

    def services(self) -> list[str]:
        return self.run("pgrep", "-f", r"^services\.").stdout.split()


@pytest.fixture
def machine(tmp_path):
    namespaces = ["--pid", "--fork", "--kill-child", "--mount", "--uts", "--ipc", "--cgroup", "--net"]
    script = BOOT.format(systemd=SYSTEMD)
    group = GROUPS / f"zenav-test-{os.getpid()}"  # what is in the group of process 1 counts as its own
    if not GROUPS.is_dir():
        pytest.skip(f"needs root and systemd's control groups of version 1, in {GROUPS}")
    group.mkdir()
    own_group = ["bash", "-c", 'echo $$ > "$0/cgroup.procs" && exec "$@"', str(group)]
    command = [*own_group, "unshare", *namespaces, "bash", "-c", script, "boot", str(tmp_path)]
    with (tmp_path.parent / "console.log").open("w") as console:
        booted = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=console, stderr=console)
    try:
        limit = time.monotonic() + 60
        while not (first := Path(f"/proc/{booted.pid}/task/{booted.pid}/children").read_text().split()):
            time.sleep(0.1)  # noqa: TID251
        machine = Machine(int(first[0]))
        while machine.run("systemctl", "is-system-running").stdout.strip() not in ("running", "degraded"):
            if booted.poll() is not None or time.monotonic() > limit:
                pytest.skip(f"systemd does not boot here: {(tmp_path.parent / 'console.log').read_text()[-300:]}")
            time.sleep(0.2)  # noqa: TID251
        yield machine
    finally:
        booted.kill()  # its child, process 1 of the namespaces, dies with it, and all others with that one
        booted.wait()
        for folder in sorted(group.rglob("*/"), reverse=True):
            with suppress(OSError):
                folder.rmdir()
        with suppress(OSError):
            group.rmdir()


@pytest.mark.timeout(900)
def test_the_service_starts_comes_back_after_a_kill_and_a_hang_stops_and_is_removed(machine):
    installed = machine.run(
        *("env", "HOME=/root", str(ZENAV), "install-service", "--robot", "x80sv", "--world", "office", "--system"),
        *("--folder", "/srv/robot"),
    )
    assert installed.returncode == 0, installed.stderr
    machine.run("systemctl", "start", "--no-block", UNIT)
    machine.until(("ActiveState", "active"))  # only after the launcher said that every service runs
    assert "services run; logs in out/up-" in machine.property("StatusText")
    guard = machine.run("pgrep", "-f", r"^services\.guard").stdout.split()[0]
    assert "SCHED_RR" in machine.run("chrt", "-p", guard).stdout
    assert "every service runs" in machine.run("journalctl", "-t", UNIT, "--no-pager").stdout

    machine.run("kill", "-KILL", machine.property("MainPID"))
    machine.until(("NRestarts", "1"), ("ActiveState", "active"))
    machine.run("kill", "-STOP", machine.property("MainPID"))  # the watchdog notices
    machine.until(("NRestarts", "2"), ("ActiveState", "active"))

    machine.run("systemctl", "stop", UNIT)
    assert machine.property("Result") == "success"
    assert machine.services() == []
    removed = machine.run("env", "HOME=/root", str(ZENAV), "uninstall-service", "--robot", "x80sv", "--system")
    assert removed.returncode == 0, removed.stderr
    assert machine.property("LoadState") == "not-found"
