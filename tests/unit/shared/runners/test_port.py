# SPDX-License-Identifier: Apache-2.0
"""Ports on real pseudo-terminals and sockets: bytes pass in order, devices come back, errors say the hint."""

import errno
import os
import pty
import queue
import socket
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from serial import serialposix

from shared.messages import PortState, SerialData
from shared.ports import PortConfig
from shared.runners import port as ports
from shared.runners.clock import StackClock
from shared.runners.port import Port, opened, trouble

SOON = 30.0  # s that a busy machine may take


class Heard:
    """The messages of a port, one by one."""

    def __init__(self) -> None:
        self.messages: queue.Queue[SerialData | PortState] = queue.Queue()
        self.file = lambda publication: self.messages.put(publication.message)

    def state(self) -> PortState:
        """The next state, whatever bytes come before it."""
        while True:
            message = self.messages.get(timeout=SOON)
            if isinstance(message, PortState):
                return message

    def data(self, n: int) -> bytes:
        """The next n bytes."""
        data = b""
        while len(data) < n:
            message = self.messages.get(timeout=SOON)
            assert isinstance(message, SerialData)
            data += message.data
        return data


@contextmanager
def running(device: str, serial_number: str = "") -> Iterator[tuple[Port, Heard]]:
    heard = Heard()
    port = Port("board", PortConfig(device=device, serial_number=serial_number), StackClock(), heard.file)
    port.start()
    try:
        yield port, heard
    finally:
        port.close()


def test_bytes_pass_both_ways_in_order_and_unchanged(tmp_path):
    every_byte = bytes(range(256)) * 3
    with running(f"pty:{tmp_path}/robot") as (far, at_far):
        assert at_far.state().open
        with running(f"{tmp_path}/robot") as (near, at_near):
            assert at_near.state().open
            far.write(every_byte)
            assert at_near.data(len(every_byte)) == every_byte
            near.write(every_byte)
            assert at_far.data(len(every_byte)) == every_byte


def test_an_emulator_that_ends_leaves_the_link_of_the_one_that_replaced_it(tmp_path):
    with running(f"pty:{tmp_path}/robot") as (old, at_old):
        assert at_old.state().open
        with running(f"pty:{tmp_path}/robot") as (_, at_far):
            assert at_far.state().open
            old.close()
            with running(f"{tmp_path}/robot") as (near, at_near):
                assert at_near.state().open
                near.write(b"ping")
                assert at_far.data(4) == b"ping"


def test_what_was_ordered_before_closing_is_still_written(tmp_path):
    with running(f"pty:{tmp_path}/robot") as (_, at_far):
        assert at_far.state().open
        with running(f"{tmp_path}/robot") as (near, at_near):
            assert at_near.state().open
            near.write(b"motors off")
        assert at_far.data(10) == b"motors off"


def test_an_unplugged_adapter_is_named_and_found_again(tmp_path):
    with running(f"pty:{tmp_path}/robot") as (far, at_far), running(f"{tmp_path}/robot") as (near, at_near):
        while not at_near.state().open:
            pass
        far.plug(False)
        gone = at_near.state()
        assert not gone.open
        assert "plug it in" in gone.detail
        near.write(b"an old command")  # it must never arrive
        assert at_far.state().open
        assert not at_far.state().open
        far.plug(True)
        assert at_far.state().open
        while not at_near.state().open:
            pass
        near.write(b"new")
        assert at_far.data(3) == b"new"


def test_an_adapter_is_found_by_its_serial_number_under_another_name(tmp_path, monkeypatch):
    candidates = [SimpleNamespace(serial_number="7", device=f"{tmp_path}/one")]
    monkeypatch.setattr(ports.list_ports, "comports", lambda: candidates)
    with running(f"pty:{tmp_path}/one") as (far, _), running("", "7") as (_, at_near):
        while not at_near.state().open:
            pass
        far.plug(False)
        assert not at_near.state().open
        candidates[:] = [SimpleNamespace(serial_number="7", device=f"{tmp_path}/two")]
        with running(f"pty:{tmp_path}/two") as (other, at_other):
            assert at_other.state().open
            while not at_near.state().open:
                pass
            other.write(b"here")
            assert at_near.data(4) == b"here"


@pytest.mark.parametrize("step", ["tcgetattr", "tcflush"])
def test_an_adapter_that_goes_while_it_is_opened_is_tried_again(step, monkeypatch):
    master, slave = pty.openpty()
    tty.setraw(slave)
    device, fails = os.ttyname(slave), iter([True, True])

    def goes_twice(*arguments):
        if next(fails, False):
            raise termios.error(errno.EIO, "Input/output error")
        return getattr(termios, step)(*arguments)

    monkeypatch.setattr(serialposix, "termios", SimpleNamespace(**{**vars(termios), step: goes_twice}))
    with running(device) as (_, heard):
        assert not heard.state().open
        assert heard.state().open
    os.close(master)
    os.close(slave)


