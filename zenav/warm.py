# SPDX-License-Identifier: Apache-2.0
"""Compiles every kernel into numba's cache, so that no service compiles while the robot drives: `python -m zenav.warm`.

numba notices a change in a kernel's own file. It does not notice a change of a kernel that it calls in another file,
and runs the old code of that one. So any change of a file with kernels clears the whole cache first.
"""

import shared.repeatable  # noqa: F401  # before numpy; numba compiles for the machine that it names

# isort: split
import hashlib
import sys
import time
from pathlib import Path

from numba.core import config as numba_config

from shared.config import configured
from zenav.classes import built, made

ROOT = Path(__file__).resolve().parent.parent
ROBOTS: tuple[tuple[str, list[str]], ...] = (
    ("x80sv", []),
    ("jackal", []),
    ("x80sv", ["robot.drive.min_turning_radius=0.5", "robot.drive.turns_in_place=false"]),
)
"""Name and settings: what they drive by has kernels of its own."""


def main() -> None:
    """Builds and warms every service with every robot; whatever goes wrong there ends this with its traceback."""
    clear_stale(cache_root())
    for name in built():
        begun = time.monotonic()
        for robot, settings in ROBOTS:
            file = configured(robot, settings)
            made(name, file, file.robot).warm()
        tell(name, begun)


def tell(name: str, begun: float) -> None:
    """How long it took."""
    sys.stdout.write(f"{name:<16}{time.monotonic() - begun:6.1f} s\n")
    sys.stdout.flush()


def cache_root() -> Path:
    """Where numba keeps what it compiled: one folder for all, or `__pycache__` beside each file."""
    folder: str = numba_config.CACHE_DIR  # type: ignore[attr-defined]  # numba sets it from the environment
    return Path(folder) if folder else ROOT


def clear_stale(cache: Path) -> bool:
    """Removes all compiled kernels when a file with kernels changed since the last call; says whether it did."""
    folders = [cache] if cache != ROOT else [ROOT / "services", ROOT / "shared", ROOT / "zenav"]
    cache.mkdir(parents=True, exist_ok=True)
    stamp, digest = cache / ".kernels", kernels_digest()
    if stamp.exists() and stamp.read_text() == digest:
        return False
    for folder in folders:
        for path in [*folder.rglob("*.nbi"), *folder.rglob("*.nbc")]:
            path.unlink()
    stamp.write_text(digest)
    return True


def kernels_digest() -> str:
    """A hash of every source file that holds a kernel."""
    digest = hashlib.sha256()
    for package in ("services", "shared", "zenav"):
        for path in sorted((ROOT / package).rglob("*.py")):
            source = path.read_bytes()
            if b"@njit" in source or b"@numba" in source:
                digest.update(source)
    return digest.hexdigest()


if __name__ == "__main__":
    main()
