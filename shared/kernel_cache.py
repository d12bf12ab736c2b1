# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, and how processes that compile at the same time do not harm each other.

A checkout has numba's `__pycache__` folders beside the code. An installed package may be read-only. So its kernels are
in the user's cache. The folder's name is a digest of the package, so another version has another folder.
`NUMBA_CACHE_DIR` overrides both.
"""

import fcntl
import hashlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # it imports numpy, which shared.repeatable must come before
    from shared.service import Service

ROOT = Path(__file__).resolve().parents[1]


def installed_cache(root: Path = ROOT) -> Path | None:
    """The folder for the kernels of a package installed at `root`; None for a checkout, or without a home folder."""
    record = next(root.glob("zenav-*.dist-info/RECORD"), None)  # a hash of each file of the package
    if record is None or (root / "pyproject.toml").is_file():
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")  # noqa: TID251  # as freedesktop's base directories say
    try:
        folder = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    except RuntimeError:
        return None
    version = record.parent.name.removeprefix("zenav-").removesuffix(".dist-info")
    return folder / "zenav" / "kernels" / f"{version}-{hashlib.sha256(record.read_bytes()).hexdigest()[:8]}"


def warm_up(service: "Service") -> None:
    """Compiles or loads what a service uses, before it starts; safe beside other processes that do the same."""
    serialize_saves()
    service.warm_up()


def serialize_saves() -> None:
    """From now on this process saves a kernel under a lock of its index. Without effect where numba is not imported.

    numba reads a kernel's index, takes the next free number, and writes both files. Two processes at one time could
    take one number for two signatures. The index would then lead to the machine code of the wrong one.
    """
    if "numba" not in sys.modules:  # a service without kernels shall not load it
        return
    from numba.core import caching

    file_class: Any = caching.IndexDataCacheFile

    if getattr(file_class.save, "is_serialized", False):
        return
    save_unlocked = file_class.save

    def save(self: Any, key: Any, data: Any) -> None:
        with open(f"{self._index_path}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # closing releases it, so does the end of the process
            save_unlocked(self, key, data)

    save.is_serialized = True  # type: ignore[attr-defined]
    file_class.save = save
