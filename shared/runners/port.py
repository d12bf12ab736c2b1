# SPDX-License-Identifier: Apache-2.0
"""The ports of a live service: one thread reads, one writes. An unplugged device is opened again when it is back.

This module does not interpret the bytes, and it never blocks the service. Data that could not be written within LIFE is
dropped, because an old command must not reach a robot.
"""

import errno
import grp
import os
import pty
import select
import socket
import stat
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import serial
from serial.tools import list_ports

from shared import topics
from shared.messages import PortState, SerialData
from shared.ports import PortConfig
from shared.robot_files import manual_page
from shared.runners.clock import StackClock
from shared.topics import Publication

LIFE = 0.1  # s from an order to write until it is void
AGAIN = 0.25  # s between two tries to open
PATIENCE = 0.1  # s that a read waits, so that closing is noticed
CHUNK = 4096  # bytes read at once, at most
MAX_SOCKET_PORT = 65535
GROUP_MAY = stat.S_IRGRP | stat.S_IWGRP


class Line(Protocol):
    """An open device."""

    def read(self) -> bytes:
        """Received bytes, after at most PATIENCE s. Raises OSError when the device is gone."""

    def write(self, data: bytes) -> None:
        """Writes the data, for at most LIFE s. Raises OSError when the device is gone."""

    def close(self) -> None: ...


