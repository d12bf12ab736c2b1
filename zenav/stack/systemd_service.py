# SPDX-License-Identifier: Apache-2.0
"""`zenav install-service`: a systemd unit that keeps the stack running. `zenav uninstall-service` removes it."""

import getpass
import grp
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from shared.config import RobotFile, UserError, configured, nearest, robot_path
from shared.ports import PortConfig
from shared.robot_files import ROBOTS_DIR, own_name_and_kind
from shared.ros_map import replace_file
from shared.topics import SERVICES
from zenav.stack.config_report import read_sections
from zenav.stack.warm import warm_first

UNITS = {"user": Path(".config/systemd/user"), "system": Path("/etc/systemd/system")}
"""Folder of the units by scope; that of a user is below the home folder."""
RULES = Path("/etc/udev/rules.d")
RUNNING = Path("/run/systemd/system")  # there where systemd is process 1: sd_booted(3)
SERIAL_GROUP = "dialout"

UNIT = """\
[Unit]
Description=zenav drives {name}
After=network.target time-sync.target
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={command}
WorkingDirectory={folder}
Environment=PYTHONUNBUFFERED=1
Restart=always
RestartSec=2
# of the launcher, which restarts services itself: it gives a sign of life while it hears them
WatchdogSec=10
# a first start may compile kernels
TimeoutStartSec=900
TimeoutStopSec=10
KillMode=mixed
OOMPolicy=continue
StandardOutput=journal
StandardError=journal
SyslogIdentifier=zenav-{name}
{account}
[Install]
WantedBy={target}
"""

SYSTEM_ONLY = """\
User={user}
# the velocity path asks for SCHED_RR
LimitRTPRIO=10
"""

RULE = (
    'SUBSYSTEM=="tty", ATTRS{{serial}}=="{serial}", SYMLINK+="{link}", GROUP="dialout", MODE="0660", '
    'ENV{{ID_MM_DEVICE_IGNORE}}="1"\n'
)


@dataclass(frozen=True, slots=True)
class SystemdService:
    """What is installed. scope: `user` or `system`.  folder: where it runs, and leaves maps and recordings."""

    robot: str
    scope: str
    folder: Path
    world: str = ""
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        own, kind = own_name_and_kind(self.robot)
        return own or Path(kind).stem

    @property
    def unit(self) -> Path:
        return unit_folder(self.scope) / f"zenav-{self.name}.service"

    @property
    def overrides(self) -> list[str]:
        """Settings as SECTION.KEY=VALUE, the world's too."""
        return [*self.settings, *([f"sim.world={self.world}"] if self.world else [])]

    @property
    def file(self) -> RobotFile:
        """Raises UserError where the robot or a setting is wrong."""
        file = configured(self.robot, self.overrides)
        read_sections(file)
        return file


def unit_folder(scope: str) -> Path:
    """The folder of the units of a scope."""
    return Path.home() / UNITS[scope]


def unit_text(service: SystemdService) -> str:
    """The unit file. Raises UserError where the robot is wrong."""
    path = robot_path(service.robot).resolve()
    own, _ = own_name_and_kind(service.robot)
    robot = (f"{own}@" if own else "") + (path.stem if path.parent == ROBOTS_DIR else str(path))
    words = [sys.executable, "-P", "-m", "zenav", "up", "--robot", robot]
    words += ["--world", service.world] if service.world else []
    words += [word for setting in service.settings for word in ("--set", setting)]
    account = SYSTEM_ONLY.format(user=_account()) if service.scope == "system" else ""
    if service.scope == "system" and _has_group(SERIAL_GROUP):
        account += f"SupplementaryGroups={SERIAL_GROUP}\n"
    return UNIT.format(
        name=service.name,
        command=" ".join(map(_quoted, words)),
        folder=str(service.folder.resolve()).replace("%", "%%"),
        account=account,
        target="multi-user.target" if service.scope == "system" else "default.target",
    )


