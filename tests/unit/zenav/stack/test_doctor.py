# SPDX-License-Identifier: Apache-2.0
"""The doctor finds each illness, names its cure, and does not die of it."""

import grp
import os
import socket
import time
from types import SimpleNamespace

import pytest
from ruamel.yaml import YAML
from serial.tools import list_ports

from shared.robot_files import ROBOTS_DIR
from shared.runners import port as ports
from shared.runners.transport import StackAddress
from zenav.__main__ import _status
from zenav.stack import doctor
from zenav.stack.doctor import BAD, OK, WARNING, findings
from zenav.stack.kernel_stamp import code_digest, write_stamp
from zenav.stack.launch import free_stack


def one(check) -> doctor.DoctorFinding:
    (finding,) = check()
    return finding


def test_a_stack_that_can_start_has_nothing_bad_and_every_part_is_looked_at(capsys):
    with free_stack() as claim:
        found = {finding.name: finding for finding in findings(claim.where, "x80sv")}
        looked_at = {"Python", "packages", "kernels", "CPU", "real time", "clock", "ports", "Zenoh", "serial", "disk"}
        looked_at |= {"robot"}
        assert looked_at <= set(found)
        assert all(finding.verdict == OK or finding.hint for finding in found.values())
        bad = [name for name, finding in found.items() if finding.verdict == BAD]
        assert bad == []
        assert _status(["doctor", "--stack", str(claim.where.domain)]) == 0
    assert "Zenoh" in capsys.readouterr().out


def test_a_strangers_port_is_bad_with_its_holder_and_the_status_says_so(capsys):
    with free_stack() as claim:
        where = claim.where
    with socket.socket() as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        holder.bind(("127.0.0.1", where.port("mapper")))
        holder.listen()
        (finding,) = doctor.ports(where)
        assert _status(["doctor", "--stack", str(where.domain)]) == 1
    assert finding.verdict == BAD
    assert f"{where.port('mapper')} (mapper) is taken by" in finding.found
    assert f"pid {os.getpid()}" in finding.found
    assert "--stack" in finding.hint
    assert "bad" in capsys.readouterr().out


def test_a_board_without_rights_is_bad(monkeypatch):
    monkeypatch.setattr(list_ports, "comports", lambda: [SimpleNamespace(device="/dev/ttyUSB0")])
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    finding = one(doctor.serial)
    assert (finding.verdict, "dialout" in finding.hint, "ttyUSB0" in finding.found) == (BAD, True, True)
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: True)
    assert one(doctor.serial) == doctor.DoctorFinding("serial", OK, "/dev/ttyUSB0")


def test_boards_are_named_by_their_usb_ids(monkeypatch):
    listed = [
        SimpleNamespace(device="/dev/ttyACM0", vid=0x2341, pid=0x0042, serial_number="75"),
        SimpleNamespace(device="/dev/ttyUSB0", vid=0x0403, pid=0x6001, serial_number="kobuki_A6"),
        SimpleNamespace(device="/dev/ttyUSB1", vid=0x10C4, pid=0xEA60, serial_number=None),
        SimpleNamespace(device="/dev/ttyACM1", vid=0x1209, pid=0x0D32, serial_number=None),
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: listed)
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: True)
    arduino, kobuki, other, odrive = one(doctor.serial).found.split(", /dev/")
    assert "Arduino" in arduino
    assert "serial number 75" in arduino
    assert "board.model kobuki" in kobuki
    assert other.startswith("ttyUSB1 (CP210x")
    assert "board.model odrive" in odrive


def robot_with_ports(folder, **devices: str):
    path = folder / "mine.yaml"
    path.write_text((ROBOTS_DIR / "x80sv.yaml").read_text())
    yaml = YAML()
    tree = yaml.load(path.read_text())
    for driver, device in devices.items():
        tree.setdefault(driver, {}).setdefault("port", {})["device"] = device
    yaml.dump(tree, path)
    return str(path)


def test_the_ports_that_a_robots_file_names_are_looked_for(tmp_path):
    (tmp_path / "laser").touch()
    robot = robot_with_ports(
        tmp_path, base_driver=str(tmp_path / "board"), lidar_driver=str(tmp_path / "laser"), imu_driver="/dev/null"
    )
    board, laser, imu = doctor.robot_ports(robot)
    assert (board.verdict, "board is not there" in board.found, "mine.yaml:" in board.hint) == (BAD, True, True)
    assert (laser.verdict, "is no serial device" in laser.found) == (BAD, True)
    assert imu == doctor.DoctorFinding("robot", OK, "imu_driver.port: /dev/null")
    (away,) = doctor.robot_ports(robot_with_ports(tmp_path, base_driver="socket://10.0.0.5:10001"))
    assert away.found == "base_driver.port: socket://10.0.0.5:10001 (not tried)"


