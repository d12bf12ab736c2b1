# SPDX-License-Identifier: Apache-2.0
"""What must outlive a process: the last latched values of a service, for the one that takes its place."""

import logging
from collections.abc import Callable
from pathlib import Path

from shared.runners.clock import SECOND

REMEMBERED = 30 * SECOND  # an older memory is of another drive: the robot may have been carried meanwhile

log = logging.getLogger("zenav")


class Memory:
    """What a service published last on its latched topics, kept on disk for its successor after a crash."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._name = folder, name
        folder.mkdir(parents=True, exist_ok=True)

    def write(self, key: str, value: Callable[[], bytes]) -> None:
        """Replaces the kept value, whole or not at all."""
        path = self._path(key)
        part = path.with_suffix(".part")
        try:
            part.write_bytes(value())
            part.replace(path)
        except OSError as error:
            log.warning("%s cannot be kept for a restart: %s", key, error)

    def read(self, key: str) -> bytes | None:
        """The kept value, or None."""
        try:
            return self._path(key).read_bytes()
        except FileNotFoundError:
            return None

    def _path(self, key: str) -> Path:
        return self._folder / f"{self._name}-{key.replace('/', '-')}.msgpack"