def udev_rules(file: RobotFile) -> str:
    """Rules that name the robot's adapters and let the group dialout open them; a comment where none is configured."""
    rules = ""
    lasers = file.tree.get("lidar_driver") or {}
    sections = (file.tree.get("base_driver"), lasers, lasers.get("laser_2"), file.tree.get("imu_driver"))
    for section, link in zip(sections, ("board", "laser", "laser_2", "imu"), strict=True):
        values = section or {}
        port = PortConfig.model_validate({k: v for k, v in (values.get("port") or {}).items() if k == "serial_number"})
        if port.serial_number:
            rules += RULE.format(serial=port.serial_number, link=link)
    return rules or "# no driver's port has a serial_number: docs/hardware.md\n"


def install(service: SystemdService, udev: bool) -> None:
    """Writes and enables the unit.

    Raises UserError where systemd or the service's folder is not there, or a file cannot be written.
    """
    file, text = service.file, unit_text(service)
    if udev and service.scope == "user":
        raise UserError("udev rules are for the whole machine", "add --system, with sudo; or see them: --udev --print")
    if not service.folder.is_dir():
        raise UserError(f"there is no folder {service.folder}", "make it, or name another one: --folder")
    _needs_systemd()
    if udev:
        _write(RULES / f"60-zenav-{service.name}.rules", udev_rules(file), "run it with sudo")
    if service.scope == "user":  # the kernels of another account are compiled by its first start
        warm_first(service.robot, service.overrides, SERVICES)
    _write(service.unit, text, "run it with sudo, or install it for this user: --user")
    _systemctl(service.scope, "daemon-reload")
    _systemctl(service.scope, "enable", service.unit.name)
    control, journal = _control(service.scope), "journalctl --user" if service.scope == "user" else "journalctl"
    _tell(f"{service.unit} starts with the machine", f"start it now:   {control} start {service.unit.stem}")
    _tell(f"its words:      {journal} -f -t zenav-{service.name}")
    if service.scope == "user":
        _tell(f"before a login: sudo loginctl enable-linger {getpass.getuser()}")
    if not udev:
        _tell(f"udev rules:     zenav install-service --robot {service.robot} --udev --print")


def uninstall(name: str, scope: str) -> None:
    """Stops, disables and removes a unit and its udev rules. Raises UserError where there is none."""
    unit = unit_folder(scope) / f"zenav-{name}.service"
    if not unit.is_file():
        known = tuple(path.stem.removeprefix("zenav-") for path in sorted(unit.parent.glob("zenav-*.service")))
        raise UserError(f"{name} is not installed as a {scope} service", nearest(name, known))
    _needs_systemd()
    _systemctl(scope, "disable", "--now", unit.name)
    for path in (unit, RULES / f"60-zenav-{name}.rules"):
        try:
            path.unlink(missing_ok=path != unit)
        except OSError as error:
            raise UserError(f"cannot remove {path}: {error.strerror}", "run it with sudo") from None
    _systemctl(scope, "daemon-reload")
    _tell(f"{unit} is removed")


def _needs_systemd() -> None:
    if not RUNNING.is_dir():
        raise UserError("systemd does not run here", "see the unit with --print, or use docker compose up --detach")


def _write(path: Path, text: str, hint: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode())
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}", hint) from None


def _systemctl(scope: str, *words: str) -> None:
    command = [*_control(scope).split(), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise UserError(f"cannot run systemctl: {error.strerror}", " ".join(command)) from None
    if done.returncode:
        raise UserError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}", "run it by hand")


def _control(scope: str) -> str:
    return "systemctl --user" if scope == "user" else "systemctl"


def _account() -> str:
    """The account that runs this command, also through sudo."""
    return os.environ.get("SUDO_USER") or getpass.getuser()  # noqa: TID251  # sudo's own variable


def _has_group(name: str) -> bool:
    try:
        return bool(grp.getgrnam(name))
    except KeyError:
        return False


def _quoted(word: str) -> str:
    """A word of ExecStart: systemd.service(5), "Command lines"."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if not escaped or set(escaped) & set(" \t'\";\\") else escaped


def _tell(*lines: str) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