class Port:
    """One port of a service. publish: called with messages of topics.RX and topics.PORT, from any thread."""

    def __init__(
        self, name: str, config: PortConfig, clock: StackClock, publish: Callable[[Publication], object]
    ) -> None:
        self.name, self.config, self._clock, self._publish = name, config, clock, publish
        self._line: Line | None = None
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._changed = threading.Condition()
        self._writing = threading.Lock()  # nothing is written to a line that is being closed
        self._plugged, self._closing = True, False
        self._state: tuple[bool, str] | None = None
        self._threads = [
            threading.Thread(target=work, name=f"{name} {work.__name__.strip('_')}", daemon=True)
            for work in (self._read, self._write)
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def write(self, data: bytes) -> None:
        """Queues data for writing. It is dropped where the device is missing, or too slow."""
        with self._changed:
            self._waiting.append((time.monotonic() + LIFE, data))
            self._changed.notify_all()

    def plug(self, plugged: bool) -> None:
        """Removes or restores the device, for an emulator's pseudo-terminal."""
        with self._changed:
            self._plugged = plugged
            self._changed.notify_all()

    def close(self) -> None:
        """Writes the queued data, then closes."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(LIFE + PATIENCE + 1)

    def _read(self) -> None:
        while not self._closing:
            if not self._plugged:
                self._publish_state(False, "unplugged")
                self._pause()
                continue
            try:
                line = opened(self.config)
            except OSError as error:
                self._publish_state(False, trouble(self.config, error))
                self._pause()
                continue
            with self._changed:
                self._waiting.clear()
                self._line = line
            self._publish_state(True, "")
            try:
                while self._wanted():
                    data = line.read()
                    if data:
                        self._publish(topics.RX(SerialData(self._clock.now(), self.name, data)))
                if not self._closing:  # published before closing, so that a quick unplug is visible
                    self._publish_state(False, "unplugged")
            except OSError as error:
                self._publish_state(False, trouble(self.config, error))
            finally:
                with self._writing:
                    self._line = None
                    line.close()

    def _wanted(self) -> bool:
        """Whether the device stays open: until the queued data is written."""
        return self._plugged and (not self._closing or self._threads[1].is_alive())

    def _write(self) -> None:
        while True:
            with self._changed:
                while not self._waiting:
                    if self._closing:
                        return
                    self._changed.wait(PATIENCE)
                until, data = self._waiting.popleft()
                line = self._line
            with self._writing, suppress(OSError):  # the reader notices it, too, and opens the device again
                if line is not None and line is self._line and time.monotonic() < until:
                    line.write(data)

    def _pause(self) -> None:
        with self._changed:
            if not self._closing:
                self._changed.wait(AGAIN)

    def _publish_state(self, open_: bool, detail: str) -> None:
        if self._state != (open_, detail):
            self._state = open_, detail
            self._publish(topics.PORT(PortState(self._clock.now(), self.name, open_, detail)))


# --- devices --------------------------------------------------------------------------------------------------------


def opened(config: PortConfig) -> Line:
    """The device of a configuration, open. Raises OSError (serial.SerialException is one)."""
    device = found(config)
    if device.startswith("pty:"):
        return PseudoTerminal(Path(device.removeprefix("pty:")))
    kind, _, address = device.partition("://")
    if kind in ("udp", "listen"):
        host, _, port = address.rpartition(":")
        if not port.isdecimal() or int(port) > MAX_SOCKET_PORT:
            raise OSError(errno.EINVAL, f"{device!r} is no {kind}://HOST:PORT")
        return Datagrams(host, int(port)) if kind == "udp" else Listener(host, int(port))
    return SerialLine(device, config.baud, config.dtr)


def found(config: PortConfig) -> str:
    """The device's present path, by its USB serial number where that is given. Raises FileNotFoundError."""
    if not config.by_number:
        return config.device
    try:
        candidates = list_ports.comports()
    except (TypeError, ValueError) as error:  # pyserial read files of a device that just went
        raise FileNotFoundError(errno.ENOENT, "the USB devices change") from error
    for candidate in candidates:
        if candidate.serial_number == config.serial_number:
            return str(candidate.device)
    raise FileNotFoundError(errno.ENOENT, f"no USB adapter with serial number {config.serial_number}")


class SerialLine:
    """A serial device, or a terminal server (`socket://`), by pyserial."""

    def __init__(self, device: str, baud: int, dtr: bool) -> None:
        try:
            self._port = serial.serial_for_url(
                device, baud, timeout=PATIENCE, write_timeout=LIFE, exclusive=True, do_not_open=True
            )
            self._port.dtr = dtr  # set before opening, so that the line never has another level
            self._port.open()
        except ValueError as error:
            raise OSError(errno.EINVAL, str(error)) from None
        except termios.error as error:
            raise _gone(error) from None

    def read(self) -> bytes:
        """All received bytes in one call: pyserial reads a socket byte by byte, and a device in two steps."""
        descriptor: int = self._port.fileno()
        ready, _, _ = select.select([descriptor], [], [], PATIENCE)
        if not ready:
            return b""
        data = os.read(descriptor, CHUNK)
        if not data:
            raise OSError(errno.EIO, "the other end hung up")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            try:
                self._port.reset_output_buffer()  # the line stalls: an old command must not be sent later
            except termios.error as error:
                raise _gone(error) from None

    def close(self) -> None:
        with suppress(OSError, termios.error):
            self._port.close()


def _gone(error: termios.error) -> OSError:
    """The error of a device that went while it was set, which pyserial passes on as it is."""
    return OSError(error.args[0] if error.args else errno.EIO, str(error))


class Datagrams:
    """A board behind UDP, at one address."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(PATIENCE)
        self._socket.connect((host, port))

    def read(self) -> bytes:
        try:
            return self._socket.recv(65536)
        except (TimeoutError, ConnectionRefusedError):
            return b""  # the board does not listen yet

    def write(self, data: bytes) -> None:
        with suppress(ConnectionRefusedError):
            self._socket.send(data)

    def close(self) -> None:
        self._socket.close()


class Listener:
    """The server end of a `socket://`, for one driver at a time: the newest."""

    def __init__(self, host: str, port: int) -> None:
        self._server = socket.create_server((host, port))
        self._client: socket.socket | None = None

    def read(self) -> bytes:
        watched = [self._server, *([self._client] if self._client is not None else [])]
        ready, _, _ = select.select(watched, [], [], PATIENCE)
        if self._server in ready:
            self._hang_up()
            self._client, _ = self._server.accept()
            self._client.setblocking(False)
        if self._client is None or self._client not in ready:
            return b""
        with suppress(ConnectionError):
            data = self._client.recv(CHUNK)
            if data:
                return data
        self._hang_up()
        return b""

    def write(self, data: bytes) -> None:
        if self._client is not None:
            with suppress(BlockingIOError, ConnectionError):  # without a reader the data is lost, as on a real line
                self._client.send(data)

    def close(self) -> None:
        self._hang_up()
        self._server.close()

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


class PseudoTerminal:
    """The far end of an emulated serial line. A driver opens `link` as its device."""

    def __init__(self, link: Path) -> None:
        self._link = link
        self._master, self._slave = pty.openpty()  # our slave end keeps it alive while no driver has it open
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        with suppress(FileNotFoundError):
            link.unlink()
        link.symlink_to(os.ttyname(self._slave))

    def read(self) -> bytes:
        ready, _, _ = select.select([self._master], [], [], PATIENCE)
        return os.read(self._master, CHUNK) if ready else b""

    def write(self, data: bytes) -> None:
        with suppress(BlockingIOError):  # without a reader the data is lost, as on a real line
            os.write(self._master, data)

    def close(self) -> None:
        with suppress(OSError):
            if _target(self._link) == os.ttyname(self._slave):  # else another emulator has the link
                self._link.unlink()
        os.close(self._master)
        os.close(self._slave)


# --- errors ---------------------------------------------------------------------------------------------------------


def access_error(config: PortConfig) -> str:
    """Why a device file cannot be used, in one line, without opening it; empty where it can, or is no file."""
    if config.kind or config.device.startswith("pty:"):
        return ""
    try:
        device = found(config)
        mode = os.stat(device).st_mode
        if not os.access(device, os.R_OK | os.W_OK):
            raise PermissionError(errno.EACCES, "")
    except OSError as error:
        return trouble(config, error)
    return "" if stat.S_ISCHR(mode) else f"{config.name} is no serial device: name another"


def trouble(config: PortConfig, error: OSError) -> str:
    """Why a port cannot be used, with a hint, in one line."""
    device = config.name
    number = error.errno if error.errno is not None else _number_in(error)
    if number == errno.ENOENT:
        return f"{device} is not there: plug it in, or name another device"
    if number == errno.EACCES:
        return f"no permission for {device}: {admission(_path(config))}"
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{device} is in use{_holders(_path(config))}: end that, or name another device"
    if number in (errno.EIO, errno.ENXIO, errno.ENODEV, errno.EBADF) or "disconnected" in str(error):
        return f"{device} went away: plug it in again"
    return f"{device}: {error.strerror or error}"


def _number_in(error: OSError) -> int:
    """The errno of a pyserial error without one: a lock is only in its text."""
    return errno.EBUSY if "exclusively lock" in str(error) else 0


def admission(device: str) -> str:
    """Hint that gives this account access to a serial device: a command, or a page."""
    try:
        state = os.stat(device)
        group = grp.getgrgid(state.st_gid).gr_name
    except (OSError, KeyError):
        return "sudo usermod -aG dialout $USER, then log in again"
    if group == "root" or state.st_mode & GROUP_MAY != GROUP_MAY:
        return f"give it to a group by a udev rule: see {manual_page('hardware.md')}"
    return f"sudo usermod -aG {group} $USER, then log in again"


def _path(config: PortConfig) -> str:
    """The device's present path; empty where it is missing."""
    try:
        return os.path.realpath(found(config))
    except OSError:
        return ""


def _holders(device: str) -> str:
    """` by NAME (PID)` of each other process that has the device open, as far as /proc shows it."""
    holders = set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # another user's, or it has ended meanwhile
            for link in (process / "fd").iterdir():
                if process.name != str(os.getpid()) and _target(link) == device:
                    holders.add(f"{(process / 'comm').read_text(errors='replace').strip()} ({process.name})")
    return f" by {', '.join(sorted(holders))}" if holders else ""


def _target(link: Path) -> str:
    """Where a symbolic link leads; empty where it is gone."""
    try:
        return os.readlink(link)
    except OSError:
        return ""