def test_the_port_of_a_second_laser_is_looked_for_too(tmp_path):
    text = (ROBOTS_DIR / "delivery.yaml").read_text()
    port = "laser_2: {model: scip, port: {baud: 115200"
    assert text.count(port) == 1
    (tmp_path / "mine.yaml").write_text(text.replace(port, f"{port}, device: {tmp_path / 'rear'}"))
    (second,) = doctor.robot_ports(str(tmp_path / "mine.yaml"))
    assert (second.verdict, "lidar_driver.laser_2.port: " in second.found) == (BAD, True)
    assert "mine.yaml:" in second.hint


def test_a_robot_that_is_not_there_is_bad_and_one_without_ports_is_not():
    assert one(lambda: doctor.robot_ports("x80sw")).verdict == BAD
    assert one(lambda: doctor.robot_ports("x80sv")).verdict == OK


def test_boards_of_several_groups_are_told_each_its_hint(monkeypatch, tmp_path):
    boards = {name: tmp_path / name for name in ("ttyUSB0", "ttyUSB1")}
    for board, mode in zip(boards.values(), (0o660, 0o600)):
        board.touch()
        board.chmod(mode)
    monkeypatch.setattr(grp, "getgrgid", lambda number: SimpleNamespace(gr_name="uucp"))
    listed = [SimpleNamespace(device=f"/dev/{name}") for name in boards]
    monkeypatch.setattr(list_ports, "comports", lambda: listed)
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    stat = os.stat

    def stat_of_board(path, **options):
        return stat(boards.get(str(path).removeprefix("/dev/"), path), **options)

    monkeypatch.setattr(ports.os, "stat", stat_of_board)
    assert "usermod -aG uucp" in one(doctor.serial).hint
    assert "udev rule" in one(doctor.serial).hint


def test_a_clock_that_was_never_set_is_bad_and_one_that_jumps_is_told(monkeypatch):
    assert one(doctor.clock).verdict == OK
    jumps = iter([0, 10**9])
    monkeypatch.setattr(doctor.time, "time_ns", lambda: next(jumps))
    assert one(doctor.clock).verdict == WARNING
    monkeypatch.setattr(doctor.time, "time_ns", time.monotonic_ns)
    monkeypatch.setattr(doctor.time, "gmtime", lambda: SimpleNamespace(tm_year=1970))
    assert (one(doctor.clock).verdict, "timedatectl" in one(doctor.clock).hint) == (BAD, True)


def test_another_python_is_bad(monkeypatch):
    monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 2))
    assert (one(doctor.python).verdict, "make venv" in one(doctor.python).hint) == (BAD, True)


@pytest.mark.parametrize(("cores", "load", "verdict"), [(1, 0.1, WARNING), (4, 9.0, WARNING), (4, 1.0, OK)])
def test_too_little_processor_is_told(monkeypatch, cores, load, verdict):
    monkeypatch.setattr(doctor.os, "sched_getaffinity", lambda pid: set(range(cores)), raising=False)
    monkeypatch.setattr(doctor.os, "getloadavg", lambda: (load, load, load))
    assert one(doctor.processor).verdict == verdict


def test_a_router_that_does_not_answer_is_bad():
    (finding,) = doctor.loopback(StackAddress(router="tcp/127.0.0.1:1"))
    assert finding.verdict == BAD
    assert finding.hint


def test_a_check_that_fails_is_itself_a_finding(monkeypatch):
    def broken():
        raise OSError("no such thing")

    monkeypatch.setattr(doctor, "serial", broken)
    with free_stack() as claim:
        found = [finding for finding in findings(claim.where, "x80sv") if finding.verdict == WARNING]
    assert "cannot be looked at: no such thing" in [finding.found for finding in found]


def test_kernels_that_are_not_compiled_yet_are_told_with_the_command_that_does_it(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    finding = one(doctor.kernels)
    assert finding.verdict == WARNING
    assert finding.hint == "zenav warm"
    write_stamp(tmp_path, code_digest(), {"mapper 1", "planner 1"})
    assert one(doctor.kernels) == doctor.DoctorFinding(
        "kernels", OK, f"compiled, in {tmp_path}: 2 configurations of services"
    )