def test_usb_devices_that_go_while_they_are_listed_are_looked_for_again(tmp_path, monkeypatch):
    def half_there():
        raise TypeError("int() argument must be a string")

    monkeypatch.setattr(ports.list_ports, "comports", half_there)
    adapter = SimpleNamespace(serial_number="A6", device=f"pty:{tmp_path / 'line'}")
    with running("", serial_number="A6") as (_, heard):
        assert not heard.state().open
        monkeypatch.setattr(ports.list_ports, "comports", lambda: [adapter])
        assert heard.state().open


def test_a_line_that_nobody_reads_holds_up_neither_the_service_nor_later_bytes(tmp_path):
    master, slave = pty.openpty()  # a real line whose far end stalls
    tty.setraw(slave)
    with running(os.ttyname(slave)) as (near, at_near):
        assert at_near.state().open
        for _ in range(300):
            near.write(bytes(1000))  # far more than any buffer: must return at once
        assert threading.active_count() < 20
        os.write(master, b"still heard")
        assert at_near.data(11) == b"still heard"
    os.close(slave)
    os.close(master)


def test_a_device_that_is_not_there_is_named_with_the_hint(tmp_path):
    with running(f"{tmp_path}/nothing") as (_, heard):
        state = heard.state()
    assert not state.open
    assert state.detail == f"{tmp_path}/nothing is not there: plug it in, or name another device"


def test_a_device_in_use_names_who_holds_it(tmp_path):
    with running(f"pty:{tmp_path}/robot") as (_, at_far):
        assert at_far.state().open
        config = PortConfig(device=f"{tmp_path}/robot")
        holder = opened(config)
        with pytest.raises(OSError) as refused:
            opened(config)
        assert trouble(config, refused.value) == f"{config.device} is in use: end that, or name another device"
        holder.close()


HOLDS = "import serial, sys; port = serial.Serial(sys.argv[1], exclusive=True); print(flush=True); sys.stdin.read()"
RENAMED = "open('/proc/self/comm', 'wb').write('abcdefghijklmnü'.encode()); " + HOLDS  # cut after 15 bytes


@pytest.mark.parametrize("number", ["", "7"], ids=["by its name", "by its serial number"])
def test_a_device_in_use_by_another_process_names_it(tmp_path, monkeypatch, number):
    link = f"{tmp_path}/robot"
    monkeypatch.setattr(ports.list_ports, "comports", lambda: [SimpleNamespace(serial_number="7", device=link)])
    with running(f"pty:{link}") as (_, at_far):
        assert at_far.state().open
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with subprocess.Popen([sys.executable, "-c", HOLDS, link], **pipes) as holder:
            assert holder.stdout.readline()
            with running("" if number else link, number) as (_, at_near):
                state = at_near.state()
            name = Path(f"/proc/{holder.pid}/comm").read_text().strip()
            holder.stdin.close()
    assert not state.open
    assert f"is in use by {name} ({holder.pid}): end that" in state.detail


def test_a_device_is_opened_when_a_process_whose_name_is_cut_within_a_character_gives_it_free(tmp_path):
    with running(f"pty:{tmp_path}/robot") as (_, at_far):
        assert at_far.state().open
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with subprocess.Popen([sys.executable, "-c", RENAMED, f"{tmp_path}/robot"], **pipes) as holder:
            assert holder.stdout.readline()
            with running(f"{tmp_path}/robot") as (_, at_near):
                state = at_near.state()
                holder.stdin.close()
                assert at_near.state().open
    assert "is in use by abcdefghijklmn" in state.detail


def test_processes_that_end_while_the_holder_of_a_device_is_looked_for_are_left_out(tmp_path, monkeypatch):
    device, processes = tmp_path / "ttyUSB0", tmp_path / "proc"
    device.touch()
    for number in ("1", "2", "3"):
        (processes / number / "fd").mkdir(parents=True)
    (processes / "2" / "fd" / "5").symlink_to(device)
    (processes / "2" / "comm").write_text("modem\n")

    def listed(function, path):
        if Path(path).parent.name in ("1", "3") and Path(path).name == "fd":
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        return function(path)

    for function in (os.scandir, os.listdir):  # by one of these a path lists its folder
        monkeypatch.setattr(os, function.__name__, partial(listed, function))
    monkeypatch.setattr(ports, "Path", lambda path: processes if path == "/proc" else Path(path))
    busy = OSError(errno.EBUSY, os.strerror(errno.EBUSY))
    assert "is in use by modem (2)" in trouble(PortConfig(device=str(device)), busy)


