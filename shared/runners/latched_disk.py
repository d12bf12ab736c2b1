# SPDX-License-Identifier: Apache-2.0
"""Files with a service's last latched values, for its next process after a crash."""

import logging
from collections.abc import Callable
from pathlib import Path

from shared.config import UserError
from shared.file_modes import make_folder
from shared.types import NS_PER_S

MAX_RESTART_AGE_NS = 30 * NS_PER_S  # the robot may have been moved since an older value

log = logging.getLogger("zenav")


class LatchedDisk:
    """The last values of a service's latched topics, in files of `folder`.

    Raises UserError where the folder cannot be made.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self._name = folder, name
        try:
            make_folder(folder)
        except OSError as error:
            what = f"nothing can be kept for a restart in {folder}: {error.strerror}"
            raise UserError(what, "name another folder: --memory") from None

    def write(self, key: str, value: Callable[[], bytes]) -> None:
        """Replaces a key's value as a whole. An error is logged."""
        path = self._path(key)
        part = path.with_suffix(".part")
        try:
            part.write_bytes(value())
            part.replace(path)
        except OSError as error:
            log.warning("%s cannot be kept for a restart: %s", key, error)

    def read(self, key: str) -> bytes | None:
        """A key's value as bytes, or None. An error is logged."""
        try:
            return self._path(key).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            log.warning("%s of before the restart cannot be read: %s", key, error)
            return None

    def remove(self, key: str) -> None:
        """Removes a key's value. An error is logged."""
        try:
            self._path(key).unlink(missing_ok=True)
        except OSError as error:
            log.warning("%s stays for the next restart: %s", key, error)

    def _path(self, key: str) -> Path:
        return self.folder / f"{self._name}-{key.replace('/', '-')}.msgpack"
