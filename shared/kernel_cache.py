# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, and how processes that compile at the same time do not harm each other.

A checkout has numba's `__pycache__` folders beside the code. An installed package may be read-only. So its kernels are
in the user's cache. The folder's name is a digest of the package, so another version has another folder.
`NUMBA_CACHE_DIR` overrides both.
"""

import fcntl
import gc
import hashlib
import importlib
import os
import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
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
    load_without_compiler()
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


def load_without_compiler() -> None:
    """From now on a kernel comes from the cache without the parts of numba that only compiling needs.

    numba imports them before it looks into its cache, and for the environments of its own functions within a kernel.
    They import scipy.linalg in their turn: 23 MB and 0.6 s together. A compilation imports them itself.
    """
    if "numba" not in sys.modules:
        return
    from numba.core import caching, environment
    from numba.core.runtime.nrt import rtsys

    def load_overload(self: Any, signature: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # memory and its counts, which machine code calls
        with self._guard_against_spurious_io_errors():
            return self._load_overload(signature, target_context)

    def import_module(name: str) -> ModuleType:
        """A module of numba that is not yet imported is only its name here: no machine code looks into it."""
        return (
            ModuleType(name) if name.startswith("numba.") and name not in sys.modules else importlib.import_module(name)
        )

    caching.Cache.load_overload = load_overload  # type: ignore[method-assign]
    vars(environment)["importlib"] = SimpleNamespace(import_module=import_module)


def release_intermediate_code() -> None:
    """Frees LLVM's modules and the typed source of the kernels that were loaded from the cache: 20 MB of a stack.

    numba keeps them to compile other kernels that call these. Such a compilation reads them from the cache again.
    """
    if "numba" not in sys.modules:
        return
    from numba.core import sigutils
    from numba.core.registry import CPUDispatcher

    dispatchers: list[Any] = [item for item in gc.get_objects() if type(item) is CPUDispatcher]
    for dispatcher in dispatchers:
        for loaded in dispatcher._cache_hits:  # signatures, or tuples of the arguments' types
            arguments, _ = sigutils.normalize_signature(loaded)  # type: ignore[no-untyped-call]  # numba's own
            compiled: Any = dispatcher.overloads.get(tuple(arguments))
            if compiled is None or compiled.library._shared_module is None:
                continue
            library = compiled.library
            library._shared_module.close()
            library._shared_module = None
            library._get_module_for_linking = partial(_reloaded_module, dispatcher, loaded, library)
            dispatcher.overloads[tuple(arguments)] = compiled._replace(type_annotation="")


def _reloaded_module(dispatcher: Any, signature: Any, library: Any) -> Any:
    """The LLVM module of a released kernel, from the cache, once for a process. Raises FileNotFoundError without it."""
    if library._shared_module is None:
        again = dispatcher._cache.load_overload(signature, dispatcher.targetctx)
        if again is None:
            raise FileNotFoundError(
                f"the compiled kernel {dispatcher.__name__} is no more in the cache: run zenav warm"
            )
        library._shared_module = again.library._shared_module
        library._reloaded = again  # it owns the module
    return library._shared_module
