# SPDX-License-Identifier: Apache-2.0
"""Gamepads of this computer: found, opened, lost and found again. Source: Linux, include/uapi/linux/input.h."""

import fcntl
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path

from zenav.client.gamepad import EV_ABS, EV_KEY, EVENT, FORWARD_AXIS, TURN_AXIS, AxisRange, Gamepad

INPUT = Path("/dev/input")
BTN_GAMEPAD = 0x130
KEY_BYTES, ABS_BYTES = 96, 8  # of the bit fields of keys and of axes
AXIS_INFO = struct.Struct("@6i")  # struct input_absinfo: value, minimum, maximum, fuzz, flat, resolution
READ_EVENTS = 64
LOOK_EVERY_S = 1.0
READ_DIRECTION = 2  # _IOC_READ


class GamepadDevice:
    """The gamepad at a path, or the first one of the computer for an empty path. It comes and goes."""

    def __init__(self, path: str, folder: Path = INPUT) -> None:
        self._path, self._folder = path, folder
        self._descriptor: int | None = None
        self.gamepad = Gamepad({})
        self.detail = "no gamepad is connected"
        self._look_at = 0.0  # s, monotonic

    def __enter__(self) -> "GamepadDevice":
        return self

    def __exit__(self, *_: object) -> None:
        self._close("closed")

    @property
    def descriptor(self) -> int | None:
        """To wait for; None while no gamepad is there."""
        return self._descriptor

    def open(self) -> bool:
        """Whether the gamepad is there; looks for it once a second."""
        if self._descriptor is not None:
            return True
        if time.monotonic() < self._look_at:
            return False
        self._look_at = time.monotonic() + LOOK_EVERY_S
        for path in self._candidates():
            try:
                descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
            except PermissionError:
                self.detail = f"{path} may not be opened: sudo usermod -aG input $USER, then log in again"
                continue
            except OSError:
                continue
            if (self._path and str(path) == self._path) or is_gamepad(descriptor):
                self._descriptor = descriptor
                self.gamepad = Gamepad(axis_ranges(descriptor))
                self.detail = str(path)
                return True
            os.close(descriptor)
        return False

    def read(self) -> None:
        """Takes what the gamepad sent. When it is gone, nothing is held any more."""
        if self._descriptor is None:
            return
        try:
            data = os.read(self._descriptor, READ_EVENTS * EVENT.size)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self.gamepad.take(data, time.monotonic())
        else:
            self._close("the gamepad is gone; connect it again")

    def _candidates(self) -> Iterator[Path]:
        if self._path:
            yield Path(self._path)
        else:
            yield from sorted(self._folder.glob("event*"), key=lambda path: (len(path.name), path.name))

    def _close(self, detail: str) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
        self._descriptor, self.detail = None, detail
        self.gamepad.forget()


def is_gamepad(descriptor: int) -> bool:
    """Whether a device has the buttons of a gamepad."""
    try:
        keys = _bits(descriptor, EV_KEY, KEY_BYTES)
    except OSError:
        return False
    return bool(keys[BTN_GAMEPAD // 8] >> BTN_GAMEPAD % 8 & 1)


def axis_ranges(descriptor: int) -> dict[int, AxisRange]:
    """The ranges of the sticks' axes that a device has."""
    ranges = {}
    try:
        axes = _bits(descriptor, EV_ABS, ABS_BYTES)
        for code in (FORWARD_AXIS, TURN_AXIS):
            if axes[code // 8] >> code % 8 & 1:
                info = fcntl.ioctl(descriptor, _request(0x40 + code, AXIS_INFO.size), bytes(AXIS_INFO.size))
                _, least, greatest, *_ = AXIS_INFO.unpack(info)
                ranges[code] = AxisRange(least, greatest)
    except OSError:
        pass  # a device that is gone: the next read says so
    return ranges


def _bits(descriptor: int, kind: int, n_bytes: int) -> bytes:
    return fcntl.ioctl(descriptor, _request(0x20 + kind, n_bytes), bytes(n_bytes))


def _request(number: int, n_bytes: int) -> int:
    """_IOC(_IOC_READ, 'E', number, n_bytes)."""
    return READ_DIRECTION << 30 | n_bytes << 16 | ord("E") << 8 | number