@pytest.mark.parametrize(
    ("group", "mode", "hint"),
    [
        ("dialout", 0o660, "sudo usermod -aG dialout $USER, then log in again"),
        ("uucp", 0o660, "sudo usermod -aG uucp $USER, then log in again"),
        ("dialout", 0o600, "udev rule"),
        ("root", 0o660, "udev rule"),
    ],
)
def test_who_may_not_open_a_device_is_told_its_own_group_or_that_it_needs_one(tmp_path, monkeypatch, group, mode, hint):
    device = tmp_path / "ttyUSB0"
    device.touch()
    device.chmod(mode)
    monkeypatch.setattr(ports.grp, "getgrgid", lambda number: SimpleNamespace(gr_name=group))
    text = trouble(PortConfig(device=str(device)), PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
    assert text.startswith(f"no permission for {device}: ")
    assert hint in text


def test_an_adapter_that_is_away_is_named_by_its_number_and_a_name_beside_it_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(ports.list_ports, "comports", list)
    with running(f"{tmp_path}/somebody", "7") as (_, heard):
        assert heard.state().detail == "the adapter 7 is not there: plug it in, or name another device"


@pytest.mark.parametrize("device", ["wired", "socket://emulator:4001", "udp://10.0.0.2:10001", "pty:/tmp/board"])
def test_what_is_no_adapter_is_not_looked_for_by_a_number(device):
    assert ports.found(PortConfig(device=device, serial_number="7")) == device


@pytest.mark.parametrize(
    ("number", "hint"), [(errno.EACCES, "usermod -aG dialout"), (errno.EIO, "plug it in again"), (errno.ENOSPC, "left")]
)
def test_each_error_of_a_device_is_one_line(number, hint):
    text = trouble(PortConfig(device="/dev/ttyUSB0"), OSError(number, os.strerror(number)))
    assert hint in text
    assert "/dev/ttyUSB0" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    "device",
    [
        "udp://nowhere",
        "listen://here",
        "gopher://x",
        "socket://missing",
        "udp://10.0.0.2:65536",
        "listen://0.0.0.0:99999",
    ],
)
def test_a_device_that_is_no_address_is_an_error_that_names_it(device):
    config = PortConfig(device=device)
    with pytest.raises(OSError) as refused:
        opened(config)
    assert device.partition("/")[0].rstrip(":") in trouble(config, refused.value)


def test_a_board_behind_udp_speaks_too():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.bind(("127.0.0.1", 0))
        with running(f"udp://127.0.0.1:{board.getsockname()[1]}") as (port, heard):
            assert heard.state().open
            port.write(b"ping")
            data, address = board.recvfrom(100)
            assert data == b"ping"
            board.sendto(b"pong", address)
            assert heard.data(4) == b"pong"


def test_a_board_behind_a_terminal_server_speaks_too():
    server = socket.create_server(("127.0.0.1", 0))
    with server, running(f"socket://127.0.0.1:{server.getsockname()[1]}") as (port, heard):
        connection, _ = server.accept()
        assert heard.state().open
        port.write(b"ping")
        assert connection.recv(100) == b"ping"
        connection.sendall(b"pong")
        assert heard.data(4) == b"pong"
        connection.close()
        assert not heard.state().open


def test_bytes_of_a_terminal_server_are_not_read_one_by_one():
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = opened(PortConfig(device=f"socket://127.0.0.1:{server.getsockname()[1]}"))
        connection, _ = server.accept()
        with connection:
            connection.sendall(bytes(1000))
            assert line.read() == bytes(1000)
        line.close()


def test_an_emulator_that_listens_serves_the_newest_driver_and_can_be_unplugged():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
    with (
        running(f"listen://127.0.0.1:{number}") as (far, at_far),
        running(f"socket://127.0.0.1:{number}") as (near, at),
    ):
        assert at_far.state().open
        while not at.state().open:
            pass
        near.write(b"ping")
        assert at_far.data(4) == b"ping"
        far.write(b"pong")
        assert at.data(4) == b"pong"
        far.plug(False)
        assert not at.state().open
        far.plug(True)
        while not at_far.state().open:
            pass
        for _ in range(100):  # what is written while it connects may be lost
            near.write(b"b")
            with suppress(queue.Empty):
                assert at_far.messages.get(timeout=0.1).data.startswith(b"b")
                break
        else:
            pytest.fail("it never came back")


def test_what_is_plugged_in_again_while_it_still_closes_was_away(monkeypatch):
    with running("listen://127.0.0.1:0") as (far, at_far):
        assert at_far.state().open
        closed = ports.Listener.close

        def in_the_meantime(line: ports.Listener) -> None:
            closed(line)
            far.plug(True)

        monkeypatch.setattr(ports.Listener, "close", in_the_meantime)
        far.plug(False)
        assert [at_far.state().open, at_far.state().open] == [False, True]


def test_a_link_left_behind_by_a_killed_emulator_is_replaced(tmp_path):
    (tmp_path / "robot").symlink_to("/dev/pts/nothing")
    with running(f"pty:{tmp_path}/robot") as (_, heard):
        assert heard.state().open
        assert Path(f"{tmp_path}/robot").resolve().exists()
    assert not Path(f"{tmp_path}/robot").is_symlink()


@pytest.mark.parametrize("dtr", [True, False])
def test_dtr_has_its_level_before_the_device_opens(dtr, monkeypatch):
    class Device:
        def open(self) -> None:
            opened_with.append(self.dtr)

    opened_with: list[bool] = []
    monkeypatch.setattr(ports.serial, "serial_for_url", lambda *_, do_not_open, **__: Device())
    opened(PortConfig(device="/dev/ttyUSB0", dtr=dtr))
    assert opened_with == [dtr]
