# SPDX-License-Identifier: Apache-2.0
"""The device of a gamepad, which may come and go."""

import os
import select
import time
from pathlib import Path

from shared.config import UserError

INPUTS = Path("/dev/input")
AGAIN_S = 0.5  # between two tries to open it
MAX_READ = 1024


class GamepadDevice:
    """Reads /dev/input/js0, or the device that is given, again and again when it was unplugged.

    folder: where the first `js*` is taken from. Raises UserError where a device may not be opened.
    """

    def __init__(self, path: str = "", folder: Path = INPUTS) -> None:
        self._path, self._folder = path, folder
        self._file: int | None = None
        self._tried_at = float("-inf")

    def __enter__(self) -> "GamepadDevice":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def is_open(self) -> bool:
        return self._file is not None

    def read(self, seconds: float) -> bytes | None:
        """The bytes that come within this time, perhaps none; None where there is no device."""
        if self._file is None and not self._open():
            time.sleep(seconds)  # noqa: TID251  # there is nothing to wait for
            return None
        assert self._file is not None
        try:
            readable, _, _ = select.select([self._file], [], [], seconds)
            if not readable:
                return b""
            data = os.read(self._file, MAX_READ)
        except OSError:
            data = b""
        if not data:  # the end of the file, or ENODEV: unplugged
            self._close()
            return None
        return data

    def _open(self) -> bool:
        now = time.monotonic()
        if now - self._tried_at < AGAIN_S:
            return False
        self._tried_at = now
        path = self._path or next((str(p) for p in sorted(self._folder.glob("js*"))), "")
        if not path:
            return False
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except PermissionError:
            raise UserError(f"{path} may not be opened", "sudo usermod -aG input $USER, then log in again") from None
        except OSError:
            return False
        return True

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
