# SPDX-License-Identifier: Apache-2.0
"""systemd takes the unit, which names what it runs by whole paths; nothing is written where it cannot work."""

import getpass
import os
import shutil
import subprocess
import sys

import pytest

from shared.config import UserError
from zenav.__main__ import _status
from zenav.stack import systemd_service as module
from zenav.stack.new_robot import new_robot
from zenav.stack.systemd_service import SystemdService, install, udev_rules, uninstall, unit_text
from zenav.stack.up import MAX_SILENCE_S

ANALYZE = shutil.which("systemd-analyze")


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with systemd: its folders below tmp_path, and the commands that it was given."""
    commands = []
    monkeypatch.setattr(module, "UNITS", {scope: tmp_path / scope for scope in ("user", "system")})
    monkeypatch.setattr(module, "RULES", tmp_path / "rules.d")
    monkeypatch.setattr(module, "RUNNING", tmp_path)
    monkeypatch.setattr(module, "_systemctl", lambda scope, *words: commands.append((scope, *words)))
    monkeypatch.setattr(module, "warm_first", lambda *_: None)
    return commands


def options(text):
    """{option: value} of a unit; the last one counts."""
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line and not line.startswith("#"))


@pytest.mark.skipif(ANALYZE is None, reason="systemd-analyze is not here")
@pytest.mark.parametrize("scope", ["user", "system"])
def test_systemd_takes_the_unit(scope, tmp_path):
    folder = tmp_path / "a folder of 100 %"
    folder.mkdir()
    settings = ('sim.world="a b"', "guard.field.stop_margin=0.07")
    unit = tmp_path / "zenav-x80sv.service"
    unit.write_text(unit_text(SystemdService("x80sv", scope, folder, "room", settings)))
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}  # noqa: TID251  # a user's manager wants one
    command = [ANALYZE, "verify", f"--{scope}", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def test_a_robot_with_a_name_of_its_own_has_a_unit_of_its_own(tmp_path):
    service = SystemdService("red@x80sv", "user", tmp_path)
    assert service.unit.name == "zenav-red.service"
    assert options(unit_text(service))["ExecStart"].endswith(" --robot red@x80sv")
    mine = new_robot("mine", "x80sv", tmp_path)
    assert f"--robot red@{mine}" in unit_text(SystemdService(f"red@{mine}", "user", tmp_path))


def test_the_unit_restarts_is_watched_and_writes_to_the_journal(tmp_path):
    found = options(unit_text(SystemdService("x80sv", "user", tmp_path)))
    assert found["Type"] == "notify"
    assert found["Restart"] == "always"
    assert float(found["WatchdogSec"]) > MAX_SILENCE_S
    assert found["StandardError"] == "journal"
    assert found["WorkingDirectory"] == str(tmp_path)
    assert "User" not in found  # a user's manager cannot change it
    assert "LimitRTPRIO" not in found


def test_a_unit_of_the_system_runs_as_the_account_that_asked(tmp_path, monkeypatch):
    monkeypatch.delenv("SUDO_USER", raising=False)
    assert options(unit_text(SystemdService("x80sv", "system", tmp_path)))["User"] == getpass.getuser()
    monkeypatch.setenv("SUDO_USER", "ada")
    found = options(unit_text(SystemdService("x80sv", "system", tmp_path)))
    assert found["User"] == "ada"
    assert found["LimitRTPRIO"] == "10"


def test_a_robot_of_the_current_folder_is_named_by_its_whole_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    new_robot("rover", "x80sv", tmp_path)
    command = options(unit_text(SystemdService("rover", "user", tmp_path)))["ExecStart"]
    assert command == f"{sys.executable} -P -m zenav up --robot {tmp_path / 'rover.yaml'}"


@pytest.mark.parametrize(
    ("word", "quoted"),
    [("plain", "plain"), ("two words", '"two words"'), ('say "x"', r'"say \"x\""'), ("100%", "100%%"), ("", '""'),
     ("$HOME", "$$HOME"), ("a\\b", '"a\\\\b"')],
)  # fmt: skip
def test_words_are_quoted_as_systemd_reads_them(word, quoted):
    assert module._quoted(word) == quoted


def test_installing_writes_and_enables_and_uninstalling_undoes_it(machine, tmp_path, capsys):
    install(SystemdService("x80sv", "system", tmp_path), udev=True)
    assert (tmp_path / "system" / "zenav-x80sv.service").is_file()
    assert (tmp_path / "rules.d" / "60-zenav-x80sv.rules").is_file()
    assert machine == [("system", "daemon-reload"), ("system", "enable", "zenav-x80sv.service")]
    assert "systemctl start zenav-x80sv" in capsys.readouterr().out
    machine.clear()
    uninstall("x80sv", "system")
    assert not list((tmp_path / "system").iterdir())
    assert not list((tmp_path / "rules.d").iterdir())
    assert machine == [("system", "disable", "--now", "zenav-x80sv.service"), ("system", "daemon-reload")]


@pytest.mark.parametrize("robot", ["red@x80sv", "red@{folder}/rover.yaml"])
def test_the_option_that_installed_a_unit_uninstalls_it_and_no_other(robot, machine, tmp_path):
    new_robot("rover", "x80sv", tmp_path)
    robot = robot.format(folder=tmp_path)
    for installed in (robot, str(tmp_path / "rover.yaml")):
        install(SystemdService(installed, "user", tmp_path), udev=False)
    assert _status(["uninstall-service", "--robot", robot]) == 0
    assert [unit.name for unit in (tmp_path / "user").iterdir()] == ["zenav-rover.service"]


def test_udev_rules_are_not_written_for_one_user(machine, tmp_path):
    with pytest.raises(UserError, match="whole machine"):
        install(SystemdService("x80sv", "user", tmp_path), udev=True)
    assert not list(tmp_path.iterdir())


def test_a_unit_whose_folder_is_missing_is_not_installed(machine, tmp_path, capsys):
    missing = tmp_path / "none"
    assert _status(["install-service", "--robot", "x80sv", "--folder", str(missing)]) == 2
    assert f"there is no folder {missing}\nhint: make it" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert machine == []


def test_printing_writes_nothing(machine, tmp_path, capsys):
    assert _status(["install-service", "--robot", "x80sv", "--system", "--print", "--udev"]) == 0
    shown = capsys.readouterr().out
    assert "ExecStart=" in shown
    assert "# udev rules" in shown
    assert not list(tmp_path.iterdir())
    assert machine == []


def test_udev_rules_name_the_adapters_that_the_robot_has(tmp_path):
    path = new_robot("rover", "x80sv", tmp_path)
    assert udev_rules(SystemdService(str(path), "user", tmp_path).file).startswith("#")
    settings = ("base_driver.port.serial_number=A50285BI", "lidar_driver.port.serial_number='0001'")
    board, laser = udev_rules(SystemdService(str(path), "user", tmp_path, settings=settings).file).splitlines()
    assert 'ATTRS{serial}=="A50285BI", SYMLINK+="board", GROUP="dialout"' in board
    assert 'ATTRS{serial}=="0001", SYMLINK+="laser"' in laser
    assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in board


def test_a_machine_without_systemd_is_told_what_else_there_is(machine, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "RUNNING", tmp_path / "none")
    with pytest.raises(UserError, match="systemd does not run here") as error:
        install(SystemdService("x80sv", "user", tmp_path), udev=False)
    assert "--print" in error.value.hint
    assert not (tmp_path / "user").exists()


def test_a_wrong_robot_or_setting_installs_nothing(machine, tmp_path):
    for service in (
        SystemdService("x80", "user", tmp_path),
        SystemdService("x80sv", "user", tmp_path, settings=("guard.no=1",)),
    ):
        with pytest.raises(UserError):
            install(service, udev=False)
    assert not (tmp_path / "user").exists()
    assert machine == []


def test_a_folder_that_cannot_be_written_is_told_with_the_way_out(machine, tmp_path):
    (tmp_path / "system").write_text("a file")
    with pytest.raises(UserError, match="cannot write") as error:
        install(SystemdService("x80sv", "system", tmp_path), udev=False)
    assert "sudo" in error.value.hint


def test_what_is_not_installed_is_not_removed_and_the_nearest_is_named(machine, tmp_path):
    install(SystemdService("x80sv", "user", tmp_path), udev=False)
    with pytest.raises(UserError, match="jackal is not installed as a user service"):
        uninstall("jackal", "user")
    with pytest.raises(UserError) as error:
        uninstall("x80s", "user")
    assert "x80sv" in error.value.hint
    assert (tmp_path / "user" / "zenav-x80sv.service").is_file()
