# SPDX-License-Identifier: Apache-2.0
"""Imported before numpy by every entry point and by the tests: the same input gives the same bytes.

The last bits of numpy's exp, log and tan change with AVX-512, those of BLAS with the core type and the number of
threads (measured). So all compute as an x86-64-v3 machine does (AVX2 and FMA: Haswell of 2013 and later, Zen), on one
thread. numba compiles for that machine too: its cache then serves every host that an image runs on. What is set from
outside stays, but for the threads. On aarch64 only the threads and OpenBLAS's generic core are set.
"""

import os
import platform
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

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
        if {"avx2", "fma", "bmi2"} <= cpu_flags:  # OpenBLAS and numba believe what they are told
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
    """What this process's kernels are compiled for, like `x86_64 x86-64-v3`; where that is equal, so are last bits."""
    return f"{platform.machine()} {os.environ.get('NUMBA_CPU_NAME', 'as it is')}"  # noqa: TID251


def _set() -> None:
    major, minor = (int(part) for part in version("numpy").split(".")[:2])
    before = dict(os.environ)  # noqa: TID251  # here the environment is the subject
    after = {**settings(platform.machine(), _cpu_flags(), (major, minor)), **before, **THREADS}
    if "numpy" in sys.modules and after != before:
        warnings.warn(
            "numpy was imported before shared.repeatable: results may differ in their last bits", stacklevel=2
        )
    os.environ.update(after)  # noqa: TID251


_set()
