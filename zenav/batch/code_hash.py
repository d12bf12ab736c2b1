# SPDX-License-Identifier: Apache-2.0
"""Which code made a result? A hash of the package's sources and of the libraries that its arithmetic depends on."""

import hashlib
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from shared.kernel_cache import ROOT
from shared.repeatable import processor
from zenav.stack.kernel_stamp import PACKAGES

LIBRARIES = "numpy", "scipy", "numba", "kiss-icp", "rosbags", "pillow"


@cache
def code_hash() -> str:
    """SHA-256 of every Python file of services, shared and zenav, with path; of versions; of the named processor."""
    code = hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            code.update(f"{path.relative_to(ROOT)}\0".encode())
            code.update(hashlib.sha256(path.read_bytes()).digest())
    for name in LIBRARIES:
        code.update(f"{name} {_version(name)}\n".encode())
    code.update(processor().encode())
    return code.hexdigest()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"
