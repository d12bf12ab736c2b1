# SPDX-License-Identifier: Apache-2.0
"""Settings with which the same input gives the same bytes. Entry points and tests import it before numpy.

The last bits of numpy's exp, log and tan depend on AVX-512. Those of BLAS depend on the core type and the number of
threads (measured). So all machines compute as x86-64-v3 (AVX2 and FMA: Haswell of 2013 and later, Zen), on one thread.
numba compiles for that machine, too: its cache then serves every host of an image. Variables that are already set stay,
except the number of threads. On aarch64 only the threads and OpenBLAS's generic core are set.
"""

import os
import platform
import re
import sys
import warnings
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from shared.kernel_cache import installed_cache

THREADS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}


def settings(machine: str, cpu_flags: frozenset[str], numpy_version: tuple[int, int]) -> dict[str, str]:
    """The environment for repeatable bytes on a machine (`x86_64`, `aarch64`) with these flags and this numpy."""
    wanted = {"NUMBA_DISABLE_INTEL_SVML": "1"}
    if machine in ("x86_64", "AMD64"):
        # numpy 2.4 renamed its groups; a name that it does not dispatch on is an ImportWarning
        wanted["NPY_DISABLE_CPU_FEATURES"] = (
            "X86_V4 AVX512_ICL AVX512_SPR"
            if numpy_version >= (2, 4)
            else "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
        )
        if {"avx2", "fma", "bmi2"} <= cpu_flags:  # OpenBLAS and numba do not check these
            wanted |= {"OPENBLAS_CORETYPE": "Haswell", "NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
    elif machine in ("aarch64", "arm64"):
        wanted["OPENBLAS_CORETYPE"] = "ARMV8"
    return wanted


def _cpu_flags() -> frozenset[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line for line in lines if line.startswith("flags")), "").partition(":")[2].split())


def processor() -> str:
    """Target of this process's kernels, like `x86_64 x86-64-v3`. Equal targets give equal last bits."""
    return f"{platform.machine()} {os.environ.get('NUMBA_CPU_NAME', 'as it is')}"  # noqa: TID251


def is_portable() -> bool:
    """Whether that target is a kind of processor, and not this one alone."""
    return "NUMBA_CPU_NAME" in os.environ  # noqa: TID251


def _numpy_version() -> tuple[int, int]:
    """Major and minor, from numpy's own file: importing numpy, or importlib.metadata, costs a command its answer."""
    spec = find_spec("numpy")
    match = None
    if spec is not None and spec.origin is not None:
        with suppress(OSError):
            text = Path(spec.origin).with_name("version.py").read_text(encoding="utf-8")
            match = re.search(r'^version = "(\d+)\.(\d+)', text, re.MULTILINE)
    if match is None:
        from importlib.metadata import version

        match = re.match(r"(\d+)\.(\d+)", version("numpy"))
    assert match is not None
    return int(match[1]), int(match[2])


def _set() -> None:
    major, minor = _numpy_version()
    before = dict(os.environ)  # noqa: TID251  # here the environment is the subject
    cache = installed_cache()
    cache_setting = {"NUMBA_CACHE_DIR": str(cache)} if cache else {}
    after = {**settings(platform.machine(), _cpu_flags(), (major, minor)), **cache_setting, **before, **THREADS}
    if "numpy" in sys.modules and after != before:
        warnings.warn(
            "numpy was imported before shared.repeatable: results may differ in their last bits", stacklevel=2
        )
    os.environ.update(after)  # noqa: TID251


_set()
