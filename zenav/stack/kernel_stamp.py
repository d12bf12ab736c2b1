# SPDX-License-Identifier: Apache-2.0
"""Which configurations have their kernels in the cache, and when the cache is stale.

numba notices a change in a kernel's own file. It does not notice a change of a kernel that it calls in another file,
and runs the old code of that one. So any change of a file with kernels clears the whole cache first.
"""

import fcntl
import hashlib
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from shared.config import RobotFile, UserError
from shared.kernel_cache import ROOT, installed_cache
from shared.repeatable import processor
from shared.ros_map import replace_file

STAMP = ".kernels"
PACKAGES = "services", "shared", "zenav"


class CodeDigest(NamedTuple):
    """kernels: of every file with a kernel. sources: of every file of the services, which say what is compiled."""

    kernels: str
    sources: str


def cache_root() -> Path:
    """Where numba keeps what it compiled: one folder for all, or `__pycache__` beside each file of a checkout."""
    folder = os.environ.get("NUMBA_CACHE_DIR", "")  # noqa: TID251  # numba's own setting
    return Path(folder) if folder else ROOT


@contextmanager
def cache_lock(cache: Path) -> Iterator[None]:
    """Held by the one process that compiles ahead. Raises UserError where the cache cannot be written."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        lock = (cache / f"{STAMP}.lock").open("w")
    except OSError as error:
        hint = "set NUMBA_CACHE_DIR to a folder of yours"
        raise UserError(f"cannot keep compiled kernels in {cache}: {error.strerror}", hint) from None
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def read_stamp(cache: Path, code: CodeDigest) -> set[str]:
    """The keys of the configurations whose kernels are in the cache; none where the stamp is of other code."""
    stamp = _stamp(cache)
    return set(stamp["warmed"]) if stamp.get("code") == [*code] else set()


def write_stamp(cache: Path, code: CodeDigest, warmed: set[str]) -> None:
    """Replaces the stamp."""
    replace_file(cache / STAMP, json.dumps({"code": code, "warmed": sorted(warmed)}, indent=1).encode())


def clear_stale(cache: Path, code: CodeDigest, again: bool = False) -> bool:
    """Removes all compiled kernels where the stamp names others or is missing, or `again`; returns whether it did."""
    if not again and _stamp(cache).get("code", [""])[0] == code.kernels:
        return False
    folders = [cache] if cache != ROOT else [ROOT / package for package in PACKAGES]
    for folder in folders:
        for path in [*folder.rglob("*.nbi"), *folder.rglob("*.nbc")]:
            path.unlink(missing_ok=True)
    write_stamp(cache, code, set())
    return True


def code_digest(root: Path = ROOT) -> CodeDigest:
    """The digest of the code at `root`; of an installed package, the name of its cache, which is a digest already."""
    installed = installed_cache(root)
    if installed is not None and installed == cache_root():
        return CodeDigest(installed.name, installed.name)
    kernels, sources = hashlib.sha256(), hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            source = path.read_bytes()
            if package != "zenav":  # no service's code
                sources.update(source)
            if b"\n@njit" in source:
                kernels.update(source)
    return CodeDigest(kernels.hexdigest(), sources.hexdigest())


def warm_key(service: str, file: RobotFile, section: dict[str, Any]) -> str:
    """What the kernels of a service depend on: versions, processor, and the form of its configuration.

    section: the service's section as plain values.  The form has the sign of each number, not its value: kernels are
    compiled for types, and a setting of 0 may leave a part out.
    """
    robot = file.robot.model_dump(mode="json", exclude={"name"})
    form = json.dumps([_form(robot), _form(section)], sort_keys=True)
    digest = hashlib.sha256(form.encode()).hexdigest()[:12]
    return f"{service} {digest} {kernel_target()}"


def kernel_target() -> str:
    """The computers that kernels compiled here serve: versions and processor."""
    return f"py{sys.version_info[0]}.{sys.version_info[1]} numba {version('numba')} {processor()}"


def _stamp(cache: Path) -> dict[str, Any]:
    """The stamp: `code`, two digests, and `warmed`, a list of keys; empty where it is damaged or missing."""
    try:
        stamp = json.loads((cache / STAMP).read_text(encoding="utf-8"))
        kernels, sources = stamp["code"]
        return {"code": [str(kernels), str(sources)], "warmed": [str(key) for key in stamp["warmed"]]}
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def _form(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _form(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return sorted({json.dumps(_form(part), sort_keys=True) for part in value})
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int | float):
        return (value > 0) - (value < 0)
    return "path" if "/" in str(value) and not str(value).endswith(".yaml") else str(value)
