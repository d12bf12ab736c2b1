# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, and how processes that compile at the same time do not harm each other.

A checkout has numba's `__pycache__` folders beside the code. An installed package may be read-only. So its kernels are
in the user's cache. The folder's name is a digest of the package, so another version has another folder.
`NUMBA_CACHE_DIR` overrides both.
"""

import fcntl
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
    """From now on a kernel comes from the cache as machine code, without what only compiling needs.

    Without parts of numba: it imports them before it looks into its cache, and for the environments of its own
    functions within a kernel. They import scipy.linalg in their turn: 23 MB and 0.6 s together. A compilation imports
    them itself.

    Without LLVM's module and the typed source: numba keeps them to compile other kernels that call this one. They are
    20 MB of a stack, and half of the time of loading. Such a compilation reads the module from the cache then.
    """
    if "numba" not in sys.modules:
        return
    from numba.core import caching, codegen, environment
    from numba.core.runtime.nrt import rtsys

    if getattr(caching.Cache.load_overload, "is_without_compiler", False):
        return
    library_class: Any = codegen.CPUCodeLibrary
    unserialize_whole = library_class._unserialize
    rebuild_whole: Any = caching.CompileResultCacheImpl.rebuild

    def load_overload(self: Any, signature: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # memory and its counts, which machine code calls
        with self._guard_against_spurious_io_errors():
            loaded = self._load_overload(signature, target_context)
        if loaded is None:
            return None
        library = loaded.library
        library._get_module_for_linking = partial(_module_of, self, signature, library)
        return loaded._replace(type_annotation="")

    def rebuild(self: Any, target_context: Any, payload: Any) -> Any:
        """numba asks for the address of these symbols only where it has noted them, which it does for whole modules."""
        description: Any = payload[1]
        symbols = description.llvm_cpython_wrapper_name, description.llvm_func_name
        target_context.codegen()._engine._defined_symbols.update(symbols)
        return rebuild_whole(self, target_context, payload)

    def unserialize(code_generator: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != "object":  # no machine code
            return unserialize_whole(code_generator, state)
        library = code_generator.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(data[0])
        library._finalize_final_module()
        return library

    def import_module(name: str) -> ModuleType:
        """A module of numba that is not yet imported is only its name here: no machine code looks into it."""
        return (
            ModuleType(name) if name.startswith("numba.") and name not in sys.modules else importlib.import_module(name)
        )

    load_overload.is_without_compiler = True  # type: ignore[attr-defined]
    caching.Cache.load_overload = load_overload  # type: ignore[method-assign]
    caching.CompileResultCacheImpl.rebuild = rebuild  # type: ignore[method-assign]
    library_class._unserialize = staticmethod(unserialize)
    vars(environment)["importlib"] = SimpleNamespace(import_module=import_module)


def _module_of(cache: Any, signature: Any, library: Any) -> Any:
    """The LLVM module of a kernel that came from the cache, read there once. Raises FileNotFoundError without it."""
    from llvmlite import binding

    if library._shared_module is None:
        payload = cache._cache_file.load(cache._index_key(signature, library.codegen))
        if payload is None:
            name = cache._py_func.__name__
            raise FileNotFoundError(f"the compiled kernel {name} is no more in the cache: run zenav warm")
        (_, _, (_, module)), *_ = payload
        library._shared_module = binding.parse_bitcode(module)
    return library._shared_module
