# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels in a wheel: a computer of the kind that built it compiles nothing after the installation.

numba finds a kernel by the digest of its source file, its line, the processor, and the versions of Python and numba.
The folder's name is a digest of the source's path. So a copy in the folders of an installation is valid there. On other
computers the kernels are compiled.
"""

import json
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile

from shared.config import UserError
from shared.kernel_cache import ROOT
from shared.repeatable import is_portable
from zenav.stack.kernel_stamp import PACKAGES, kernel_target

ARCHIVE = Path("zenav", "prebuilt_kernels.zip")
"""In a wheel. Files lie in it as their sources: the kernels of services/planner/search.py are in services/planner."""
CONTENTS = "contents.json"
"""`target`, and `warmed`: the keys of the configurations whose kernels are there."""


def collect(keys: Iterable[str], archive: Path, root: Path = ROOT) -> int:
    """Writes what a checkout has compiled into an archive, for a wheel, and returns the number of kernels.

    keys: of the configurations that are compiled.  Nothing is written where kernels serve only the processor that
    compiled them: on ARM, and on x86-64 without AVX2.
    """
    archive.unlink(missing_ok=True)
    if not is_portable():
        return 0
    n = 0
    with ZipFile(archive, "w", ZIP_DEFLATED) as file:
        file.writestr(CONTENTS, json.dumps({"target": kernel_target(), "warmed": sorted(keys)}))
        for package in PACKAGES:
            for path in sorted((root / package).rglob("__pycache__/*.nb[ic]")):
                file.write(path, path.parent.parent.relative_to(root) / path.name)
                n += path.suffix == ".nbc"
    return n


def copy_prebuilt(cache: Path, root: Path = ROOT) -> set[str]:
    """Copies the kernels of an installed wheel into numba's cache, and returns the keys of what they serve.

    None where the wheel has none for this kind of computer.  Raises UserError where the cache cannot be written.
    """
    archive = root / ARCHIVE
    if cache == root or not archive.is_file() or not is_portable():
        return set()
    from numba.core.caching import _CacheLocator  # 0.5 s, which a warm start does not need

    subpath: Callable[[str], str] = _CacheLocator.get_suitable_cache_subpath
    try:
        with ZipFile(archive) as file:
            contents = json.loads(file.read(CONTENTS))
            if contents["target"] != kernel_target():
                return set()
            # a kernel's code comes before the index that names it
            for name in sorted(file.namelist(), key=lambda name: name.endswith(".nbi")):
                if name != CONTENTS:
                    path = PurePosixPath(name)
                    place = cache / subpath(str(root / path))
                    place.mkdir(parents=True, exist_ok=True)
                    part = place / f"{path.name}.part"
                    part.write_bytes(file.read(name))
                    os.replace(part, place / path.name)
            return {str(key) for key in contents["warmed"]}
    except (BadZipFile, zlib.error, ValueError, KeyError, TypeError):
        return set()  # damaged: what is missing is compiled
    except OSError as error:
        raise UserError(f"cannot copy kernels into {cache}: {error.strerror}", "check the disk") from None
