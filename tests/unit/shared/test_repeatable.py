# SPDX-License-Identifier: Apache-2.0
"""The environment that decides the last bits is set before numpy, and is one that numpy takes without a word."""

import os
import platform
import subprocess
import sys

import pytest

from shared.repeatable import THREADS, processor, settings

V3 = frozenset({"avx2", "fma", "bmi2"})


def test_recordings_name_the_processor_that_kernels_are_compiled_for(monkeypatch):
    monkeypatch.setenv("NUMBA_CPU_NAME", "x86-64-v3")
    assert processor().endswith(" x86-64-v3")
    monkeypatch.delenv("NUMBA_CPU_NAME")
    assert processor().endswith(" as it is")


def test_an_old_processor_is_not_told_to_be_a_newer_one():
    assert not {"OPENBLAS_CORETYPE", "NUMBA_CPU_NAME"} & set(settings("x86_64", frozenset({"sse2"}), (2, 4)))
    assert settings("x86_64", V3, (2, 4))["OPENBLAS_CORETYPE"] == "Haswell"


@pytest.mark.parametrize("machine", ["aarch64", "arm64", "riscv64"])
def test_other_architectures_get_no_word_of_x86(machine):
    values = " ".join(settings(machine, V3, (2, 4)).values())
    assert "AVX" not in values
    assert "Haswell" not in values


def test_numpy_is_told_the_groups_that_its_version_has():
    assert "X86_V4" in settings("x86_64", V3, (2, 4))["NPY_DISABLE_CPU_FEATURES"]
    assert "AVX512_SKX" in settings("x86_64", V3, (2, 3))["NPY_DISABLE_CPU_FEATURES"]


BITS = """
import shared.repeatable, hashlib, numpy as np
x = np.random.default_rng(1).normal(size=40000)
a = x.reshape(200, 200)
parts = np.exp(x), np.log(np.abs(x)), np.tan(x), np.linalg.inv(a), a @ a
print(hashlib.sha256(b"".join(p.tobytes() for p in parts)).hexdigest())
"""


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("NPY_", "OPENBLAS_", "OMP_", "NUMBA_"))}  # noqa: TID251
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], env={**clean, **environment}, capture_output=True, text=True
    )


def test_numbers_do_not_depend_on_the_number_of_threads_that_was_asked_for():
    alone, many = run(BITS), run(BITS, OPENBLAS_NUM_THREADS="2", OMP_NUM_THREADS="2")
    assert alone.stderr == many.stderr == ""
    assert len(alone.stdout) == 65
    assert alone.stdout == many.stdout


@pytest.mark.skipif(platform.machine() != "x86_64", reason="these are the features of x86-64")
def test_numpy_computes_without_avx_512_and_does_not_complain():
    code = (
        "import shared.repeatable; from numpy._core._multiarray_umath import __cpu_features__ as f; print(f['X86_V4'])"
    )
    done = run(code)
    assert (done.stdout, done.stderr) == ("False\n", "")


def test_who_imports_numpy_first_is_told():
    done = run("import numpy, shared.repeatable")
    assert "numpy was imported before shared.repeatable" in done.stderr
    assert run("import numpy, shared.repeatable", **settings_here(), **THREADS).stderr == ""


def settings_here() -> dict[str, str]:
    code = "import os; before = dict(os.environ); import shared.repeatable; "
    code += "print({k: v for k, v in os.environ.items() if before.get(k) != v})"
    found: dict[str, str] = eval(run(code).stdout)
    return {key: value for key, value in found.items() if key not in THREADS}
