# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of an installed package lie in the user's cache, and two processes may save at the same time."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numba  # noqa: F401  # what is not imported is not serialized
import pytest
from numba.core.caching import IndexDataCacheFile

from shared.kernel_cache import ROOT, installed_cache, serialize_saves


@pytest.fixture
def installed(tmp_path):
    record = tmp_path / "site-packages" / "zenav-1.2.3.dist-info" / "RECORD"
    record.parent.mkdir(parents=True)
    record.write_text("shared/a.py,sha256=1,1\n")
    return record


def test_a_checkout_keeps_its_kernels_beside_the_code(installed):
    assert installed_cache(ROOT) is None
    (installed.parents[1] / "pyproject.toml").touch()
    assert installed_cache(installed.parents[1]) is None


def test_an_installed_package_keeps_its_kernels_in_the_users_cache_by_its_contents(installed, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    first = installed_cache(installed.parents[1])
    assert first.parent == tmp_path / "home" / ".cache" / "zenav" / "kernels"
    assert first.name.startswith("1.2.3-")
    installed.write_text("shared/a.py,sha256=2,1\n")  # the same version, other code
    assert installed_cache(installed.parents[1]) != first
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert installed_cache(installed.parents[1]).is_relative_to(tmp_path / "xdg")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the standard: to be ignored
    assert installed_cache(installed.parents[1]).is_relative_to(tmp_path / "home")


def test_signatures_that_are_saved_at_the_same_time_keep_their_own_code(tmp_path, monkeypatch):
    serialize_saves()
    serialize_saves()  # once is enough
    save_index = IndexDataCacheFile._save_index

    def slow_save_index(self, overloads):
        time.sleep(0.002)  # noqa: TID251  # the other one reads the index meanwhile
        save_index(self, overloads)

    monkeypatch.setattr(IndexDataCacheFile, "_save_index", slow_save_index)

    def save(prefix):
        file = IndexDataCacheFile(str(tmp_path), "kernel-1.py311", "stamp")
        for i in range(10):
            file.save((prefix, i), f"code of {prefix} {i}")

    threads = [threading.Thread(target=save, args=(prefix,)) for prefix in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    file = IndexDataCacheFile(str(tmp_path), "kernel-1.py311", "stamp")
    assert [file.load((p, i)) for p in "ab" for i in range(10)] == [f"code of {p} {i}" for p in "ab" for i in range(10)]
    assert len(list(Path(tmp_path).glob("*.nbc"))) == 20


KERNELS = """
from numba import njit

@njit(cache=True)
def halved(x):
    return x / 2 + 1 if x > 3 else x * 0.3

@njit
def summed(xs):
    total = 0.0
    for x in xs:
        total += halved(x)
    return total
"""
COMPILE_CALLER = """
import json, sys
import numpy as np
import kernels
from shared.kernel_cache import load_without_compiler

if "alone" in sys.argv:
    load_without_compiler()
    load_without_compiler()
assert kernels.halved(8.0) == 5.0
assert sum(kernels.halved.stats.cache_hits.values()) == ("cached" in sys.argv)
(compiled,) = kernels.halved.overloads.values()
has_module = compiled.library._shared_module is not None
value = kernels.summed(np.linspace(0, 7, 99))
print(json.dumps([has_module, value, kernels.summed.inspect_llvm(kernels.summed.signatures[0])]))
"""


def test_a_kernel_compiles_to_the_same_code_when_its_callee_was_loaded_without_its_module(tmp_path):
    (tmp_path / "kernels.py").write_text(KERNELS)

    def compiled(*words):
        paths = f"{tmp_path}:{ROOT}"
        command = [sys.executable, "-P", "-c", COMPILE_CALLER, *words]
        done = subprocess.run(command, check=True, capture_output=True, env=dict(os.environ, PYTHONPATH=paths))  # noqa: TID251  # a child
        return json.loads(done.stdout)

    compiled()  # fills the cache
    whole, alone = compiled("cached"), compiled("cached", "alone")
    assert whole[0] is True
    assert alone[0] is False
    assert whole[1:] == alone[1:]


COMPILE_LATE = """
import shutil
from pathlib import Path
import numpy as np
import kernels
from shared.kernel_cache import load_without_compiler

load_without_compiler()
assert kernels.halved(8.0) == 5.0
shutil.rmtree(Path(kernels.__file__).parent / "__pycache__")
assert kernels.halved(1.0) == 0.3
kernels.summed(np.linspace(0, 7, 99))
"""


def test_a_callee_that_is_no_more_in_the_cache_is_named_with_the_command_that_compiles_it(tmp_path):
    (tmp_path / "kernels.py").write_text(KERNELS)
    environment = dict(os.environ, PYTHONPATH=f"{tmp_path}:{ROOT}")  # noqa: TID251  # a child
    command = [sys.executable, "-P", "-c"]
    subprocess.run([*command, COMPILE_CALLER], check=True, capture_output=True, env=environment)
    done = subprocess.run([*command, COMPILE_LATE], capture_output=True, text=True, env=environment, check=False)
    assert done.stderr.splitlines()[-1].endswith("halved is no more in the cache: run zenav warm")


LOAD_ALONE = """
import sys
import numpy as np
from shared.kernel_cache import load_without_compiler
from kernels import extremes, summed

load_without_compiler()
assert extremes(np.array([3.0, -1.0, 2.0])) == [-1.0, 3.0]
if "cached" in sys.argv:
    assert not [name for name in sys.modules if name.startswith(("scipy.linalg", "numba.np.arraymath"))]
    assert not extremes.stats.cache_misses
assert summed(np.array([1.0, 8.0])) == 5.3
assert "numba.np.arraymath" in sys.modules
"""
KERNEL_WITH_PARTS_OF_NUMBA = """
@njit(cache=True)
def extremes(xs):
    first = np.sort(xs)
    return [first.min(), np.max(first)]
"""


def test_a_kernel_loads_without_what_only_compiling_needs_and_another_one_compiles_after_it(tmp_path):
    (tmp_path / "kernels.py").write_text("import numpy as np" + KERNELS + KERNEL_WITH_PARTS_OF_NUMBA)
    environment = dict(os.environ, PYTHONPATH=f"{tmp_path}:{ROOT}")  # noqa: TID251  # a child
    for words in ([], ["cached"]):
        subprocess.run([sys.executable, "-P", "-c", LOAD_ALONE, *words], check=True, env=environment)
